"""Which views a recording opens with, and from where the arm is looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal.output.stream import POSE

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.calibration import Calibration
    from urdfcal.output.scene import Scene

# rerun's eye opens 55 degrees high; on a laptop's screen the view is at least so much wider than high.
_HALF_VIEW = np.radians(55 / 2)
_ASPECT = 1.2


def layout(root: str, calibration: Calibration, scene: Scene) -> rrb.Blueprint:
    """Lay out the views of a recording.

    Args:
        root: entity of the base link.
        calibration: what is recorded.
        scene: where things stand.
    """
    cameras = [rr.escape_entity_path_part(camera.name) for camera in calibration.estimate.cameras]
    images = [f"{root}/cameras/{name}/image" for name in cameras]
    tabs: list[rrb.Container | rrb.View] = [
        rrb.Horizontal(_arm(root, images, scene), _plots(root, scene), column_shares=[3, 1], name="Arm")
    ]
    if scene.pixels is not None:
        enlarged = f"residuals {scene.field_factor:g} x, nominal (blue) {scene.pixel_factor:g} x"
        pictures = [
            _picture(image, f"{camera.name}: {enlarged}", camera.resolution)
            for image, camera in zip(images, calibration.estimate.cameras, strict=True)
        ]
        tabs.append(rrb.Grid(*pictures, name="Pixels"))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline=POSE, play_state="paused", fps=2.0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _arm(root: str, images: list[str], scene: Scene) -> rrb.View:
    eye, target = viewpoint(scene)
    # The pictures' own arrows would fill the space before the cameras.
    hidden = [expression for image in images for expression in (f"- {image}/**", f"+ {image}")]
    return rrb.Spatial3DView(
        origin=root,
        contents=["+ $origin/**", *hidden, "- $origin/plots/**"],
        name="Arm",
        eye_controls=rrb.EyeControls3D(position=eye, look_target=target, eye_up=[0, 0, 1]),
    )


def _plots(root: str, scene: Scene) -> rrb.Container:
    unit = "mm" if scene.pixels is None else "px"
    return rrb.Vertical(
        rrb.TextDocumentView(origin=f"{root}/about", name="What you see"),
        rrb.TimeSeriesView(
            origin=f"{root}/plots/residual_{unit}", name=f"Residual of each pose, rms without outliers [{unit}]"
        ),
        rrb.Tabs(
            _bars(f"{root}/plots/rms_{unit}", f"Residual by iteration, rms [{unit}]"),
            _bars(f"{root}/plots/cost", "Cost by iteration"),
        ),
        row_shares=[2, 3, 2],
    )


def _bars(plot: str, name: str) -> rrb.View:
    return rrb.BarChartView(origin=f"{plot}/bars", name=name, plot_legend=rrb.PlotLegend(visible=False))


def _picture(image: str, name: str, resolution: tuple[int, int]) -> rrb.View:
    width, height = resolution
    bounds = rrb.VisualBounds2D(x_range=[0, width], y_range=[0, height])
    return rrb.Spatial2DView(origin=image, name=name, visual_bounds=bounds)


def viewpoint(scene: Scene) -> tuple[Floats, Floats]:
    """Find a place from which arm, LEDs and cameras are all in view, cameras to one side.

    Returns:
        The eye and the point it looks at, (3,) each, in the base link's frame. [m]
    """
    arm = scene.frames[..., :3, 3].reshape(-1, 3)
    cameras = scene.T_base_cam[:, :3, 3]
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
