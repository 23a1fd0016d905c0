"""OpenCV's FileStorage, YAML or XML, with the names its samples use.

    one camera   image_width, image_height, camera_matrix, distortion_coefficients
    stereo       M1, D1, M2, D2, R, T (x2 = R x1 + T), in one file or two (intrinsics.yml, extrinsics.yml)

Also read are cameraMatrix, distCoeffs, K and D, with or without a number, and imageSize. A fisheye has the same four
coefficients as radtan: it is one only where the file says so (fisheye_model: 1, or distortion_model: equidistant, which
urdfcal writes). The files are read without OpenCV, whose reader crashes on deep nesting and knows no line numbers.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

import numpy as np

from urdfcal.cameras.camera import Camera
from urdfcal.cameras.io.entries import Entry, compose, compose_xml, pinhole, place, read_bytes, rigid, standing
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError
from urdfcal.files import write_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Floats

_MATRIX = ("camera_matrix", "cameraMatrix", "M", "K")
_DISTORTION = ("distortion_coefficients", "distCoeffs", "D")
_MODELS = ("radtan", "equidistant", "none")
# Terms of OpenCV's longer models, by the number of coefficients.
_LONGER = {8: "rational", 12: "thin prism", 14: "tilted"}
# Head and foot of a file, a value, a matrix, and what stands between its numbers.
_YAML = (
    "%YAML:1.0\n---\n", "", "{key}: {value}\n",
    "{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n", ", ",
)  # fmt: skip
_XML = (
    '<?xml version="1.0"?>\n<opencv_storage>\n', "</opencv_storage>\n", "<{key}>{value}</{key}>\n",
    ('<{key} type_id="opencv-matrix">\n  <rows>{rows}</rows>\n  <cols>{cols}</cols>\n  <dt>d</dt>\n'
     "  <data>{data}</data></{key}>\n"), " ",
)  # fmt: skip


def read_opencv(paths: Sequence[str | Path], size: tuple[int, int] | None = None) -> Rig:
    """Read FileStorage files that together describe one camera, or several; the first is the world.

    Args:
        paths: YAML or XML.
        size: (width, height) in px for files that do not tell, as those of OpenCV's stereo_calib.

    Raises:
        CameraError: a file cannot be read or holds no camera urdfcal knows; names file, line, column and key.
    """
    entries = [_entry(Path(path)) for path in paths]
    found = [_Found(entry, suffix) for entry in entries for suffix in ("", "1", "2")]
    sources = [item for item in found if item.key(*_MATRIX)]
    if not sources:
        remedy = f"It is called one of: {', '.join(_MATRIX)}."
        raise CameraError("there is no camera matrix in it", where=str(paths[0]), remedy=remedy)
    names = [source.name() for source in sources]
    if len(set(names)) < len(names):
        names = [f"cam{i}" for i in range(len(names))]
    cameras = tuple(source.camera(name, size) for source, name in zip(sources, names, strict=True))
    places: list[Floats | None] = [np.eye(4), *[None] * (len(cameras) - 1)]
    for entry in entries:
        if "R" in entry.fields and "T" in entry.fields and len(cameras) == 2:
            R, t = entry.table("R"), entry.table("T").ravel()
            if R.shape != (3, 3) or t.shape != (3,):
                raise entry.error("R", "R must be 3 x 3 and T have three numbers")
            places[1] = rigid(R, t, "R", partial(entry.error, "R"))
    return Rig(cameras, tuple(places))


def write_opencv(path: str | Path, rig: Rig) -> None:
    """Write one camera or a pair to one file: XML if it is called .xml, YAML otherwise.

    :func:`read_opencv` gives every number back exactly; standard deviations are not kept.

    Raises:
        CameraError: there are more than two cameras.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    if len(rig.cameras) > 2:
        raise CameraError(f"an OpenCV file holds one camera or a pair, not {len(rig.cameras)}", remedy="Write Kalibr.")
    alone = len(rig.cameras) == 1
    fields: dict[str, str | int | Floats] = {}
    for suffix, camera in zip(("",) if alone else ("1", "2"), rig.cameras, strict=True):
        # OpenCV takes no empty vector for "no distortion".
        D = camera.distortion if len(camera.distortion) else np.zeros(5)
        fields |= {
            f"camera_name{suffix}": camera.name,
            f"image_width{suffix}": camera.resolution[0],
            f"image_height{suffix}": camera.resolution[1],
            "camera_matrix" if alone else f"M{suffix}": camera.matrix,
            f"distortion_model{suffix}": camera.distortion_model,
            "distortion_coefficients" if alone else f"D{suffix}": D[None],
        }
    if not alone and (T := rig.T_cam_world[1]) is not None:
        fields |= {"R": T[:3, :3], "T": T[:3, 3:]}
    xml = path.suffix.lower() == ".xml"
    head, foot, plain, matrix, between = _XML if xml else _YAML
    text = head
    for key, value in fields.items():
        if isinstance(value, np.ndarray):
            data = between.join(map(repr, value.ravel().tolist()))
            text += matrix.format(key=key, rows=len(value), cols=value.shape[1], data=data)
        else:
            # JSON's string is YAML's in double quotes.
            quoted = f'"{escape(value)}"' if xml and isinstance(value, str) else json.dumps(value, ensure_ascii=False)
            text += plain.format(key=key, value=quoted)
    write_text(path, text + foot)


@dataclass(frozen=True)
class _Found:
    """The keys of one camera in a file: those that end in ``suffix``."""

    entry: Entry
    suffix: str

    def key(self, *names: str) -> str | None:
        """The first of ``names`` that the file has for this camera."""
        return next((name + self.suffix for name in names if name + self.suffix in self.entry.fields), None)

    def name(self) -> str:
        """What the camera is called."""
        if key := self.key("camera_name"):
            return self.entry.text(key)
        return f"cam{int(self.suffix) - 1}" if self.suffix else self.entry.path.stem

    def camera(self, name: str, size: tuple[int, int] | None) -> Camera:
        """Read the camera."""
        matrix, distortion = self.key(*_MATRIX) or "", self.key(*_DISTORTION)
        intrinsics = pinhole(self.entry.table(matrix), matrix, partial(self.entry.error, matrix))
        D = self.entry.table(distortion).ravel() if distortion else np.zeros(0)
        model, D = self._lens(distortion or matrix, D)
        with standing(f"{place(self.entry.path, self.entry.fields[matrix])} ({matrix})"):
            return Camera(name, self._size(size), intrinsics, model, D)

    def _lens(self, key: str, D: Floats) -> tuple[str, Floats]:
        fisheye = self.key("fisheye_model") or _Found(self.entry, "").key("fisheye_model")
        if written := self.key("distortion_model"):
            model = self.entry.text(written)
            model = {"fisheye": "equidistant", "plumb_bob": "radtan"}.get(model, model)
            if model not in _MODELS:
                remedy = f"Use one of: {', '.join(_MODELS)}."
                raise self.entry.error(written, f"distortion model '{model}' is not supported", remedy)
        elif fisheye and self.entry.whole(fisheye):
            model = "equidistant"
        else:
            model = "radtan" if D.any() else "none"
        if model == "none" and not D.any():
            return model, D[:0]
        if model == "radtan" and D[5:].any():
            what = f"the {_LONGER.get(len(D), 'longer')} model's {len(D)} coefficients are not supported"
            raise self.entry.error(key, what, "Calibrate with k1 k2 p1 p2 k3 only.")
        return model, D[:5] if model == "radtan" else D

    def _size(self, size: tuple[int, int] | None) -> tuple[int, int]:
        for item in (self, _Found(self.entry, "")):
            width, height = item.key("image_width"), item.key("image_height")
            if width and height:
                return self.entry.whole(width), self.entry.whole(height)
            if both := item.key("imageSize", "image_size"):
                return self.entry.size(both)
        if size is None:
            what, remedy = "the file does not tell the size of the image", "Give it: --size 1280x1024."
            raise CameraError(what, where=str(self.entry.path), remedy=remedy)
        return size


def _entry(path: Path) -> Entry:
    data = read_bytes(path)
    if data.lstrip().startswith(b"<"):
        root = compose_xml(data, path)
    else:
        # OpenCV 4 heads its files with %YAML:1.0, which is not YAML.
        root = compose(re.sub(rb"\A%YAML.*", b"", data), path)
    return Entry.of(path, "", root, "the keys of an OpenCV file")
