"""Which views a recording opens with, and from where the arm is looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal.output import charts
from urdfcal.output.findings import HEADLINE, headline
from urdfcal.output.palette import BACKGROUND, VERDICT_COLORS
from urdfcal.output.plots import chart_view
from urdfcal.output.scene import image_range
from urdfcal.output.stream import POSE

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.output.chart import Chart
    from urdfcal.output.findings import Overview
    from urdfcal.output.fitted import ResidualTable
    from urdfcal.output.scene import CalibrationScene

# rerun's eye opens 55 degrees high; on a laptop's screen the view is at least so much wider than high.
_HALF_VIEW = np.radians(55 / 2)
_ASPECT = 1.2
# What belongs to other tabs than the arm's.
_ELSEWHERE = ("plots", "charts", "banner", "texts", "workspace")


def layout(root: str, overview: Overview, active: int = 0) -> rrb.Blueprint:
    """Lay out the views of a recording.

    Args:
        root: entity of the base link.
        overview: what is recorded.
        active: the tab to open with.
    """
    scene, calibration = overview.scene, overview.calibration
    parent = f"{root}/charts"
    images = [f"{root}/cameras/{rr.escape_entity_path_part(camera.name)}/image" for camera in scene.arm.cameras]
    arm = rrb.Horizontal(_arm(root, images, scene), _beside_arm(root, scene), column_shares=[3, 1])
    tabs: list[rrb.Container | rrb.View] = [
        rrb.Vertical(_banner(root, overview), arm, row_shares=[1, 13], name="Arm"),
    ]
    if scene.pixels is not None:
        tabs.append(rrb.Grid(*_images(images, overview, scene.pixels), grid_columns=len(images), name="Pixels"))
    tabs += [
        _grid(root, "convergence", charts.convergence_charts(calibration)),
        _parameters(root, parent, overview),
        _grid(root, "residuals", charts.residual_charts(overview)),
        _workspace(root, parent, overview),
    ]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=active),
        rrb.TimePanel(state="collapsed", timeline=POSE, play_state="paused", fps=2.0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _banner(root: str, overview: Overview) -> rrb.View:
    """A stripe in the verdict's colour; its text is the title, legible on dark and on light screens."""
    assessment = overview.assessment
    number = f"{headline(overview.document)} {HEADLINE}"
    return rrb.Spatial2DView(
        origin=f"{root}/banner", name=f"{assessment.sentence}  {number}", background=VERDICT_COLORS[assessment.level]
    )


def _arm(root: str, images: list[str], scene: CalibrationScene) -> rrb.View:
    # The images' own arrows would fill the space before the cameras.
    hidden = [expression for image in images for expression in (f"- {image}/**", f"+ {image}")]
    elsewhere = [f"- $origin/{name}/**" for name in _ELSEWHERE]
    contents = ["+ $origin/**", *hidden, *elsewhere]
    return rrb.Spatial3DView(
        origin=root, contents=contents, name="Arm", eye_controls=_eye(*viewpoint(scene)), background=BACKGROUND
    )


def _beside_arm(root: str, scene: CalibrationScene) -> rrb.Container:
    unit = scene.tables[0].unit
    return rrb.Vertical(
        rrb.TextDocumentView(origin=f"{root}/texts/about", name="What you see"),
        rrb.TimeSeriesView(
            origin=f"{root}/plots/residual_{unit}", name=f"Residual of each pose, rms without outliers [{unit}]"
        ),
        row_shares=[3, 2],
    )


def _parameters(root: str, parent: str, overview: Overview) -> rrb.Container:
    table = overview.calibration.table
    rows = [f"{root}/dh/rows/{name}{i + 1}" for i in range(len(table.labels)) for name in "da"]
    reach = table.chain.reach
    towards = viewpoint(overview.scene)[0] - viewpoint(overview.scene)[1]
    target = overview.scene.frames[0, :, :3, 3].mean(axis=0)
    eye = target + 1.1 * reach * towards / np.linalg.norm(towards)
    arm = rrb.Spatial3DView(
        origin=root,
        contents=["+ $origin/dh/**", "+ $origin/led/predicted"],
        name="DH rows to scale: d along each joint's axis, a along the common normal to the next",
        eye_controls=_eye(eye, target),
        background=BACKGROUND,
        overrides={row: rr.LineStrips3D.from_fields(show_labels=True) for row in rows},
    )
    bars = [chart_view(chart, parent) for chart in charts.parameter_charts(overview.calibration)]
    text = rrb.TextDocumentView(origin=f"{root}/texts/parameters", name="DH rows: nominal, offset, standard deviation")
    return rrb.Horizontal(
        arm, rrb.Vertical(rrb.Horizontal(*bars), text, row_shares=[3, 2]), column_shares=[2, 3], name="Parameters"
    )


def _workspace(root: str, parent: str, overview: Overview) -> rrb.Container:
    workspace = overview.workspace
    reach = overview.calibration.chain.reach
    middle = (workspace.tip.min(axis=0) + workspace.tip.max(axis=0)) / 2
    eye = _eye(middle + 2.2 * reach * np.array([0.8, -1.0, 0.5]) / np.linalg.norm([0.8, -1.0, 0.5]), middle)
    tips = overview.calibration.chain.tips
    tip = "tip" if len(tips) == 1 else tips[0].link
    found = (
        ("nominal", f"Nominal: distance to the calibrated {tip}", workspace.before),
        ("calibrated", "Calibrated: predicted standard deviation", workspace.after),
    )
    smallest, largest = (1e3 * limit for limit in workspace.range)
    scale = f"violet {smallest:.2g}, yellow {largest:.2g} mm; small: not measured"
    views = [
        rrb.Spatial3DView(
            origin=root,
            contents=[f"+ $origin/workspace/{name}", "+ $origin/calibrated/**"],
            name=f"{title}, {1e3 * error.min():.2g} to {1e3 * error.max():.2g} mm ({scale})",
            eye_controls=eye,
            background=BACKGROUND,
        )
        for name, title, error in found
    ]
    shares = chart_view(charts.workspace_chart(workspace), parent)
    return rrb.Vertical(rrb.Horizontal(*views), shares, row_shares=[3, 2], name="Workspace")


def _grid(root: str, name: str, shown: list[Chart]) -> rrb.Container:
    text = rrb.TextDocumentView(origin=f"{root}/texts/{name}", name="How to read this")
    return rrb.Grid(*(chart_view(chart, f"{root}/charts") for chart in shown), text, name=name.capitalize())


def _images(images: list[str], overview: Overview, pixels: ResidualTable) -> list[rrb.View]:
    """The residuals of all poses, nominal above and calibrated below, with the arm of this pose."""
    scene, cameras = overview.scene, overview.scene.arm.cameras
    views: list[rrb.View] = []
    for what, factor, hidden in (
        ("nominal", scene.pixel_factor, ("field", "arm/calibrated", "predicted")),
        ("calibrated", scene.field_factor, ("field\\ nominal", "arm/nominal", "nominal", "residual\\ nominal")),
    ):
        for c, (image, camera) in enumerate(zip(images, cameras, strict=True)):
            seen = pixels.measured[pixels.camera == c]
            u, v = image_range(camera.resolution, seen)
            views.append(
                rrb.Spatial2DView(
                    origin=image,
                    contents=["+ $origin/**", *(f"- $origin/{name}" for name in hidden)],
                    name=f"{camera.name} {what}: residuals {factor:g} x",
                    visual_bounds=rrb.VisualBounds2D(x_range=u, y_range=v),
                    background=BACKGROUND,
                )
            )
    return views


def _eye(position: Floats, target: Floats) -> rrb.EyeControls3D:
    return rrb.EyeControls3D(position=position, look_target=target, eye_up=[0, 0, 1])


def viewpoint(scene: CalibrationScene) -> tuple[Floats, Floats]:
    """Find a place from which arm, LEDs and cameras are all in view, cameras to one side.

    Returns:
        The eye and the point it looks at, (3,) each, in the base link's frame. [m]
    """
    arm = scene.frames[..., :3, 3].reshape(-1, 3)
    cameras = scene.views[..., :3, 3].reshape(-1, 3)
    points = np.concatenate([arm, scene.leds.measured[~scene.leds.outlier], cameras])
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    forward = -_beside(cameras.mean(axis=0) - arm.mean(axis=0) if len(cameras) else np.zeros(3))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = points - target
    wide, high = np.abs(away @ right) / _ASPECT, np.abs(away @ np.cross(right, forward))
    distance = float(np.max(np.maximum(wide, high) / np.tan(_HALF_VIEW) - away @ forward))
    return target - 1.1 * distance * forward, target


def _beside(towards: Floats) -> Floats:
    """A direction across ``towards`` and somewhat up, (3,) unit."""
    across = np.array([towards[1], -towards[0], 0.0])
    if not np.linalg.norm(across) > 0.0:
        across = np.array([1.0, 0.0, 0.0])
    direction = across / np.linalg.norm(across) + [0.0, 0.0, 0.4]
    result: Floats = direction / np.linalg.norm(direction)
    return result
