"""A picture of the arm for the report, drawn from the shapes that its URDF has for collisions."""

from __future__ import annotations

import base64
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.output import palette
from urdfcal.output.arms import visible_links

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.output.arms import Shape
    from urdfcal.output.findings import Overview

# Pixels of the picture, and how many times finer it is drawn for smooth edges.
_SIZE, _FINER = 480, 2
_MARGIN = 0.06
# The arm is seen from its right front, from somewhat above; light comes from the left above.
_EYE, _LIGHT = np.array([0.8, -1.0, 0.5]), np.array([0.2, -0.8, 1.0])
_DARKEST = 0.35
_PAINT = np.array([205.0, 190.0, 180.0])  # blue, green, red
# Finer meshes than this take longer than the rest of the page, and show no more: rods are drawn then.
_MOST_TRIANGLES = 60_000
_ROUND = 20
# Radius of a rod, for the arm's reach.
_ROD = 0.025
_STL = np.dtype([("normal", "<3f4"), ("corners", "<9f4"), ("attribute", "<u2")])


def portrait(overview: Overview) -> str:
    """Draw the calibrated arm at the pose in the middle of what was measured, and the LEDs at all poses.

    Returns:
        The picture, a PNG in base64; "" where there is no shape to draw.
    """
    import cv2

    calibration, scene = overview.calibration, overview.scene
    session = calibration.session
    if session.urdf is None:
        return ""
    readings = session.readings
    spread = np.maximum(np.ptp(readings, axis=0), 1e-9)
    pose = int(np.argmin(np.sum(((readings - np.median(readings, axis=0)) / spread) ** 2, axis=1)))
    frames, parts, drawn = scene.frames[pose], [np.zeros((0, 3, 3))], set()
    for link in visible_links(session.urdf, session.chain, collision=True)[0]:
        for shape in link.shapes:
            T = frames[link.frame] @ link.T_frame_link @ shape.T_link_shape
            parts.append(triangles(shape) @ T[:3, :3].T + T[:3, 3])
            drawn |= {link.frame} if len(parts[-1]) else set()
    fine = sum(map(len, parts)) > _MOST_TRIANGLES
    if fine:
        parts, drawn = parts[:1], set()
    if drawn or fine:  # where a link's shape is not drawn, a rod leads to the next joint, lest hands hang in the air
        rod = _ROD * session.chain.reach
        ends = ((parent + 1, joint + 1) for joint, parent in enumerate(session.chain.parents))
        parts += [_rod(frames[a, :3, 3], frames[b, :3, 3], rod) for a, b in ends if a not in drawn]
    corners = np.concatenate(parts)
    if not len(corners):
        return ""
    leds = scene.leds.measured[~scene.leds.outlier]
    back = _EYE / np.linalg.norm(_EYE)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    view = np.stack([right, np.cross(right, back), back])  # rows: right, down, towards the eye
    shown = np.concatenate([corners.reshape(-1, 3), leds]) @ view[:2].T
    low, high = shown.min(axis=0), shown.max(axis=0)
    scale = _SIZE * _FINER * (1.0 - 2.0 * _MARGIN) / (high - low).max()
    width, height = np.ceil((high - low) * scale + 2.0 * _MARGIN * _SIZE * _FINER).astype(int)
    canvas = np.zeros((height, width, 4), dtype=np.uint8)
    canvas[..., :3] = _PAINT  # what is transparent has the edge's colour, lest edges are dark

    def place(points: Floats) -> Floats:
        result: Floats = (points @ view[:2].T - low) * scale + _MARGIN * _SIZE * _FINER
        return result

    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
    normals *= np.where(normals @ back < 0.0, -1.0, 1.0)[:, None]  # some meshes are wound the other way
    shade = _DARKEST + (1.0 - _DARKEST) * np.clip(normals @ (_LIGHT / np.linalg.norm(_LIGHT)), 0.0, 1.0)
    polygons = np.round(place(corners)).astype(np.int32)
    colors = (shade[:, None] * _PAINT).astype(int).tolist()
    for k in np.argsort((corners @ back).mean(axis=1)).tolist():  # the farthest first
        cv2.fillConvexPoly(canvas, polygons[k], (*colors[k], 255))
    dots, sizes = np.round(place(leds)).astype(int).tolist(), palette.by_sigma(scene.leds.size[~scene.leds.outlier])
    for centre, color in zip(dots, sizes[:, ::-1].tolist(), strict=True):
        cv2.circle(canvas, centre, 3 * _FINER, (*color, 255), cv2.FILLED)
    small = cv2.resize(canvas, None, fx=1 / _FINER, fy=1 / _FINER, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".png", small)
    return base64.b64encode(data.tobytes()).decode() if done else ""


def triangles(shape: Shape) -> Floats:
    """The surface (K, 3, 3) of a shape in its own frame, in m; nothing of a mesh that is no binary STL."""
    if shape.mesh is not None:
        return _binary_stl(shape.mesh) * shape.size
    if shape.kind == "box":
        half = np.array(shape.size) / 2.0
        ring = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        return _tube(ring * half[:2], ring * half[:2], half[2])
    angle = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    if shape.kind == "cylinder":
        radius, length = shape.size
        return _tube(radius * circle, radius * circle, length / 2.0)
    radius, heights = shape.size[0], np.linspace(-np.pi / 2, np.pi / 2, _ROUND // 2)
    layers = [np.column_stack([np.cos(h) * circle, np.full(_ROUND, np.sin(h))]) for h in heights]
    return radius * np.concatenate([_between(a, b) for a, b in pairwise(layers)])


def _rod(start: Floats, end: Floats, radius: float) -> Floats:
    """The surface of a rod between two points; none of a point."""
    length = float(np.linalg.norm(end - start))
    if not length > 0.0:
        return np.zeros((0, 3, 3))
    axis = (end - start) / length
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    angle = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)
    circle = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    found: Floats = _tube(circle, circle, length / 2.0) @ np.stack([across, np.cross(axis, across), axis])
    return found + (start + end) / 2.0


def _binary_stl(path: Path) -> Floats:
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little") if len(data) >= 84 else 0
    if path.suffix.lower() != ".stl" or len(data) != 84 + count * _STL.itemsize:
        return np.zeros((0, 3, 3))
    found: Floats = np.frombuffer(data, _STL, count, 84)["corners"].reshape(-1, 3, 3).astype(float)
    return found


def _tube(below: Floats, above: Floats, half: float) -> Floats:
    """The walls and lids between two polygons (K, 2), the lower at -half and the upper at half."""
    low, high = (np.column_stack([of, np.full(len(of), z)]) for of, z in ((below, -half), (above, half)))
    lids = [_between(ring, np.broadcast_to(ring.mean(axis=0), ring.shape)) for ring in (low, high)]
    return np.concatenate([_between(low, high), *lids])


def _between(a: Floats, b: Floats) -> Floats:
    """Triangles between two closed lines (K, 3)."""
    a_next, b_next = np.roll(a, -1, axis=0), np.roll(b, -1, axis=0)
    return np.concatenate([np.stack([a, a_next, b], axis=1), np.stack([a_next, b_next, b], axis=1)])
