"""The rerun recording of a plan: the arm in each pose, what each pose brings, and the tip's expected error."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal import files
from urdfcal.output import palette
from urdfcal.output.arms import log_links, log_sticks, visible_links
from urdfcal.output.chart import Chart, Mark, Scale
from urdfcal.output.entities import chart_view, log_chart, log_frustum
from urdfcal.output.placing import joint_frames
from urdfcal.output.recording import ROOT
from urdfcal.output.stream import POSE, Layer, placed, recorded
from urdfcal.output.viewpoint import eye_on
from urdfcal.planning.files import labels
from urdfcal.robot.kinematics import tip_poses

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.planning.planner import Plan

# As in the recording of a calibration: points on the screen instead of metres.
_DOT, _SMALL_DOT, _THIN = -4.0, -2.0, -0.8
# A move is drawn in so many pieces.
_STEPS = 20
_FROM = np.array([0.8, -1.0, 0.5])
_BOX = (*palette.FAINT, 90)
_ABOUT = """\
Each dot is a place of the workspace that the plan is for; its colour is the tip's expected rms error there, before and
after, in mm, as in the bar. Blue: by what is measured so far; green: with the planned poses.
"""
_LEGEND = """

Green dots: where the tip is in the poses to be measured; white: in those to check by, and the LEDs in this pose. Lines:
the tip's way from pose to pose, and the cameras' rays to the LEDs. Curves, by how many poses are measured: the tip's
expected rms error over the workspace (green), and what nine arms in ten stay below (blue).
"""


def write_plan(path: Path, plan: Plan) -> tuple[str, ...]:
    """Write a plan as a rerun recording that brings its own layout of views.

    Args:
        path: the file, ``.rrd``; replaced in one step.
        plan: what to show.

    Returns:
        Warnings, such as meshes that were not found.

    Raises:
        OutputError: the file cannot be written.
    """
    name = f"{plan.chain.name}, planned"
    with files.replacing(path) as temporary, recorded(temporary, _layout(plan), name) as stream:
        base = Layer(stream, ROOT, len(plan.q))
        base.fixed(rr.ViewCoordinates.RIGHT_HAND_Z_UP, rr.TransformAxes3D(axis_length=0.1 * plan.chain.reach))
        warnings = _log_arm(base, plan)
        _log_sightings(base, plan)
        _log_workspace(base, plan)
        _log_texts(base, plan)
        return warnings


def _log_arm(base: Layer, plan: Plan) -> tuple[str, ...]:
    """Log the arm as believed in each pose, the way of its tip, and the boxes around."""
    frames = joint_frames(plan.chain, plan.scene.placements, plan.q)
    bodies, warnings = visible_links(plan.setup.urdf, plan.chain) if plan.setup.urdf else ((), ())
    log_links(base.at("arm"), bodies, frames)
    if warnings or not bodies:
        log_sticks(base.at("arm"), plan.chain, frames, palette.CALIBRATED)
    for box in plan.setup.scene:
        layer, fill = base.at("boxes", box.name), rr.components.FillMode.TransparentFillMajorWireframe
        layer.fixed(placed(box.T_base_box), rr.Boxes3D(sizes=[box.size], colors=_BOX, fill_mode=fill, labels=box.name))
    tip = _tips(plan, plan.q)
    base.at("tips", "way").fixed(rr.LineStrips3D([_tips(plan, way(plan.q))], colors=palette.FAINT, radii=_THIN))
    for name, which, color in (
        ("planned", plan.rank >= 0, palette.CALIBRATED),
        ("to check by", plan.check, palette.MEASURED),
    ):
        base.at("tips", name).fixed(rr.Points3D(tip[which], colors=color, radii=_DOT))
    return warnings


def _log_sightings(base: Layer, plan: Plan) -> None:
    """Log cameras, LEDs, and where something is measured the rays between them."""
    scene, attachments = plan.scene, plan.scene.attachments
    views, leds = scene.camera_poses(plan.q), scene.outlined().led_positions(plan.q)
    measured, count = np.flatnonzero(plan.measured), leds.shape[1]
    base.at("led").each(
        rr.Points3D,
        {"positions": leds.reshape(-1, 3)},
        np.repeat(np.arange(len(leds)), count),
        colors=palette.MEASURED,
        radii=_DOT,
    )
    for c, camera in enumerate(scene.cameras):
        distance = float(np.median(np.linalg.norm(leds - views[c, :, None, :3, 3], axis=-1)))
        frame = attachments.camera[c]
        log_frustum(
            base.at("cameras", camera.name), camera, views[c], distance, attachments.frames[frame] if frame else None
        )
        centres = np.broadcast_to(views[c, measured, None, :3, 3], leds[measured].shape)
        strips = np.stack([centres, leds[measured]], axis=2).reshape(-1, 2, 3).astype(np.float32)
        rays = base.at("rays", camera.name)
        rays.each(rr.LineStrips3D, {"strips": strips}, np.repeat(measured, count), colors=palette.FAINT, radii=_THIN)


def _log_workspace(base: Layer, plan: Plan) -> None:
    """Log the tip's places over the workspace in the colours of its expected error, on one scale before and after."""
    tip, scale = _tips(plan, plan.outlook.q), _colors(plan)
    for name, error in (("before", plan.outlook.before), ("after", plan.outlook.after)):
        colors = palette.viridis(np.clip(scale.share(1e3 * error), 0.0, 1.0))
        base.at("workspace", name).fixed(rr.Points3D(tip, colors=colors, radii=_DOT))
    for chart in (_course(plan), _shares(plan)):
        log_chart(base.at("charts"), chart)


def _log_texts(base: Layer, plan: Plan) -> None:
    """Log what each pose is for, and how to read the workspace."""
    texts, markdown = base.at("texts"), rr.MediaType.MARKDOWN
    said = [f"{_said(plan, *row)}{_LEGEND}" for row in zip(*_rows(plan), strict=True)]
    texts.at("about").each(rr.TextDocument, {"text": said}, media_type=markdown)
    texts.at("workspace").fixed(rr.TextDocument(_ABOUT, media_type=markdown))


def _rows(plan: Plan) -> tuple[list[str], list[int], list[str]]:
    """Label, rank, and what it brings, of each pose."""
    errors = [f"{1e3 * error:.3g}" for error in plan.errors]
    # The first poses alone may only place the base and the LEDs.
    steps = [f"stays {a} mm" if a == b else f"goes from {a} to {b} mm" for a, b in pairwise(errors)]
    rank = plan.rank.tolist()
    return labels(plan), rank, [steps[k] if k >= 0 else "" for k in rank]


def _said(plan: Plan, label: str, rank: int, brings: str) -> str:
    if rank >= 0:
        return (
            f"**Pose {label}**: to be measured.\n\nOf the {plan.count} it is number {rank + 1} by what it brings: with "
            f"those before it, the tip's expected rms error {brings}. (The timeline counts in the order of the moves.)"
        )
    if label.startswith("check"):
        return f"**Pose {label}**: to be measured to check the calibration by, and left out of it."
    return f"**Pose {label}** only leads around something: nothing is to be measured."


def _course(plan: Plan) -> Chart:
    """The tip's expected error by number of poses."""
    number = np.arange(0.0, len(plan.errors))
    likely, error = 1e3 * plan.likely, 1e3 * plan.errors
    marks = [
        Mark("hairlines", "nine in ten", number, likely, palette.NOMINAL),
        Mark("lines", "expected", number, error, palette.CALIBRATED),
        Mark("dots", "poses", number, error, palette.CALIBRATED),
    ]
    x, y = Scale.holding(number, whole=True), Scale.holding(error, likely)
    return Chart("course", "Tip's expected error [mm]", x, y, marks, "poses measured")


def _shares(plan: Plan) -> Chart:
    """The share of the workspace that has an expected error below a value, before and after."""
    share, colors = np.linspace(0.0, 100.0, len(plan.outlook.q)), _colors(plan)
    marks = [
        Mark("lines", name, 1e3 * np.sort(error), share, color)
        for name, error, color in (
            ("before", plan.outlook.before, palette.NOMINAL),
            ("after", plan.outlook.after, palette.CALIBRATED),
        )
    ]
    title = "% of the workspace below; bar: colours of both clouds [mm]"
    return Chart("shares", title, colors, Scale(0.0, 100.0), marks, "expected error [mm]", colors=colors)


def _colors(plan: Plan) -> Scale:
    """What the colours of errors stand for. [mm]."""
    return Scale.holding(1e3 * plan.outlook.before, 1e3 * plan.outlook.after, logarithmic=True, room=0.0)


def _layout(plan: Plan) -> rrb.Blueprint:
    reach, tip = plan.chain.reach, _tips(plan, plan.outlook.q)
    middle = (tip.min(axis=0) + tip.max(axis=0)) / 2
    eye = middle + 2.2 * reach * _FROM / np.linalg.norm(_FROM)

    def space(name: str, contents: list[str], eye: Floats = eye, target: Floats = middle) -> rrb.View:
        controls = rrb.EyeControls3D(position=eye, look_target=target, eye_up=[0, 0, 1])
        return rrb.Spatial3DView(
            origin=ROOT, contents=contents, name=name, eye_controls=controls, background=palette.SPACE
        )

    arm = joint_frames(plan.chain, plan.scene.placements, plan.q)[..., :3, 3].reshape(-1, 3)
    cameras = plan.scene.camera_poses(plan.q)[..., :3, 3].reshape(-1, 3)
    onto = eye_on(arm, cameras, np.concatenate([arm, cameras]))
    around = [f"+ $origin/{of}/**" for of in ("arm", "boxes", "tips", "led", "cameras", "rays")]
    beside = rrb.Vertical(
        rrb.TextDocumentView(origin=f"{ROOT}/texts/about", name="This pose"),
        chart_view(_course(plan), ROOT),
        row_shares=[1, 2],
    )
    clouds = [
        space(f"{name}: {1e3 * np.sqrt(np.mean(error**2)):.3g} mm rms", [f"+ $origin/workspace/{name}"])
        for name, error in (("before", plan.outlook.before), ("after", plan.outlook.after))
    ]
    text = rrb.TextDocumentView(origin=f"{ROOT}/texts/workspace", name="How to read this")
    return rrb.Blueprint(
        rrb.Tabs(
            rrb.Horizontal(space("The arm in each pose", around, *onto), beside, column_shares=[3, 1], name="Poses"),
            rrb.Vertical(
                rrb.Horizontal(*clouds),
                rrb.Horizontal(chart_view(_shares(plan), ROOT), text),
                row_shares=[3, 2],
                name="Workspace",
            ),
        ),
        rrb.TimePanel(state="collapsed", timeline=POSE, play_state="paused", fps=1.0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def way(q: Floats) -> Floats:
    """Joint values (M, n) along the moves from pose to pose (N, n), each straight in joint space. [rad or m]."""
    share = np.arange(0.0, 1.0, 1.0 / _STEPS)[:, None, None]
    between = q[:-1] + share * (q[1:] - q[:-1])
    return np.concatenate([np.swapaxes(between, 0, 1).reshape(-1, q.shape[1]), q[-1:]])


def _tips(plan: Plan, q: Floats) -> Floats:
    """The tip's places (N, 3) as the arm is believed to be. [m]."""
    return tip_poses(plan.chain, q, plan.scene.placements)[:, :3, 3]
