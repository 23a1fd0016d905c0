"""Camera files: Kalibr's camchain, the one a session holds."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import Floats, inverse
from urdfcal.errors import CameraError
from urdfcal.files import write_text
from urdfcal.vision.camera import Camera
from urdfcal.vision.rig import Rig

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import yaml

_REQUIRED = ("camera_model", "intrinsics", "distortion_model", "resolution")
_USED = (*_REQUIRED, "distortion_coeffs", "T_cn_cnm1")
# Kalibr writes these too; they say nothing about where a pixel looks.
_IGNORED = ("rostopic", "cam_overlaps", "timeshift_cam_imu", "T_cam_imu")
_DISTORTIONS = {"radtan": "radtan", "equidistant": "equidistant", "equi": "equidistant", "none": "none"}
# Kalibr's own calibrations are orthonormal to 1e-15; a matrix typed with five digits is to about 1e-5.
_ORTHONORMAL = 1e-4
# Matrices this close are kept bit for bit, so that what urdfcal wrote comes back the same.
_EXACT = 1e-14
# Cameras around one arm stand at most a few metres apart; 20 m in millimetres would be 20 mm.
_LONGEST_BASELINE = 20.0
# Two lenses are never a micrometre apart; an identity left as a placeholder is.
_SHORTEST_BASELINE = 1e-6
# YAML 1.1 takes 1e-4 for text: it wants 1.0e-4. YAML 1.2, and everybody who types a number, does not.
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")


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
    entries = _entries(path)
    cameras, chain = [], []
    T: Floats | None = np.eye(4)
    for i, name in enumerate(_chain_order(entries, path)):
        entry = entries[name]
        cameras.append(_camera(entry))
        if i > 0:
            T_step = _step(entry)
            T = None if T is None or T_step is None else T_step @ T
        elif "T_cn_cnm1" in entry.fields:
            raise entry.error("T_cn_cnm1", "the first camera has no camera before it", "Leave T_cn_cnm1 out.")
        chain.append(T)
    return Rig(tuple(cameras), tuple(chain))


def write_kalibr(path: str | Path, rig: Rig) -> None:
    """Write ``rig`` as a Kalibr camchain, in one step; :func:`read_kalibr` gives every number back exactly.

    Raises:
        CameraError: a camchain cannot say where this rig's cameras stand, or would change their order.
        OutputError: the file cannot be written.
    """
    import yaml

    path = Path(path)
    if _chain_order(rig.names, path) != list(rig.names):
        raise CameraError(
            f"the cameras {', '.join(rig.names)} are not in the order of their numbers",
            where=str(path),
            remedy="Kalibr's order is that of the numbers: rename them.",
        )
    chain: dict[str, dict[str, Any]] = {}
    T_before: Floats | None = None
    for i, (camera, T) in enumerate(zip(rig.cameras, rig.T_cam_world, strict=True)):
        chain[camera.name] = {
            "camera_model": "pinhole",
            "intrinsics": camera.intrinsics.tolist(),
            "distortion_model": camera.distortion_model,
            "distortion_coeffs": camera.distortion.tolist(),
            "resolution": list(camera.resolution),
        }
        if T is None or i == 0:
            T_before = T
            continue
        if T_before is None:
            raise CameraError(
                f"the place of '{camera.name}' is known, that of '{rig.names[i - 1]}' before it is not",
                where=str(path),
                remedy="Put cameras of unknown place last.",
            )
        T_step = T @ inverse(T_before)
        # The reader multiplies the steps up: give each the rounding errors of those before it.
        T_step += (T - T_step @ T_before) @ inverse(T_before)
        T_before = T_step @ T_before
        chain[camera.name]["T_cn_cnm1"] = T_step.tolist()
    write_text(path, yaml.safe_dump(chain, sort_keys=False, default_flow_style=None, width=2**16))


@dataclass(frozen=True)
class _Entry:
    """One camera of the file: its keys with the places where their values stand."""

    path: Path
    name: str
    node: yaml.Node
    fields: Mapping[str, yaml.Node]

    def error(self, key: str, what: str, remedy: str = "") -> CameraError:
        place = _place(self.path, self.fields.get(key, self.node))
        return CameraError(what, where=f"{place} ({self.name}.{key})", remedy=remedy)

    def text(self, key: str) -> str:
        """The value of ``key`` as written."""
        value = self.fields[key].value
        if not isinstance(value, str):
            raise self.error(key, f"{key} must be one word")
        return value

    def numbers(self, key: str) -> list[float]:
        """The value of ``key``, a list of numbers."""
        return self._numbers(key, self.fields[key])

    def matrix(self, key: str) -> Floats:
        """The value of ``key``, four rows of four numbers."""
        rows = [self._numbers(key, row) for row in _items(self.fields[key]) or []]
        if [len(row) for row in rows] != [4, 4, 4, 4]:
            raise self.error(key, f"{key} must have four rows of four numbers")
        return np.array(rows)

    def _numbers(self, key: str, node: yaml.Node) -> list[float]:
        items = _items(node)
        if items is None:
            raise self.error(key, f"{key} must be a list of numbers")
        for item in items:
            text = item.value if isinstance(item.value, str) else "a nested value"
            if not _NUMBER.fullmatch(text) or not np.isfinite(float(text)):
                where = f"{_place(self.path, item)} ({self.name}.{key})"
                raise CameraError(f"'{text}' is not a finite number", where=where)
        return [float(item.value) for item in items]


def _entries(path: Path) -> dict[str, _Entry]:
    import yaml

    try:
        root = yaml.compose(path.read_bytes(), Loader=yaml.SafeLoader)
    except OSError as error:
        raise CameraError(f"the camera file cannot be read: {error.strerror}", where=str(path)) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise CameraError(f"this is not YAML: {error.problem or error.context}", where=place) from error
    except (yaml.YAMLError, RecursionError) as error:
        raise CameraError("this is not a YAML text file", where=str(path)) from error
    if root is None or not root.value:
        raise CameraError("the file holds no cameras", where=str(path))
    return {
        name: _Entry(path, name, node, _mapping(node, path, f"the keys of '{name}'"))
        for name, node in _mapping(root, path, "cameras by name").items()
    }


def _mapping(node: yaml.Node, path: Path, what: str) -> dict[str, yaml.Node]:
    """Keys and value nodes of a mapping; refuses any key that stands twice, which YAML readers let pass."""
    import yaml

    if not isinstance(node, yaml.MappingNode):
        raise CameraError(f"{what} are expected here, 'key: value' on each line", where=_place(path, node))
    found: dict[str, yaml.Node] = {}
    for key, value in node.value:
        if not isinstance(key.value, str):
            raise CameraError("a key must be one word", where=_place(path, key))
        if key.value in found:
            raise CameraError(f"'{key.value}' stands here a second time", where=_place(path, key))
        found[key.value] = value
    return found


def _place(path: Path, node: yaml.Node) -> str:
    return f"{path}:{node.start_mark.line + 1}:{node.start_mark.column + 1}"


def _items(node: yaml.Node) -> list[yaml.Node] | None:
    """The items of a list, None if the node is something else."""
    import yaml

    return node.value if isinstance(node, yaml.SequenceNode) else None


def _chain_order(names: Iterable[str], path: Path) -> list[str]:
    """Order of the chain: by number if all are called cam<number> (Kalibr's files have cam10 before cam2)."""
    names = list(names)
    if not all(re.fullmatch(r"cam\d{1,6}", name) for name in names):
        return names
    names.sort(key=lambda name: int(name[3:]))
    for before, after in pairwise(names):
        if int(after[3:]) != int(before[3:]) + 1:
            raise CameraError(
                f"'{after}' comes after '{before}': its T_cn_cnm1 speaks of a camera that is missing",
                where=str(path),
                remedy="Number the cameras without gaps, or give them other names.",
            )
    return names


def _camera(entry: _Entry) -> Camera:
    for key, node in entry.fields.items():
        if key not in _USED + _IGNORED:
            raise CameraError(
                f"key '{key}' of camera '{entry.name}' is not known",
                where=_place(entry.path, node),
                remedy=f"Allowed: {', '.join(_USED + _IGNORED)}.",
            )
    for key in _REQUIRED:
        if key not in entry.fields:
            raise entry.error(key, f"{key} is missing")
    if (model := entry.text("camera_model")) != "pinhole":
        raise entry.error("camera_model", f"camera model '{model}' is not supported", "Use a pinhole model.")
    written = entry.text("distortion_model")
    if written not in _DISTORTIONS:
        raise entry.error(
            "distortion_model",
            f"distortion model '{written}' is not supported",
            f"Use one of: {', '.join(_DISTORTIONS)}.",
        )
    if written != "none" and "distortion_coeffs" not in entry.fields:
        raise entry.error("distortion_coeffs", "distortion_coeffs is missing")
    coefficients = entry.numbers("distortion_coeffs") if "distortion_coeffs" in entry.fields else []
    resolution = entry.numbers("resolution")
    if len(resolution) != 2 or not all(side.is_integer() and side > 0 for side in resolution):
        raise entry.error("resolution", f"resolution {resolution} is not [width, height] in whole positive pixels")
    size = int(resolution[0]), int(resolution[1])
    intrinsics = entry.numbers("intrinsics")
    try:
        return Camera(entry.name, size, np.array(intrinsics), _DISTORTIONS[written], np.array(coefficients))
    except CameraError as error:
        raise CameraError(
            error.what, where=f"{_place(entry.path, entry.node)} ({entry.name})", remedy=error.remedy
        ) from error


def _step(entry: _Entry) -> Floats | None:
    """T_cn_cnm1 with its rotation made exact, or None where the file does not give it."""
    key = "T_cn_cnm1"
    if key not in entry.fields:
        return None
    T = entry.matrix(key)
    if not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-9):
        transposed = np.allclose(T[:, 3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-9)
        raise entry.error(
            key,
            f"the last row of {key} is {T[3].tolist()}, not [0, 0, 0, 1]",
            "Rows and columns are exchanged: the translation belongs in the last column." if transposed else "",
        )
    R, t = T[:3, :3], T[:3, 3]
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > _ORTHONORMAL:
        raise entry.error(
            key,
            f"the rotation part of {key} is off by {error:.2g} from a rotation matrix",
            "Its rows must be of length 1 and at right angles; write at least five digits.",
        )
    if np.linalg.det(R) < 0.0:
        raise entry.error(
            key,
            f"the rotation part of {key} is mirrored (determinant -1)",
            "Two of its rows are exchanged, or one has the wrong sign.",
        )
    baseline = float(np.linalg.norm(t))
    if baseline > _LONGEST_BASELINE:
        raise entry.error(
            key,
            f"the cameras stand {baseline:g} m apart; it looks like millimetres",
            "Give the translation in metres.",
        )
    if baseline < _SHORTEST_BASELINE:
        raise entry.error(
            key,
            "the two cameras stand in the same place",
            f"Leave {key} out if it is not known; it is then estimated.",
        )
    T[3] = 0.0, 0.0, 0.0, 1.0
    if error > _EXACT:
        U, _, Vt = np.linalg.svd(R)
        T[:3, :3] = U @ Vt
    return T
