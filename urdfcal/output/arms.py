"""The arm in a recording: its links' shapes, or a stick figure, and its DH frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from urdfcal.output.bodies import MESH_FORMATS, visible_links
from urdfcal.output.palette import CALIBRATED, GHOST, NOMINAL, PARAMETER_COLORS
from urdfcal.output.placing import link_frames
from urdfcal.output.stream import placed

if TYPE_CHECKING:
    from rerun import AsComponents

    from urdfcal.arrays import Floats
    from urdfcal.output.bodies import Shape, VisibleLink
    from urdfcal.output.scene import CalibrationScene
    from urdfcal.output.stream import Layer
    from urdfcal.robot.dh import DHTable
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session

Tint = tuple[int, ...]
# Lengths below this share of the reach are corrections, too small to be seen.
_NO_LENGTH = 2e-3


def log_arms(layer: Layer, session: Session, scene: CalibrationScene) -> tuple[str, ...]:
    """Log the calibrated arm solid and the nominal arm as a ghost; where shapes are missing, stick figures too.

    Returns:
        Warnings about shapes that cannot be shown.
    """
    bodies, warnings = visible_links(session.urdf, session.chain) if session.urdf else ((), ())
    arms = (("calibrated", scene.frames, None, CALIBRATED), ("nominal", scene.ghost, GHOST, NOMINAL))
    for name, frames, tint, line in arms:
        arm = layer.at(name)
        for body in bodies:
            _log_body(arm.at(body.link), body, frames, tint)
        if warnings or not bodies:
            strips = _sticks(session.chain, frames)
            stick = arm.at("stick figure")
            stick.fixed(rr.LineStrips3D.from_fields(colors=line, radii=0.006 * session.chain.reach))
            columns = rr.LineStrips3D.columns(
                strips=[strip[k].astype(np.float32) for k in range(layer.poses) for strip in strips]
            )
            stick.each(columns.partition([len(strips)] * layer.poses))
    return warnings


def _sticks(mechanism: Mechanism, frames: Floats) -> list[Floats]:
    """A line from the base link over the joints to each tip, (N, K, 3) in m."""
    lines = []
    for tip in mechanism.tips:
        joints = frames[:, [0, *(joint + 1 for joint in mechanism.path(tip.joint))]]
        line = np.concatenate([joints, link_frames(frames, tip)[:, None]], axis=1)
        lines.append(line[..., :3, 3])
    return lines


def log_dh(layer: Layer, table: DHTable, scene: CalibrationScene) -> None:
    """Log the DH frames as axes, and each row's way from one to the next, with d and a as labels.

    Rows are numbered as in the table beside them, from 1.
    """
    length = 0.08 * table.chain.reach
    for i in range(scene.dh.shape[1]):
        layer.at(f"F{i}").moving(scene.dh[:, i])
        layer.at(f"F{i}").fixed(rr.TransformAxes3D(axis_length=length))
    sliding = {joint.name for joint in table.chain.joints if joint.prismatic}
    for i, (joint, values) in enumerate(zip(table.labels, table.nominal + scene.arm.row_offsets, strict=True)):
        for name, value, stretch in (
            ("d", values[1], scene.corners[:, i, :2]),
            ("a", values[2], scene.corners[:, i, 1:]),
        ):
            if abs(value) < _NO_LENGTH * table.chain.reach and joint not in sliding:
                continue
            row = layer.at("rows", f"{name}{i + 1}")
            label = f"{name}{i + 1} {1e3 * value:.1f} mm"
            color = PARAMETER_COLORS[name]
            row.fixed(
                rr.LineStrips3D.from_fields(
                    colors=color, radii=0.004 * table.chain.reach, labels=label, show_labels=False
                )
            )
            row.each(rr.LineStrips3D.columns(strips=stretch.astype(np.float32)))


def _log_body(layer: Layer, body: VisibleLink, frames: Floats, tint: Tint | None) -> None:
    T = frames[:, body.frame] @ body.T_frame_link
    if body.frame == 0:
        layer.fixed(placed(T[0]))
    else:
        layer.moving(T)
    for k, shape in enumerate(body.shapes):
        scale = shape.size if shape.mesh else (1.0, 1.0, 1.0)
        layer.at(f"shape {k}").fixed(placed(shape.T_link_shape, scale), _visual(shape, tint))


def _visual(shape: Shape, tint: Tint | None) -> AsComponents:
    color = tint or (tuple(round(255 * c) for c in shape.color) if shape.color else None)
    if shape.mesh:
        suffix = shape.mesh.suffix.lower()
        # The other formats bring colours of their own, and finer ones than the URDF's one a link.
        albedo = color if tint or suffix == ".stl" else None
        return rr.Asset3D(path=shape.mesh, media_type=MESH_FORMATS[suffix], albedo_factor=albedo)
    fill = rr.components.FillMode.TransparentFillMajorWireframe if tint else rr.components.FillMode.Solid
    if shape.kind == "box":
        return rr.Boxes3D(sizes=[shape.size], colors=color, fill_mode=fill)
    if shape.kind == "cylinder":
        return rr.Cylinders3D(radii=shape.size[0], lengths=shape.size[1], colors=color, fill_mode=fill)
    return rr.Ellipsoids3D(half_sizes=[shape.size * 3], colors=color, fill_mode=fill)
