"""The rerun recording of a calibration with its views, and the folder of results."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal import files
from urdfcal.errors import OutputError
from urdfcal.output import charts
from urdfcal.output.arms import dh_extent
from urdfcal.output.entities import chart_view, log_overview
from urdfcal.output.exports.names import exported
from urdfcal.output.figure_files import FOLDER, earlier_figures, write_figures
from urdfcal.output.findings import Overview, headline, lenses_found, meaning
from urdfcal.output.palette import BACKGROUND, SPACE, VERDICT_COLORS
from urdfcal.output.report import write_report
from urdfcal.output.scene import ResidualTable, image_range
from urdfcal.output.stream import POSE, TIME, recorded
from urdfcal.output.texts import AS_GIVEN
from urdfcal.output.viewer import RECORDING
from urdfcal.output.viewpoint import around, filling, viewpoint
from urdfcal.output.workspace import MOVED
from urdfcal.result.calibration import FILE_NAME, Calibration, corrected_name

if TYPE_CHECKING:
    from pathlib import Path

    from rerun import RecordingStream

    from urdfcal.arrays import Floats
    from urdfcal.output.chart import Chart
    from urdfcal.output.workspace import Workspace
    from urdfcal.result.fitted import FittedCalibration

ROOT = "base"
"""Entity of the base link; all of a recording is in its frame."""
REPORT = "report.html"
REFUSED = "refused"
"""Folder, in that of the results, of the report on a calibration that failed its checks."""
# The view of the DH rows is at least so much wider than high: also where it fills the window.
_LANDSCAPE = 1.6
# What belongs to other tabs than the arm's.
_ELSEWHERE = ("plots", "charts", "banner", "texts", "workspace", "dh")


def write_results(
    calibration: FittedCalibration, folder: Path, overview: Overview | None, *, figures: str | None = None
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write corrected URDF, calibration.json, report and recording, all of them or nothing.

    Args:
        calibration: the result.
        folder: where to; made if need be. Results of an earlier run are replaced, and a report on a refused one goes.
        overview: what report and recording show; without it neither is written, and those of an earlier run go.
        figures: svg, pdf or png to have the report's figures as files, too, in the folder ``figures``.

    Returns:
        The files written, and notes such as meshes that the recording could not find, or exports of an earlier result.

    Raises:
        OutputError: the folder cannot be written, or the corrected URDF fails its checks.
    """
    urdf = calibration.calibrated_urdf()
    notes: tuple[str, ...] = ()
    drawn = overview is not None and figures is not None
    with files.staged(folder, [*_earlier(folder), *(earlier_figures(folder) if drawn else ())], FOLDER) as stage:
        files.write_bytes(stage / calibration.urdf_name, urdf)
        calibration.save(stage / FILE_NAME)
        if overview is not None:
            write_report(stage / REPORT, overview)
            notes = write_recording(stage / RECORDING, overview)
        names = sorted(path.name for path in stage.iterdir())
        if overview is not None and figures is not None:
            write_figures(stage, overview, figures)
    _forget_refused(folder)
    if not drawn and (folder / FOLDER).is_dir():
        notes = (*notes, f"{folder / FOLDER} is of an earlier result: --figures draws them anew")
    if stale := exported(folder, calibration.urdf_name):
        notes = (*notes, f"of an earlier result, to be exported anew: {', '.join(stale)}")
    return tuple(folder / name for name in names), notes


def _earlier(folder: Path) -> tuple[str, ...]:
    """Names of the files that an earlier run's result has in a folder."""
    result = [FILE_NAME, REPORT, RECORDING]
    files.settle(folder)
    with suppress(OutputError):  # there is none
        result.append(corrected_name(Calibration.load(folder).document.robot.urdf))
    return tuple(result)


def write_refused(calibration: FittedCalibration, folder: Path) -> Path:
    """Write the report on a calibration that is refused, apart from the results of an earlier one, and nothing else.

    Args:
        calibration: the result, which fails its assessment.
        folder: where results would go; made if need be.

    Returns:
        The report.

    Raises:
        CalibrationError: it is so far off that not even its errors are numbers.
        OutputError: the folder cannot be written.
    """
    overview, refused = Overview.of(calibration), folder / REFUSED
    with files.told(folder):
        folder.mkdir(exist_ok=True)
    with files.staged(refused) as stage:
        write_report(stage / REPORT, overview, refused=True)
    return refused / REPORT


def _forget_refused(folder: Path) -> None:
    refused = folder / REFUSED
    with files.told(refused):
        (refused / REPORT).unlink(missing_ok=True)
        if refused.is_dir() and not any(refused.iterdir()):
            refused.rmdir()


def write_recording(path: Path, overview: Overview) -> tuple[str, ...]:
    """Write a calibration as a rerun recording that brings its own layout of views.

    Args:
        path: the file, ``.rrd``; replaced in one step.
        overview: what to show.

    Returns:
        Warnings, such as meshes that were not found.

    Raises:
        OutputError: the file cannot be written.
    """
    name = overview.calibration.chain.name
    with files.replacing(path) as temporary, recorded(temporary, layout(overview), name) as stream:
        return log_overview(stream, overview, ROOT)


def log_calibration(
    stream: RecordingStream, calibration: FittedCalibration, entity_path: str = ROOT
) -> tuple[str, ...]:
    """Log everything there is to see of a calibration into a rerun stream.

    Args:
        stream: the caller's recording.
        calibration: what to show.
        entity_path: where in it; the base link's frame.

    Returns:
        Warnings, such as meshes that were not found.
    """
    return log_overview(stream, Overview.of(calibration), entity_path)


def layout(overview: Overview, active: int = 0) -> rrb.Blueprint:
    """Lay out the views of a recording.

    Args:
        overview: what is recorded.
        active: the tab to open with.
    """
    scene, calibration = overview.scene, overview.calibration
    times = charts.frame_times(calibration)
    images = [
        f"{ROOT}/cameras/{rr.escape_entity_path_part(camera.name)}/image" for camera in calibration.estimate.cameras
    ]
    # The images' own arrows would fill the space before the cameras.
    hidden = [expression for image in images for expression in (f"- {image}/**", f"+ {image}")]
    elsewhere = [f"- $origin/{name}/**" for name in _ELSEWHERE]
    arm = _space("Arm", ["+ $origin/**", *hidden, *elsewhere], *viewpoint(scene))
    unit = scene.tables[0].unit
    beside = rrb.Vertical(
        rrb.TextDocumentView(origin=f"{ROOT}/texts/about", name="What you see"),
        rrb.TimeSeriesView(
            origin=f"{ROOT}/plots/residual_{unit}",
            name=_curves(scene.tables[0], moved=times is not None),
            axis_x=None if times is None else _all_of(times),
            plot_legend=rrb.PlotLegend(visible=False),  # it would cover the curves
        ),
        row_shares=[3, 1],
    )
    both = rrb.Horizontal(arm, beside, column_shares=[5, 2])
    tabs: list[rrb.Container | rrb.View] = [
        rrb.Vertical(_banner(overview), both, row_shares=[1, 13], name="Arm"),
    ]
    if scene.pixels is not None:
        views = _images(images, overview, scene.pixels)
        grid = rrb.Grid(*views, grid_columns=len(views) // len(images))
        # Of targets there is more to say.
        tabs.append(_above("pixels", grid, 4 if calibration.session.targets else 5))
    tabs += [
        _grid("convergence", charts.convergence_charts(calibration)),
        *([_above("joints", _causes(joints), 6)] if (joints := charts.joint_charts(calibration)) else []),
        *_parameters(calibration),
        _rows(overview),
        _grid("residuals", charts.residual_charts(overview)),
        _workspace(overview),
    ]
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=active),
        # Poses one by one, twice a second; an arm that moved as it did.
        rrb.TimePanel(state="collapsed", timeline=POSE if times is None else TIME, play_state="paused", fps=2.0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _curves(table: ResidualTable, *, moved: bool) -> str:
    """The title of the residuals' curves: rerun often leaves but the zero on their axis."""
    largest = max(float(np.max(table.rms_by(table.pose, of)[1], initial=0.0)) for of in table.by_arm.values())
    # Their axis is then that of the frames' times: on the timeline pose it is empty. Of more frames than the screen has
    # columns the viewer draws means.
    of, drawn = ("frame (timeline time)", "; means") if moved else ("pose", "")
    return f"rms by {of}: up to {largest:.2g} {table.unit}{drawn}"


def _all_of(times: Floats) -> rrb.archetypes.TimeAxis:
    """An axis from the first to the last of the times (N,). [s]."""
    ends = (rr.TimeRangeBoundary.absolute(seconds=float(of)) for of in (times.min(), times.max()))
    return rrb.archetypes.TimeAxis(view_range=rr.TimeRange(*ends))


def _banner(overview: Overview) -> rrb.View:
    """A stripe in the verdict's colour; its text is the title, legible on dark and on light screens."""
    assessment = overview.calibration.assessment
    number = f"{headline(overview.document)} {meaning(overview.document)}"
    return rrb.Spatial2DView(
        origin=f"{ROOT}/banner", name=f"{assessment.sentence}  {number}", background=VERDICT_COLORS[assessment.level]
    )


def _parameters(calibration: FittedCalibration) -> list[rrb.Container]:
    bars = [chart_view(chart, ROOT) for chart in charts.parameter_charts(calibration)]
    return [_above("parameters", rrb.Horizontal(*bars), 9)] if bars else []


def _rows(overview: Overview) -> rrb.Container:
    """The DH rows drawn to scale above their table, which needs the window's width."""
    table, scene = overview.calibration.table, overview.scene
    labels = [f"{ROOT}/dh/rows/{name}{i + 1}/label" for i in range(len(table.labels)) for name in "da"]
    eye, target = viewpoint(scene)
    arm = _space(
        "DH rows to scale: d blue, along z; a red, along x",
        ["+ $origin/dh/**", "+ $origin/led/predicted"],
        *filling(dh_extent(table, scene), target - eye, _LANDSCAPE),
        overrides={label: rr.Points3D.from_fields(show_labels=True) for label in labels},
    )
    text = rrb.TextDocumentView(origin=f"{ROOT}/texts/rows", name="Nominal, offset ± standard deviation")
    return rrb.Vertical(arm, text, row_shares=[3, 2], name="DH rows")


def _workspace(overview: Overview) -> rrb.Container:
    rows = [rrb.Horizontal(*_clouds(of, further=k > 0)) for k, of in enumerate(overview.workspaces)]
    first, *others = charts.workspace_charts(overview.workspaces)
    first = replace(first, title=f"{first.title}; bar: all clouds [mm]")
    shares = [chart_view(chart, ROOT) for chart in (first, *others)]
    below = rrb.Horizontal(*shares, _text("workspace"))
    return rrb.Vertical(*rows, below, row_shares=[*([6 // len(rows)] * len(rows)), 4], name="Workspace")


def _clouds(workspace: Workspace, *, further: bool) -> list[rrb.View]:
    """The workspace of the first tip or of a further one: nominal, calibrated, and what joint models move."""
    eye, middle = around(workspace.tip, np.array([0.8, -1.0, 0.5]))
    folder = f"workspace/{rr.escape_entity_path_part(workspace.link)}" if further else "workspace"
    views = []
    what_of = {"nominal": "off", "calibrated": "sigma", MOVED: "moved"}  # three titles fit beside each other
    for name, error in workspace.errors.items():
        low, high = (f"{1e3 * end:.2g}" for end in (error.min(), error.max()))
        # What is moved by less than a hundredth of that is drawn as if by as much.
        size = f"up to {high}" if name == MOVED else f"{low} to {high}"
        title = f"{workspace.link}, {name}: {size} mm {what_of[name]}"
        views.append(
            _space(
                title,
                [f"+ $origin/{folder}/{rr.escape_entity_path_part(name)}", "+ $origin/calibrated/**"],
                eye,
                middle,
            )
        )
    return views


def _grid(name: str, shown: list[Chart]) -> rrb.Container:
    return rrb.Grid(*(chart_view(chart, ROOT) for chart in shown), _text(name), name=name.capitalize())


def _above(name: str, shown: rrb.Container, times: int) -> rrb.Container:
    """Views above their text, so many times as high as it."""
    return rrb.Vertical(shown, _text(name), row_shares=[times, 1], name=name.capitalize())


def _causes(shown: list[Chart]) -> rrb.Container:
    """What was wrong with the arm, which has names to read, beside the charts of its joints."""
    first, *others = shown
    if not others:
        return _charts(shown)
    return rrb.Horizontal(chart_view(first, ROOT), _charts(others), column_shares=[2, 3])


def _charts(shown: list[Chart]) -> rrb.Container:
    return rrb.Grid(*(chart_view(chart, ROOT) for chart in shown))


def _text(name: str) -> rrb.View:
    return rrb.TextDocumentView(origin=f"{ROOT}/texts/{name}", name="How to read this")


def _images(images: list[str], overview: Overview, pixels: ResidualTable) -> list[rrb.View]:
    """The residuals of all poses of each camera: nominal, calibrated alike, and enlarged; with the arm of this pose."""
    scene, cameras = overview.scene, overview.calibration.estimate.cameras
    as_given = f" {AS_GIVEN}" if lenses_found(overview.document) else ""
    of_arm = {
        "nominal": ("arm/nominal", "nominal", "residual\\ nominal"),
        "calibrated": ("arm/calibrated", "predicted"),
    }
    kinds = [("nominal", scene.pixel_factor, "field\\ nominal", "scale")]
    kinds.append(("calibrated", scene.pixel_factor, "field", "scale"))
    if scene.field_factor > scene.pixel_factor:
        kinds.append(("calibrated", scene.field_factor, "field\\ enlarged", "scale\\ enlarged"))
    among = ("field", "field\\ nominal", "field\\ enlarged", "scale", "scale\\ enlarged")
    views: list[rrb.View] = []
    for c, (image, camera) in enumerate(zip(images, cameras, strict=True)):
        seen = pixels.measured[pixels.camera == c]
        u, v = image_range(camera.resolution, seen)
        for what, factor, *shown in kinds:
            others = (name for arm, names in of_arm.items() if arm != what for name in names)
            hidden = (*others, *(name for name in among if name not in shown))
            views.append(
                rrb.Spatial2DView(
                    origin=image,
                    contents=["+ $origin/**", *(f"- $origin/{name}" for name in hidden)],
                    name=f"{camera.name} {what}{as_given if what == 'nominal' else ''} ({factor:g} x)",
                    visual_bounds=rrb.VisualBounds2D(x_range=u, y_range=v),
                    background=BACKGROUND,
                )
            )
    return views


def _space(name: str, contents: list[str], eye: Floats, target: Floats, **more: Any) -> rrb.View:
    controls = rrb.EyeControls3D(position=eye, look_target=target, eye_up=[0, 0, 1])
    return rrb.Spatial3DView(origin=ROOT, contents=contents, name=name, eye_controls=controls, background=SPACE, **more)
