"""The results of a study as files: table, page and recording."""

from __future__ import annotations

import csv
import io
from datetime import datetime, timezone
from importlib.metadata import version
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal import files
from urdfcal.output.entities import chart_view, log_chart
from urdfcal.output.page import template
from urdfcal.output.recording import ROOT
from urdfcal.output.stream import Layer, recorded
from urdfcal.output.svg import Figure, figure_html
from urdfcal.study.charts import study_charts

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from urdfcal.output.chart import Chart
    from urdfcal.session.rig_description import RigDescription
    from urdfcal.study.monte_carlo import Outcome

TABLE, REPORT, RECORDING = "study.csv", "study.html", "study.rrd"
"""Files, in the folder of the results."""
HEADS = ("setting", "poses", "tip, rms (mm)", "1 in 10 above (mm)", "expected (mm)", "nominal (mm)", "arms")
"""Of a table for people."""
# Fewer arms have no tenth.
_TEN = 10
_EMPTY = "1 in 10 above: of ten arms or more (--seeds)"
_CURVES = "Dots: the tip's error of each arm; green: their rms; blue: expected, from the noise and the tolerances."
# Charts beside each other on a page, and how high they are there.
_ROW, _HEIGHT = 2, 220.0


def write_study(folder: Path, rig: RigDescription, table: Sequence[Outcome], seed: int) -> tuple[Path, ...]:
    """Write a study's table, page and recording, all of them or nothing.

    Args:
        folder: where to; made if need be. Those of an earlier study are replaced.
        rig: that was studied.
        table: what came out.
        seed: of the first arm.

    Returns:
        The files.

    Raises:
        OutputError: the folder cannot be written.
    """
    charts = study_charts(rig, table)
    with files.staged(folder, (TABLE, REPORT, RECORDING)) as stage:
        files.write_text(stage / TABLE, as_csv(table))
        files.write_text(stage / REPORT, _page(rig, table, charts, seed))
        _write_recording(stage / RECORDING, rig, table, charts)
    return tuple(folder / name for name in (TABLE, REPORT, RECORDING))


def as_csv(table: Sequence[Outcome]) -> str:
    """Write a table: what is varied and to what, empty for the rig as it is; errors in m."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["varied", "value", "poses", "arms", "error", "worst", "expected", "nominal", "failed"])
    for one in table:
        of = one.setting
        figures = (one.error, one.worst, one.expected, one.nominal) if one.arms else ("",) * 4
        varied = ("", "") if of.varied is None else (of.varied, f"{of.value:g}")
        writer.writerow([*varied, one.poses, len(one.arms), *figures, "; ".join(one.failed)])
    return text.getvalue()


def rows(table: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """Write each setting for people, below :data:`HEADS`. [mm]."""
    return [
        (
            str(one.setting),
            str(one.poses),
            *(
                _mm(of) if len(one.arms) >= least else ""
                for of, least in ((one.error, 1), (one.worst, _TEN), (one.expected, 1), (one.nominal, 1))
            ),
            str(len(one.arms)),
        )
        for one in table
    ]


def remarks(table: Sequence[Outcome]) -> list[str]:
    """Say why a column is empty, if it is."""
    return [_EMPTY] if any(0 < len(one.arms) < _TEN for one in table) else []


def failures(table: Sequence[Outcome]) -> list[str]:
    """Say why arms could not be simulated."""
    return [f"{one.setting}: {why}" for one in table for why in one.failed]


def _page(rig: RigDescription, table: Sequence[Outcome], charts: Sequence[Chart], seed: int) -> str:
    from markupsafe import Markup

    pairs = [charts[k : k + _ROW] for k in range(0, len(charts), _ROW)]
    return template("study/report.html.jinja").render(
        name=rig.chain.name,
        heads=HEADS,
        rows=rows(table),
        failed=failures(table),
        figure=Markup(figure_html(Figure(pairs, _HEIGHT))) if charts else "",  # noqa: S704  # made by us, labels escaped
        seed=seed,
        version=version("urdfcal"),
        date=f"{datetime.now(timezone.utc):%Y-%m-%d}",
    )


def _write_recording(path: Path, rig: RigDescription, table: Sequence[Outcome], charts: Sequence[Chart]) -> None:
    lines = ["| " + " | ".join(row) + " |" for row in (HEADS, ("---",) * len(HEADS), *rows(table))]
    text = "\n".join([*lines, "", _CURVES, "", *(f"- {text}" for text in (*remarks(table), *failures(table)))])
    views = [chart_view(chart, ROOT) for chart in charts]
    document = rrb.TextDocumentView(origin=f"{ROOT}/texts/table", name="Settings")
    grid = rrb.Grid(document, *views, grid_columns=int(np.ceil(np.sqrt(len(views) + 1))))
    layout = rrb.Blueprint(grid, collapse_panels=True)
    with recorded(path, layout, f"{rig.chain.name}, studied") as stream:
        base = Layer(stream, ROOT, 0)
        base.at("texts", "table").fixed(rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
        for chart in charts:
            log_chart(base.at("charts"), chart)


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.3g}"
