"""Kalibr's camchain, the camera file a session holds.

Standard deviations stand beside each camera in ``urdfcal_sigma``, a key Kalibr and its readers pass over:

    urdfcal_sigma:
      intrinsics: [0.03, 0.03, 0.07, 0.05]                 # px, as intrinsics
      distortion_coeffs: [7.0e-05, 3.2e-04, 7.4e-06, ...]  # as distortion_coeffs
      T_cn_c0: [...]                                       # m and rad: x y z rx ry rz of a small motion exp6(s) T_cn_c0
      correlations: [[...], ...]                           # a row for each of these; with those of the cameras before,
                                                           # then with this camera's own

A rolling shutter's ``line_time``, from row to row in s, and ``line_time_sigma`` (10 % of it unless given) are keys of
urdfcal's own as well.

T_cn_c0 is the camera's place seen from the first camera, the world; for a pair that is T_cn_cnm1.
"""

from __future__ import annotations

import re
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.io.entries import Entry, place, rigid, standing
from urdfcal.cameras.rig import CameraSigma, Rig
from urdfcal.errors import CameraError
from urdfcal.files import write_text

if TYPE_CHECKING:
    from collections.abc import Iterable

_SIGMA, _SCALE = "urdfcal_sigma", "urdfcal_scale_sigma"
_USED = (
    "camera_model",
    "intrinsics",
    "distortion_model",
    "resolution",
    "distortion_coeffs",
    "T_cn_cnm1",
    "line_time",
    "line_time_sigma",
    _SIGMA,
    _SCALE,
)
# What a data sheet's line time may be off by, or one computed from the frame rate: rows that are not shown take time.
_LINE_TIME = 0.1
# Kalibr writes these too; they say nothing about where a pixel looks.
_IGNORED = ("rostopic", "cam_overlaps", "timeshift_cam_imu", "T_cam_imu")
_SIGMAS = ("intrinsics", "distortion_coeffs", "T_cn_c0", "correlations")
_DISTORTIONS = {"radtan": "radtan", "equidistant": "equidistant", "equi": "equidistant", "none": "none"}


def read_kalibr(path: str | Path) -> Rig:
    """Read a Kalibr camchain.

    Args:
        path: YAML with one entry a camera: Kalibr's cam0, cam1, ... in the order of their numbers, or any
            names in the order of the file. ``T_cn_cnm1`` takes the previous camera's coordinates to this
            one's (m); without it, the places of this camera and of all after it are unknown.

    Raises:
        CameraError: the file cannot be read, or is not a chain of pinhole cameras; names file, line, column,
            camera and key.
    """
    path = Path(path)
    file = Entry.read(path, "cameras by name")
    entries = {name: Entry.of(path, name, node, f"the keys of '{name}'") for name, node in file.fields.items()}
    cameras, chain, sigmas = [], [], []
    T: Floats | None = np.eye(4)
    scale: float | None = None
    for i, name in enumerate(_chain_order(entries, path)):
        entry = entries[name]
        cameras.append(_camera(entry))
        if i > 0:
            T_step = _step(entry)
            T = None if T is None or T_step is None else T_step @ T
            if _SCALE in entry.fields:
                raise entry.error(_SCALE, f"{_SCALE} is of all lengths", "It belongs to the first camera.")
        elif "T_cn_cnm1" in entry.fields:
            raise entry.error("T_cn_cnm1", "the first camera has no camera before it", "Leave T_cn_cnm1 out.")
        elif _SCALE in entry.fields:
            scale = entry.number(_SCALE)
            if not 0.0 <= scale < 1.0:
                raise entry.error(_SCALE, f"{_SCALE} {scale:g} is no standard deviation of a share of all lengths")
        chain.append(T)
        sigmas.append(_sigma(entry, cameras[-1], placed=i > 0 and T is not None))
    try:
        return Rig(tuple(cameras), tuple(chain), tuple(sigmas), scale)
    except CameraError as error:
        raise CameraError(error.what, where=f"{path} ({error.where})", remedy=error.remedy) from error


def write_kalibr(path: str | Path, rig: Rig) -> None:
    """Write ``rig`` as a Kalibr camchain, in one step; :func:`read_kalibr` gives every number back exactly.

    Raises:
        CameraError: a camchain cannot say where this rig's cameras stand, or would change their order.
        OutputError: the file cannot be written.
    """
    import yaml

    path = Path(path)
    if _chain_order(rig.names, path) != list(rig.names):
        what = f"the cameras {', '.join(rig.names)} are not in the order of their numbers"
        raise CameraError(what, where=str(path), remedy="Kalibr's order is that of the numbers: rename them.")
    chain: dict[str, dict[str, Any]] = {}
    T_before: Floats | None = None
    for i, (camera, T, sigma) in enumerate(zip(rig.cameras, rig.T_cam_world, rig.sigmas, strict=True)):
        chain[camera.name] = entry = {
            "camera_model": "pinhole",
            "intrinsics": camera.intrinsics.tolist(),
            "distortion_model": camera.distortion_model,
            "distortion_coeffs": camera.distortion.tolist(),
            "resolution": list(camera.resolution),
        }
        if camera.rolling:
            entry |= {"line_time": float(camera.line_time), "line_time_sigma": float(camera.line_time_sigma)}
        if T is not None and i > 0:
            if T_before is None:
                what = f"the place of '{camera.name}' is known, that of '{rig.names[i - 1]}' before it is not"
                raise CameraError(what, where=str(path), remedy="Put cameras of unknown place last.")
            T_step = T @ inverse(T_before)
            # The reader multiplies the steps up: give each the rounding errors of those before it.
            T_step += (T - T_step @ T_before) @ inverse(T_before)
            T = T_step @ T_before
            entry["T_cn_cnm1"] = T_step.tolist()
        T_before = T
        if sigma is not None:
            values = (sigma.parameters[:4], sigma.parameters[4:], sigma.pose, sigma.correlations)
            entry[_SIGMA] = {key: v.tolist() for key, v in zip(_SIGMAS, values, strict=True) if v is not None}
    if rig.scale_sigma is not None and rig.names:
        chain[rig.names[0]][_SCALE] = float(rig.scale_sigma)
    write_text(path, yaml.safe_dump(chain, sort_keys=False, default_flow_style=None, width=2**16))


def _chain_order(names: Iterable[str], path: Path) -> list[str]:
    """Order of the chain: by number if all are called cam<number> (Kalibr's files have cam10 before cam2)."""
    names = list(names)
    if not all(re.fullmatch(r"cam\d{1,6}", name) for name in names):
        return names
    names.sort(key=lambda name: int(name[3:]))
    for before, after in pairwise(names):
        if int(after[3:]) != int(before[3:]) + 1:
            what = f"'{after}' comes after '{before}': its T_cn_cnm1 speaks of a camera that is missing"
            remedy = "Number the cameras without gaps, or give them other names."
            raise CameraError(what, where=str(path), remedy=remedy)
    return names


def _camera(entry: Entry) -> Camera:
    entry.only(_USED + _IGNORED, f"camera '{entry.name}'")
    if (model := entry.text("camera_model")) != "pinhole":
        raise entry.error("camera_model", f"camera model '{model}' is not supported", "Use a pinhole model.")
    written = entry.text("distortion_model")
    if written not in _DISTORTIONS:
        remedy = f"Use one of: {', '.join(_DISTORTIONS)}."
        raise entry.error("distortion_model", f"distortion model '{written}' is not supported", remedy)
    given = written != "none" or "distortion_coeffs" in entry.fields
    coefficients = entry.numbers("distortion_coeffs") if given else []
    size, intrinsics = entry.size("resolution"), entry.numbers("intrinsics")
    line = entry.number("line_time") if "line_time" in entry.fields else 0.0
    sigma = entry.number("line_time_sigma") if "line_time_sigma" in entry.fields else _LINE_TIME * abs(line)
    model, distortion = _DISTORTIONS[written], np.array(coefficients)
    with standing(f"{place(entry.path, entry.node)} ({entry.name})"):
        return Camera(entry.name, size, np.array(intrinsics), model, distortion, line, sigma)


def _step(entry: Entry) -> Floats | None:
    """T_cn_cnm1 with its rotation made exact, or None where the file does not give it."""
    key = "T_cn_cnm1"
    if key not in entry.fields:
        return None
    T = entry.rows(key, (4, 4))
    if not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-9):
        transposed = np.allclose(T[:, 3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-9)
        remedy = "Rows and columns are exchanged: the translation belongs in the last column." if transposed else ""
        raise entry.error(key, f"the last row of {key} is {T[3].tolist()}, not [0, 0, 0, 1]", remedy)
    return rigid(T[:3, :3], T[:3, 3], key, partial(entry.error, key))


def _sigma(entry: Entry, camera: Camera, *, placed: bool) -> CameraSigma | None:
    """The standard deviations beside a camera, or None where there are none."""
    if _SIGMA not in entry.fields:
        return None
    inner = entry.inner(_SIGMA)
    inner.only(_SIGMAS, _SIGMA)
    expected = {"intrinsics": 4, "distortion_coeffs": len(camera.distortion), "T_cn_c0": 6}
    if "T_cn_c0" not in inner.fields:
        del expected["T_cn_c0"]
    elif not placed:
        raise inner.error("T_cn_c0", "this camera's place is not given, or is the world", "Leave T_cn_c0 out.")
    values: dict[str, list[float]] = {}
    for key, count in expected.items():
        values[key] = numbers = inner.numbers(key)
        if len(numbers) != count or min(numbers, default=0.0) < 0.0:
            raise inner.error(key, f"{key} must be {count} standard deviations, none negative; it is {numbers}")
    correlations = inner.rows("correlations") if "correlations" in inner.fields else None
    pose = np.array(values["T_cn_c0"]) if "T_cn_c0" in values else None
    return CameraSigma(np.array(values["intrinsics"] + values["distortion_coeffs"]), pose, correlations)
