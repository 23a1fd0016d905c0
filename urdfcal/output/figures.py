"""The figures of the report, as SVG to stand in a page."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from urdfcal.output.palette import by_sigma
from urdfcal.output.scene import LENGTHS, UNITS, picture_range, rms_by_pose

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from urdfcal.arrays import Floats
    from urdfcal.output.scene import Scene, Sightings
    from urdfcal.output.workspace import Workspace
    from urdfcal.pipeline import FittedCalibration

# Darker than the recording's, on white paper.
_NOMINAL, _CALIBRATED, _INK, _FAINT = "#3d63c4", "#12875a", "#333333", "#c9c9c9"
# A4 between margins, in inches.
_WIDTH = 7.2
# More dots than this are drawn as one picture: an SVG of 50,000 circles stalls the browser.
_MANY = 2000
_CELLS = 24
# A portrait picture as wide as half the page would fill it. [in]
_TALLEST = 3.6
# Mean width of a letter of the figures' font at their size. [in]
_LETTER = 0.066
SYMBOLS = {"theta": "\u03b8", "alpha": "\u03b1", "beta": "\u03b2"}
# The report's own sans-serif: text stays text, so that it can be searched and looks like the page.
_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "urdfcal",
    "font.family": "sans-serif",
    "font.size": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "axes.titlesize": 8.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#ebebeb",
    "xtick.color": _INK,
    "ytick.color": _INK,
    "legend.frameon": False,
}


def draw(calibration: FittedCalibration, scene: Scene, workspace: Workspace) -> dict[str, str]:
    """Draw the figures of a report.

    Returns:
        SVG elements by name; those that the calibration has nothing for are left out.
    """
    import matplotlib as mpl

    with mpl.rc_context(_STYLE):
        drawn = {
            "residuals": _svg(_residuals(scene)),
            "corrections": _svg(_corrections(calibration)) if calibration.corrected else None,
            "workspace": _svg(_workspace(workspace)),
            "field": _svg(_field(calibration, scene, scene.pixels)) if scene.pixels else None,
            "convergence": _svg(_convergence(calibration)),
        }
    return {name: svg for name, svg in drawn.items() if svg is not None}


def _figure(height: float, columns: int, rows: int = 1, **spacing: Any) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure  # not pyplot, which keeps figures and looks for a screen

    figure = Figure(figsize=(_WIDTH, height))
    axes = figure.subplots(rows, columns, squeeze=False, **spacing)
    return figure, list(axes.ravel())


def _svg(figure: Figure) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    # The page gives the width; several figures share it, and ids such as "axes_1" would not be unique.
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    return re.sub(r'(<g|<image[^>]*?) id="[^"]*"', r"\1", svg)


def _residuals(scene: Scene) -> Figure:
    """Each pose's rms before and after, and the residuals' spread against the declared noise."""
    table = scene.tables[0]
    unit, scale = UNITS[table.measured.shape[1]]
    figure, (poses, spread) = _figure(2.5, 2, width_ratios=[3, 2])
    figure.subplots_adjust(left=0.07, right=0.99, bottom=0.17, top=0.9, wspace=0.16)
    used = ~table.outlier
    for name, predicted, color in (
        ("as drawn", table.nominal, _NOMINAL),
        ("calibrated", table.predicted, _CALIBRATED),
    ):
        residual = (predicted - table.measured)[used]
        pose, rms = rms_by_pose(table.pose[used], scale * residual)
        many = len(pose) > _MANY
        poses.plot(pose + 1, rms, "o", ms=1.5 if many else 3, color=color, label=name, rasterized=many)
        sigmas = (residual / table.sigma[used, None]).ravel()
        bins = np.linspace(-6, 6, 49)
        share = np.histogram(sigmas, bins)[0] / max(len(sigmas), 1) / np.diff(bins)
        spread.stairs(share, bins, color=color, fill=name == "calibrated", alpha=0.55 if name == "calibrated" else 1.0)
    expected = scale * float(np.sqrt(table.measured.shape[1]) * np.median(table.sigma))
    poses.axhline(expected, color=_INK, lw=0.8, ls="--")
    poses.text(1.0, expected, "declared noise", transform=poses.get_yaxis_transform(), ha="right", va="bottom")
    _logarithmic(poses)
    poses.set_xlabel("pose")
    poses.set_title(f"rms residual of each pose [{unit}]", loc="left")
    poses.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, borderpad=0.2, handletextpad=0.2)
    x = np.linspace(-6, 6, 121)
    spread.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=_INK, lw=0.8, ls="--")
    spread.set(xlabel="residual / declared standard deviation", yticks=[])
    spread.set_title("spread of the residuals", loc="left")
    return figure


def _corrections(calibration: FittedCalibration) -> Figure:
    """Every estimated offset with its 95 % interval, lengths and angles apart."""
    offsets, sigmas = calibration.estimate.offsets, calibration.sigmas()
    kinds = [
        [(row, name) for row, name in calibration.corrected if (name in LENGTHS) == lengths]
        for lengths in (True, False)
    ]
    height = 0.45 + 0.15 * max(map(len, kinds))
    figure, panels = _figure(height, 2)
    labels = [
        [f"{calibration.geometry.labels[row]}  {SYMBOLS.get(name, name)}" for row, name in kind] for kind in kinds
    ]
    # Labels stand left of both panels; the right one's first is short of a few points to spare.
    left = max(0.19, _LETTER / _WIDTH * max(len(label) for kind in labels for label in kind))
    gap = left - 0.017
    wspace = 2 * gap / (0.99 - left - gap)
    figure.subplots_adjust(left=left, right=0.99, bottom=0.22 / height, top=1 - 0.22 / height, wspace=wspace)
    for axes, kind, names, title in zip(panels, kinds, labels, ("lengths [mm]", "angles [mrad]"), strict=True):
        index = [(row, calibration.geometry.columns.index(name)) for row, name in kind]
        values = 1e3 * np.array([offsets[i] for i in index])
        errors = 1e3 * 1.96 * np.array([sigmas[i] for i in index])
        known = np.isfinite(errors)
        y = np.arange(len(kind))
        axes.axvline(0.0, color=_FAINT, lw=1)
        if known.any():
            axes.errorbar(
                values[known], y[known], xerr=errors[known], fmt="o", ms=3, color=_CALIBRATED, elinewidth=1.2, capsize=2
            )
        axes.plot(values[~known], y[~known], "x", ms=3.5, color=_NOMINAL)
        axes.set_yticks(y, names)
        axes.set_ylim(len(kind) - 0.4, -0.6)
        axes.set_title(title, loc="left")
        axes.grid(visible=False, axis="y")
    return figure


def _workspace(workspace: Workspace) -> Figure:
    """Tip error over the distance from the base's axis and the height, and how it is distributed."""
    radius, height = np.hypot(*workspace.tip[:, :2].T), workspace.tip[:, 2]
    maps = (("as drawn", workspace.before, _NOMINAL), ("calibrated", workspace.after, _CALIBRATED))
    figure, panels = _figure(2.6, 3)
    figure.subplots_adjust(left=0.06, right=0.99, bottom=0.16, top=0.9, wspace=0.36)
    shares = panels.pop()
    for axes, (name, error, color) in zip(panels, maps, strict=True):
        edges, cells = _binned(radius, height, 1e3 * error)
        picture = axes.pcolormesh(*edges, cells.T, cmap="viridis")
        axes.set(aspect="equal", xlabel="from the base's z axis [m]")
        axes.locator_params(axis="x", nbins=2, steps=[1, 2, 5, 10])
        axes.set_title(f"{name} [mm]", loc="left")
        figure.colorbar(picture, ax=axes, fraction=0.06, pad=0.03).outline.set(visible=False)
        shares.plot(1e3 * np.sort(error), np.linspace(0, 100, len(error)), color=color, label=name)
    panels[0].set_ylabel("height [m]")
    _logarithmic(shares, "x")
    shares.set(xlabel="tip error [mm]", ylim=(0, 100))
    shares.set_title("% of the workspace below", loc="left")
    shares.legend(loc="lower right")
    return figure


def _binned(x: Floats, y: Floats, values: Floats) -> tuple[tuple[Floats, Floats], Floats]:
    """Cells of a square grid and the median of the values in each, NaN in empty ones."""
    width = max(np.ptp(x), np.ptp(y)) / _CELLS
    edges = tuple(np.arange(a.min(), a.max() + 1.001 * width, width) for a in (x, y))
    column, row = (np.minimum(np.digitize(a, e) - 1, len(e) - 2) for a, e in zip((x, y), edges, strict=True))
    cells = np.full((len(edges[0]) - 1, len(edges[1]) - 1), np.nan)
    key = column * cells.shape[1] + row
    order = np.argsort(key, kind="stable")
    keys, first = np.unique(key[order], return_index=True)
    for k, group in zip(keys, np.split(values[order], first[1:]), strict=True):
        cells.flat[k] = np.median(group)
    return (edges[0], edges[1]), cells


def _field(calibration: FittedCalibration, scene: Scene, pixels: Sightings) -> Figure:
    """What is left of the residuals over each camera's picture: a bent field means a wrong lens."""
    cameras = calibration.estimate.cameras
    columns = min(3, len(cameras))
    rows = -(-len(cameras) // columns)
    views = [picture_range(camera.resolution, pixels.measured[pixels.camera == c]) for c, camera in enumerate(cameras)]
    shape = max((y[1] - y[0]) / (x[1] - x[0]) for x, y in views)
    size = rows * (min(_WIDTH / max(columns, 2) * shape, _TALLEST) + 0.25)
    figure, panels = _figure(size, columns, rows)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=1 - 0.25 / size, wspace=0.04, hspace=0.12)
    for axes in panels[len(cameras) :]:
        axes.set_visible(False)
    for c, (axes, camera, (x, y)) in enumerate(zip(panels, cameras, views, strict=False)):
        used = (pixels.camera == c) & ~pixels.outlier & np.isfinite(pixels.predicted[:, 0])
        at, residual = pixels.measured[used], (pixels.predicted - pixels.measured)[used]
        axes.quiver(
            *at.T,
            *(scene.field_factor * residual).T,
            color=0.8 * by_sigma(pixels.size[used]) / 255,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=0.004,
            rasterized=len(at) > _MANY,
        )
        cut = (pixels.camera == c) & pixels.outlier
        axes.plot(*pixels.measured[cut].T, "x", ms=4, color="#b030b0")
        w, h = camera.resolution
        axes.plot([0, w, w, 0, 0], [0, 0, h, h, 0], color=_FAINT, lw=1)
        axes.set(xlim=x, ylim=y[::-1], aspect="equal")
        axes.axis("off")
        rms = np.sqrt(np.mean(np.sum(residual**2, axis=1))) if len(residual) else np.nan
        axes.set_title(f"{camera.name}: {rms:.3g} px rms, arrows {scene.field_factor:g} x", loc="left")
    return figure


def _convergence(calibration: FittedCalibration) -> Figure:
    """Cost and step length of every iteration."""
    history = calibration.fit.history
    number = np.arange(1, len(history) + 1)
    figure, panels = _figure(1.9, 2)
    figure.subplots_adjust(left=0.07, right=0.99, bottom=0.22, top=0.88, wspace=0.16)
    for axes, values, title in zip(
        panels,
        ([step.cost for step in history], [step.step for step in history]),
        ("cost", "step, in standard deviations of the estimate"),
        strict=True,
    ):
        axes.plot(number, values, "o-", ms=3, lw=1, color=_CALIBRATED)
        if max(values) > 10 * min(values):
            _logarithmic(axes)
        axes.set_xlabel("iteration")
        axes.set_title(title, loc="left")
        axes.locator_params(axis="x", integer=True)
    return figure


def _logarithmic(axes: Axes, which: Literal["x", "y"] = "y") -> None:
    """A logarithmic axis with plain numbers, and some of them even where it spans less than a decade."""
    from matplotlib.ticker import LogLocator, NullLocator

    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axes.get_xlim() if which == "x" else axes.get_ylim()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 300 * low else (1.0,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())  # each minor tick costs as much as a major one
