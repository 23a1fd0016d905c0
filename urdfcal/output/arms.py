"""The arm in a recording: its links' shapes, or a stick figure, and its DH frames.

yourdfpy reads the shapes; rerun's own loader takes all limbs or none, and neither names the meshes that it does not
find nor looks for them where ``package://`` is looked for elsewhere in urdfcal.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import rerun as rr

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.output.palette import CALIBRATED, GHOST, NOMINAL, PARAMETER_COLORS
from urdfcal.output.placing import link_frames
from urdfcal.output.stream import Layer, placed
from urdfcal.output.viewpoint import viewpoint
from urdfcal.robot.urdf.urdf import Urdf, find_urdf

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from rerun import AsComponents

    from urdfcal.output.scene import CalibrationScene
    from urdfcal.robot.dh import DHTable
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session

Tint = tuple[int, ...]
Rgba = tuple[float, ...]
MESH_FORMATS = {
    ".stl": "model/stl",
    ".dae": "model/vnd.collada+xml",
    ".obj": "model/obj",
    ".glb": "model/gltf-binary",
    ".gltf": "model/gltf+json",
    ".ply": "application/x-ply",
}
"""Media types of the mesh files that can be shown, by file suffix."""
# Lengths below this share of the reach are corrections, too small to be seen.
_NO_LENGTH = 2e-3
# The names of lengths stand so far beside these. [reach]
_ASIDE = 0.035
# Axes of the frames are so long. [reach]
_AXES = 0.08


def log_arms(layer: Layer, session: Session, scene: CalibrationScene) -> tuple[str, ...]:
    """Log the calibrated arm solid and the nominal arm as a ghost; where shapes are missing, stick figures too.

    Returns:
        Warnings about shapes that cannot be shown.
    """
    bodies, warnings = visible_links(session.urdf, session.chain) if session.urdf else ((), ())
    sticks = bool(warnings) or not bodies
    arms = (("calibrated", scene.frames, None, CALIBRATED), ("nominal", scene.ghost, GHOST, NOMINAL))
    for name, frames, tint, line in arms:
        arm = layer.at(name)
        log_links(arm, bodies, frames, tint)
        if sticks:
            log_sticks(arm, session.chain, frames, line)
    return warnings


def log_links(arm: Layer, bodies: Sequence[VisibleLink], frames: Floats, tint: Tint | None = None) -> None:
    """Log the shapes of an arm's links at its joints' frames (N, n + 1, 4, 4) in the base link's. [m]."""
    for body in bodies:
        link = arm.at(body.link)
        link.placed(frames[:, body.frame] @ body.T_frame_link, moves=body.frame > 0)
        for k, shape in enumerate(body.shapes):
            scale = shape.size if shape.mesh else (1.0, 1.0, 1.0)
            link.at(f"shape {k}").fixed(placed(shape.T_link_shape, scale), _visual(shape, tint))


def log_sticks(arm: Layer, chain: Mechanism, frames: Floats, color: Tint) -> None:
    """Log lines from the base link over the joints' frames (N, n + 1, 4, 4) to each tip. [m]."""
    sticks = []
    for tip in chain.tips:
        joints = frames[:, [0, *(joint + 1 for joint in chain.path(tip.joint))]]
        sticks.append(np.concatenate([joints, link_frames(frames, tip)[:, None]], axis=1)[..., :3, 3])
    strips = [stick[k].astype(np.float32) for k in range(arm.poses) for stick in sticks]
    pose = np.repeat(np.arange(arm.poses), len(sticks))
    arm.at("stick figure").each(rr.LineStrips3D, {"strips": strips}, pose, colors=color, radii=0.006 * chain.reach)


def log_dh(layer: Layer, table: DHTable, scene: CalibrationScene) -> None:
    """Log the DH frames as axes, and each row's way from one to the next, its lengths d and a by name.

    Rows are numbered as in the table beside them, from 1, which has the lengths. Names stand beside the lengths, on one
    side and the other in turn: in a wrist they would lie over each other.
    """
    length, aside, rows = _AXES * table.chain.reach, _ASIDE * table.chain.reach, scene.rows
    eye, target = viewpoint(scene)
    forward = target - eye
    for i in range(rows.frames.shape[1]):
        layer.at(f"F{i}").placed(rows.frames[:, i])
        layer.at(f"F{i}").fixed(rr.TransformAxes3D(axis_length=length))
    sliding = {joint.name for joint in table.chain.joints if joint.prismatic}
    for i, (joint, values) in enumerate(zip(table.labels, rows.values, strict=True)):
        for k, (name, value) in enumerate(zip("da", values[1:3], strict=True)):
            if abs(value) < _NO_LENGTH * table.chain.reach and joint not in sliding:
                continue
            layer.at("rows", f"{name}{i + 1}").each(
                rr.LineStrips3D,
                {"strips": rows.corners[:, i, k : k + 2].astype(np.float32)},
                colors=PARAMETER_COLORS[name],
                radii=0.004 * table.chain.reach,
            )
            beside = label_places(rows.corners[:, i, k : k + 2], forward, (-1) ** (i + k) * aside)
            layer.at("rows", f"{name}{i + 1}", "label").each(
                rr.Points3D,
                {"positions": beside},
                colors=PARAMETER_COLORS[name],
                radii=0.0,
                labels=f"{name}{i + 1}",
                show_labels=False,
            )


def dh_extent(table: DHTable, scene: CalibrationScene) -> Floats:
    """The ends (N, 3) of what :func:`log_dh` draws: rows, and the axes of their frames. [m]."""
    frames = scene.rows.frames.reshape(-1, 4, 4)
    axes = frames[:, :3, 3, None] + _AXES * table.chain.reach * frames[:, :3, :3]
    return np.vstack([scene.rows.corners.reshape(-1, 3), np.swapaxes(axes, 1, 2).reshape(-1, 3)])


def label_places(lines: Floats, forward: Floats, aside: float) -> Floats:
    """Places (N, 3) beside the middles of lines (N, 2, 3) as one sees them who looks ``forward`` (3,). [m]."""
    across = np.cross(lines[:, 1] - lines[:, 0], forward)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    result: Floats = lines.mean(axis=1) + aside * across / np.where(length > 0.0, length, 1.0)
    return result


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


@dataclass(frozen=True)
class Shape:
    """One visual element of a link.

    Attributes:
        kind: what ``size`` means.
        size: box: lengths along x, y, z; cylinder: radius, length along z; sphere: radius [m];
            mesh: scales along x, y, z.
        T_link_shape: (4, 4) its frame in the link's. [m]
        mesh: the file, for a mesh.
        color: red, green, blue, alpha in 0 ... 1, where the URDF names one.
    """

    kind: Literal["mesh", "box", "cylinder", "sphere"]
    size: Rgba
    T_link_shape: Floats
    mesh: Path | None = None
    color: Rgba | None = None


@dataclass(frozen=True)
class VisibleLink:
    """A link that moves with a joint.

    Attributes:
        link: its name.
        frame: 0 for the base link's frame, i + 1 for joint i's.
        T_frame_link: (4, 4) the link in that frame. [m]
        shapes: what of it can be seen.
    """

    link: str
    frame: int
    T_frame_link: Floats
    shapes: tuple[Shape, ...]


def visible_links(
    urdf: Urdf, chain: Mechanism, *, collision: bool = False
) -> tuple[tuple[VisibleLink, ...], tuple[str, ...]]:
    """Collect the links of the arm that have something to show, or to collide with.

    These are the links that its joints carry, what is fixed to them, and everything beyond the last joints (a gripper's
    fingers, at zero joint values); other limbs of a larger robot are left out.

    Returns:
        The links, and warnings about shapes that cannot be shown.
    """
    import yourdfpy

    try:
        robot = yourdfpy.URDF.load(io.BytesIO(urdf.data), load_meshes=False, build_scene_graph=False).robot
    except ValueError as error:  # a word that should be a number, or a shape that is none
        return (), (f"The recording does not show the robot's shapes: {error}.",)
    visuals = {link.name: link.collisions if collision else link.visuals for link in robot.links}
    # A material is known by its name everywhere, wherever it is given its colour.
    materials = [*robot.materials, *(visual.material for link in robot.links for visual in link.visuals)]
    colors = {
        material.name: tuple(material.color.rgba.tolist()) for material in materials if material and material.color
    }
    shown, missing = [], []
    for link, frame, T in _carried_links(urdf, chain):
        shapes = []
        for visual in visuals[link]:
            try:
                shapes.append(_shape(urdf, visual, colors))
            except (RobotError, ValueError) as error:
                missing.append(str(error))
        if shapes:
            shown.append(VisibleLink(link, frame, frozen(T), tuple(shapes)))
    count = "1 shape" if len(missing) == 1 else f"{len(missing)} shapes"
    warnings = (f"The recording does not show {count} of the robot: {missing[0]}",) if missing else ()
    return tuple(shown), warnings


def _carried_links(urdf: Urdf, chain: Mechanism) -> list[tuple[str, int, Floats]]:
    frame_of = {name: i + 1 for i, name in enumerate(chain.names)}
    last = set(range(1, len(chain.joints) + 1)) - {parent + 1 for parent in chain.parents}
    carried = [(chain.base_link, 0, np.eye(4))]
    for link, frame, T in carried:  # grows while it is walked: parents come before children
        for joint in urdf.joints.values():
            if joint.parent != link:
                continue
            if joint.name in frame_of:
                carried.append((joint.child, frame_of[joint.name], np.eye(4)))
            elif joint.type == "fixed" or frame in last:
                carried.append((joint.child, frame, T @ joint.T_parent_joint))
    return carried


def _shape(urdf: Urdf, visual: Any, colors: Mapping[str, Rgba]) -> Shape:
    """Bring one of yourdfpy's visuals into a shape.

    Raises:
        RobotError: its mesh is not found.
        ValueError: its mesh has another format, or its numbers are too few.
    """
    T = np.eye(4) if visual.origin is None else visual.origin
    material, geometry = getattr(visual, "material", None), visual.geometry  # collisions have no material
    color = colors.get(material.name) if material else None
    if geometry.mesh is not None:
        folder = urdf.path.parent if urdf.path else None
        path = find_urdf(geometry.mesh.filename.removeprefix("file://"), relative_to=folder)
        if path.suffix.lower() not in MESH_FORMATS:
            raise ValueError(f"{path.name} is not one of {', '.join(MESH_FORMATS)}")
        scale = np.broadcast_to(1.0 if geometry.mesh.scale is None else geometry.mesh.scale, 3)
        return Shape("mesh", tuple(scale.tolist()), T, path, color)
    if geometry.box is not None:
        if len(geometry.box.size) != 3:
            raise ValueError(f"the size of a box is {geometry.box.size.tolist()}, not 3 numbers")
        return Shape("box", tuple(geometry.box.size.tolist()), T, color=color)
    if geometry.cylinder is not None:
        return Shape("cylinder", (geometry.cylinder.radius, geometry.cylinder.length), T, color=color)
    return Shape("sphere", (geometry.sphere.radius,), T, color=color)
