"""ROS camera_info: files, as camera_calibration writes and camera_info_manager reads them, one a camera; messages.

A camera_info has no place of its own for where a camera stands. That of a pair is in its rectification: both cameras
are turned (R) to look the same way, and the projection P = K' [1 | t] of the second is shifted by t = (-B, 0, 0), B
the baseline. So, with t relative to the first,

    T_cam_world = [R_camᵀ R_first | R_camᵀ t] .

Where R and P are those of an unrectified camera (1 and [K | 0]), its place is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.camera import Camera
from urdfcal.cameras.io.entries import Entry, pinhole, place, rigid, standing
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError
from urdfcal.files import staged, write_text

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.arrays import Floats

_MODELS = {"plumb_bob": "radtan", "equidistant": "equidistant", "fisheye": "equidistant"}
# Two rectified views are shifted by more than this against each other, m.
_LEAST_SHIFT = 1e-6
# Cameras one behind the other cannot both look across their baseline: within this sine of it there is nothing to share.
_LEAST_ACROSS = 0.05


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """What a camera_info says, wherever it stands.

    Attributes:
        name: the camera's.
        size: (width, height) in px.
        K: (3, 3) camera matrix, px.
        distortion_model: ROS's name of it.
        D: (k,) distortion coefficients.
        R: (3, 3) rectification; the identity where there is none.
        P: (3, 4) projection of the rectified camera, px and px m; [1 | 0] where there is none.
        where: names the place in messages.
        error: makes the error of a key (as in a file) from what is wrong and its remedy.
    """

    name: str
    size: tuple[int, int]
    K: Floats
    distortion_model: str
    D: Floats
    R: Floats
    P: Floats
    where: str
    error: Callable[[str, str, str], CameraError]

    def camera(self) -> Camera:
        """Return the camera; one without distortion gets the model none, radtan without k3 four coefficients.

        Raises:
            CameraError: it is of a kind that urdfcal does not know.
        """
        key = "camera_matrix"
        K = pinhole(self.K, key, lambda what: self.error(key, what, "Skewed pixels are not supported."))
        if self.distortion_model not in _MODELS:
            remedy = f"Use one of: {', '.join(_MODELS)}; calibrate again without the rational model."
            raise self.error("distortion_model", f"distortion model '{self.distortion_model}' is not supported", remedy)
        model, D = _MODELS[self.distortion_model], self.D
        # Simulated cameras often have no coefficients at all.
        if model == "radtan" and len(D) in (0, 4, 5):
            model, D = ("none", D[:0]) if not D.any() else ("radtan", D[:4] if not D[4:].any() else D)
        with standing(self.where):
            return Camera(self.name, self.size, K, model, D)

    def shift(self) -> Floats:
        """Where the rectified camera stands, turned by R: t (3,) of P = K' [1 | t]. [m].

        Raises:
            CameraError: P is no projection.
        """
        if abs(np.linalg.det(self.P[:, :3])) < 1e-12:
            raise self.error("projection_matrix", "the left part of projection_matrix has no inverse", "")
        return np.asarray(np.linalg.solve(self.P[:, :3], self.P[:, 3]), dtype=np.float64)


def rig_of(infos: Sequence[CameraInfo]) -> Rig:
    """The cameras that camera_infos describe, standing where their rectification tells; the first is the world.

    Raises:
        CameraError: one of them is of a kind that urdfcal does not know, or stands where none can.
    """
    cameras = [info.camera() for info in infos]
    first = infos[0]
    places: list[Floats | None] = [np.eye(4)]
    for info in infos[1:]:
        shift = info.shift() - first.shift()
        if np.linalg.norm(shift) < _LEAST_SHIFT:
            places.append(None)
            continue
        complain = partial(info.error, "projection_matrix")
        places.append(rigid(info.R.T @ first.R, info.R.T @ shift, "rectification_matrix", complain))
    return Rig(tuple(cameras), tuple(places))


def read_ros(paths: Sequence[str | Path]) -> Rig:
    """Read one camera_info file a camera; the first camera is the world.

    A camera is called by its camera_name, or by its file where two have the same. plumb_bob without distortion becomes
    the model none, and without k3 radtan with four coefficients: the same projection.

    Raises:
        CameraError: a file cannot be read or holds no camera urdfcal knows; names file, line, column and key.
    """
    entries = [Entry.read(Path(path), "the keys of a camera_info") for path in paths]
    names = [entry.text("camera_name") if "camera_name" in entry.fields else "" for entry in entries]
    if len(set(names)) < len(names) or not all(names):
        names = [entry.path.stem for entry in entries]
    return rig_of([_info(name, entry) for name, entry in zip(names, entries, strict=True)])


def from_left(paths: Sequence[Path]) -> list[Path]:
    """The files of a pair in the order of its cameras: the first one's rectified projection is not shifted."""

    def shifted(path: Path) -> bool:
        entry = Entry.read(path, "the keys of a camera_info")
        return bool(np.any(_info("", entry).P[:, 3]))

    return sorted(paths, key=shifted)


def write_ros(path: str | Path, rig: Rig) -> tuple[Path, ...]:
    """Write camera_info files: the file ``path`` for one camera, for two the folder ``path`` with <camera>.yaml.

    The numbers of the lenses come back exactly, places to rounding (1e-15); standard deviations are not kept.

    Returns:
        The files written.

    Raises:
        CameraError: camera_info cannot say what the rig is.
        OutputError: it cannot be written.
    """
    path = Path(path)
    if len(rig.cameras) > 2:
        what = f"camera_info files speak of one camera or a pair, not of {len(rig.cameras)}"
        raise CameraError(what, remedy="Write Kalibr.")
    texts = [_text(camera, R, P) for camera, (R, P) in zip(rig.cameras, _rectified(rig), strict=True)]
    if len(texts) == 1:
        write_text(path, texts[0])
        return (path,)
    for name in rig.names:
        if Path(name).name != name:
            raise CameraError(f"'{name}' cannot be the name of a file", remedy="Rename the camera.")
    with staged(path) as stage:
        for name, text in zip(rig.names, texts, strict=True):
            (stage / f"{name}.yaml").write_text(text, encoding="utf-8")
    return tuple(path / f"{name}.yaml" for name in rig.names)


def _info(name: str, entry: Entry) -> CameraInfo:
    R = entry.table("rectification_matrix", (3, 3)) if "rectification_matrix" in entry.fields else np.eye(3)
    P = entry.table("projection_matrix", (3, 4)) if "projection_matrix" in entry.fields else np.eye(3, 4)
    size = entry.whole("image_width"), entry.whole("image_height")
    K, model = entry.table("camera_matrix", (3, 3)), entry.text("distortion_model")
    D = entry.table("distortion_coefficients").ravel()
    return CameraInfo(name, size, K, model, D, R, P, place(entry.path, entry.node), entry.error)


def _rectified(rig: Rig) -> list[tuple[Floats, Floats]]:
    """R and P of one or two cameras, rectified if it is known how two stand."""
    T = rig.T_cam_world[-1]
    if T is None or len(rig.cameras) == 1:
        return [(np.eye(3), np.pad(camera.matrix, ((0, 0), (0, 1)))) for camera in rig.cameras]
    # Where the second camera stands, and where both look, in the first one's frame.
    centre, ahead = -T[:3, :3].T @ T[:3, 3], T[2, :3] + np.array([0.0, 0.0, 1.0])
    sideways = abs(centre[0]) >= abs(centre[1])
    along = centre / np.linalg.norm(centre) * np.copysign(1.0, centre[0] if sideways else centre[1])
    across = ahead - (ahead @ along) * along
    if np.linalg.norm(across) < _LEAST_ACROSS * max(float(np.linalg.norm(ahead)), 1.0):
        raise CameraError(
            "these two cameras look along their baseline or at each other: they cannot be rectified, and "
            "camera_info has no other place for where they stand",
            remedy="Write Kalibr or OpenCV.",
        )
    z = across / np.linalg.norm(across)
    x, y = (along, np.cross(z, along)) if sideways else (np.cross(along, z), along)
    R_first = np.stack([x, y, z])
    rotations = [R_first, R_first @ T[:3, :3].T]
    # One pinhole for both: the mean focal length, the images' centres kept where they are on average.
    focal = float(np.mean([camera.intrinsics[:2] for camera in rig.cameras]))
    centres = []
    for camera, R in zip(rig.cameras, rotations, strict=True):
        middle = 0.5 * (np.array(camera.resolution) - 1.0)
        ray = R @ camera.unproject(middle)
        centres.append(middle - focal * ray[:2] / ray[2])
    cx, cy = np.mean(centres, axis=0)
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    shifts = [np.zeros(3), rotations[1] @ T[:3, 3]]
    return [(R, np.column_stack([K, K @ t])) for R, t in zip(rotations, shifts, strict=True)]


def _text(camera: Camera, R: Floats, P: Floats) -> str:
    import yaml

    if camera.distortion_model == "equidistant":
        model, D = "equidistant", camera.distortion
    else:
        # plumb_bob has five coefficients, and image_pipeline takes no fewer.
        model, D = "plumb_bob", np.pad(camera.distortion, (0, 5 - len(camera.distortion)))

    def table(values: Floats) -> dict[str, object]:
        return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}

    fields = {
        "image_width": camera.resolution[0],
        "image_height": camera.resolution[1],
        "camera_name": camera.name,
        "camera_matrix": table(camera.matrix),
        "distortion_model": model,
        "distortion_coefficients": table(D[None]),
        "rectification_matrix": table(R),
        "projection_matrix": table(P),
    }
    return yaml.safe_dump(fields, sort_keys=False, default_flow_style=None, width=2**16)
