"""Charts as SVG: a figure's beside each other on a page that may be narrow or dark, or all in one for a file.

As SVG text stays text, and nothing is fetched.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.output.palette import CALIBRATED, FAINT, INK, NOMINAL, OUTLIER, UNMEASURED, viridis

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from urdfcal.output.chart import Chart, Color, Mark, Scale

# Units of a figure whose page gives it a width: text of 11 looks like the page's.
_WIDTH, _FONT, _LETTER, _ROW = 720.0, 11, 6.4, 15.0
# A chart that stands alone is no wider, or a telephone's screen would make it too small to read.
_WIDEST = 420.0
_TOP, _BOTTOM, _LABEL, _RIGHT, _GAP = 24.0, 18.0, 15.0, 10.0, 12.0
_BAR, _BAR_ROOM = 7.0, 22.0
_WIDTHS = {"dots": 4.0, "lines": 1.3, "hairlines": 0.8, "bars": 1.0}
# The page has a light and a dark colour of each name; on paper, and in files, it is the one given here.
_NAMED: dict[tuple[int, ...], str] = {
    CALIBRATED: "var(--calibrated,#12875a)",
    NOMINAL: "var(--nominal,#3d63c4)",
    INK: "var(--axis,#555555)",
    OUTLIER: "var(--outlier,#b030b0)",
    FAINT: "var(--border,#96966f)",
    UNMEASURED: "var(--unmeasured,#cdcdcd)",
}
_AXIS, _GRID, _INK = "var(--axis,#555555)", "var(--grid,#ebebeb)", "var(--ink,#222222)"
_NAME = re.compile(r"var\(--\w+,(#\w+)\)")
# Shades of a colour that look the same share a path: 50,000 elements would stall the browser.
_SHADES = 12


@dataclass(frozen=True, eq=False)
class Figure:
    """Charts beside and below each other.

    Attributes:
        rows: the charts; those of a row have one height.
        height: of a row, where its charts' names do not need more. [720 are the page's width]
    """

    rows: Sequence[Sequence[Chart]]
    height: float


def figure_html(figure: Figure) -> str:
    """Draw a figure for a page: each chart by itself, so that they stand below each other where room is narrow."""
    rows = ("".join(_alone(chart, width, height) for chart, width, height in row) for row in _laid_out(figure))
    return "".join(f'<div class="charts">{row}</div>' for row in rows)


def figure_svg(figure: Figure) -> str:
    """Draw a figure for a file: one picture on white ground."""
    parts: list[str] = []
    top = right = 0.0
    for row in _laid_out(figure):
        left = 0.0
        for chart, width, height in row:
            parts += [f'<g transform="translate({left:.1f} {top:.1f})">', *_chart(chart, width, height), "</g>"]
            left += width + _GAP
        top, right = top + max(height for *_, height in row), max(right, left - _GAP)
    drawn = _NAME.sub(r"\1", "".join(parts))
    return _svg(f'<rect width="100%" height="100%" fill="#ffffff"/>{drawn}', right, top, ' fill="#222222"')


def _laid_out(figure: Figure) -> Iterator[list[tuple[Chart, float, float]]]:
    """The charts of each row with their widths and heights."""
    for row in figure.rows:
        names = max(len(chart.y.names or ()) for chart in row)
        unit = min(_WIDTH / sum(chart.breadth for chart in row), _WIDEST / max(chart.breadth for chart in row))
        height = max(figure.height, _ROW * names + _TOP + max(map(_below, row)))
        yield [(chart, unit * chart.breadth - _GAP, height) for chart in row]


def _below(chart: Chart) -> float:
    """The room for numbers and label below a chart."""
    return (_BOTTOM if chart.axes else 2.0) + (_LABEL if chart.x_label else 0.0)


def _alone(chart: Chart, width: float, height: float) -> str:
    return _svg("".join(_chart(chart, width, height)), width, height, f' fill="{_INK}" style="--w:{width:.0f}"')


def _svg(content: str, width: float, height: float, more: str) -> str:
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" xmlns="http://www.w3.org/2000/svg" '
        f'font-family="DejaVu Sans, Helvetica, Arial, sans-serif" font-size="{_FONT}" stroke-linecap="round" '
        f'stroke-linejoin="round"{more}>{content}</svg>'
    )


def _chart(chart: Chart, width: float, height: float) -> Iterator[str]:
    names = chart.y.ticks().values() if chart.axes else ()
    beside = max([8.0, *(8.0 + _LETTER * len(name) for name in names)])
    values = chart.colors.ticks().values() if chart.colors else ()
    room = width - beside - max([_RIGHT, *(_BAR_ROOM + _LETTER * len(name) for name in values)])
    across, tall = room, height - _TOP - _below(chart)
    if chart.equal:
        unit = min(across / (chart.x.high - chart.x.low), tall / (chart.y.high - chart.y.low))
        across, tall = unit * (chart.x.high - chart.x.low), unit * (chart.y.high - chart.y.low)
    yield f'<g transform="translate({beside:.1f} {_TOP:.1f})">'
    yield _text(0, -9, chart.title)
    yield from _legend(chart, room)
    if chart.axes:
        yield from _axes(chart, across, tall)
    for mark in chart.marks:
        yield from _mark(chart, mark, across, tall)
    for x, y, text in chart.labels:
        yield _text(across * float(chart.x.share(x)), tall * (1.0 - float(chart.y.share(y))) - 5, text, "middle")
    if chart.colors:
        yield from _bar(chart.colors, across + 8.0, tall)
    yield "</g>"


def _legend(chart: Chart, end: float) -> Iterator[str]:
    colors = {mark.name: mark.color for mark in chart.marks}
    if not chart.legend or sum(_LETTER * len(name) + 12.0 for name in (chart.title, *chart.legend)) > end:
        return  # the page explains it
    # How wide letters are only the browser knows: one text flows, from dot to name.
    names = "\u2003".join(f'<tspan fill="{_hex(colors[name])}">\u25cf</tspan> {escape(name)}' for name in chart.legend)
    yield f'<text x="{end:.1f}" y="-9" text-anchor="end">{names}</text>'


def _axes(chart: Chart, width: float, height: float) -> Iterator[str]:
    columns, rows = chart.ticks(width, height)
    grid = [f"M{u:.1f} 0V{height:.1f}" for u in columns]
    grid += [f"M0 {v:.1f}H{width:.1f}" for v in rows] if chart.y.names is None else []
    yield f'<path d="{"".join(grid)}" stroke="{_GRID}" stroke-width=".8"/>'
    yield f'<path d="M0 0V{height:.1f}H{width:.1f}" fill="none" stroke="{_AXIS}" stroke-width=".8"/>'
    yield from (_text(u, height + 13, name, "middle") for u, name in _apart(columns).items())
    yield from (_text(-5, v + 4, name, "end") for v, name in rows.items())
    if chart.x_label:
        yield _text(width / 2, height + 13 + _LABEL, chart.x_label, "middle")


def _apart(names: Mapping[float, str]) -> dict[float, str]:
    """The names that fit beside each other: all of them, or every second, third ..., lest they look uneven."""
    for step in range(1, len(names) + 1):
        shown = dict(list(names.items())[::step])
        halves = [_LETTER * (len(name) + 1) / 2 for name in shown.values()]
        ends = [(u - half, u + half) for u, half in zip(shown, halves, strict=True)]
        if all(left > right for (_, right), (left, _) in pairwise(ends)):
            return shown
    return {}


def _mark(chart: Chart, mark: Mark, width: float, height: float) -> Iterator[str]:
    shapes, color = chart.shapes(mark, width, height)
    if mark.kind == "cells":
        side = mark.size * width / (chart.x.high - chart.x.low)
        corners = np.clip(np.add.outer([-side / 2, side / 2], np.reshape(shapes, (-1, 2))), 0.0, [width, height])
        ends = np.concatenate(corners, axis=1).tolist()
        elements = [f"M{u:.1f} {v:.1f}H{right:.1f}V{below:.1f}H{u:.1f}z" for u, v, right, below in ends]
        style = 'fill="{0}" stroke="{0}" stroke-width=".3"'
    else:
        if mark.kind == "dots":
            elements = [f"M{u:.1f} {v:.1f}h0" for u, v in shapes]
        else:
            elements = ["M" + "L".join(f"{u:.1f} {v:.1f}" for u, v in line) for line in shapes if len(line)]
        fill = 'fill="{0}" fill-opacity=".3"' if mark.kind == "bars" else 'fill="none"'
        style = f'{fill} stroke="{{0}}" stroke-width="{_WIDTHS[mark.kind]}"'
    paths: dict[str, dict[str, None]] = {}  # what is on the same spot appears once
    shades = [color] * len(elements) if isinstance(color, tuple) else [tuple(c) for c in (color // _SHADES) * _SHADES]
    for path, shade in zip(elements, shades, strict=True):
        paths.setdefault(_hex(shade), {})[path] = None
    for stroke, several in paths.items():
        yield f'<path d="{"".join(several)}" {style.format(stroke)}/>'


def _bar(scale: Scale, left: float, height: float) -> Iterator[str]:
    """The colours that values stand for."""
    count = 24
    for k, color in enumerate(viridis(np.linspace(1.0, 0.0, count))):
        yield (
            f'<rect x="{left:.1f}" y="{k * height / count:.1f}" width="{_BAR}" height="{height / count + 0.3:.1f}" '
            f'fill="{_hex(tuple(color))}"/>'
        )
    for value, name in scale.ticks().items():
        yield _text(left + _BAR + 3, height * (1.0 - float(scale.share(value))) + 4, name)


def _text(u: float, v: float, text: str, anchor: str = "start") -> str:
    return f'<text x="{u:.1f}" y="{v:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _hex(color: Color) -> str:
    shade = tuple(int(channel) for channel in color)
    return _NAMED.get(shade, "#{:02x}{:02x}{:02x}".format(*shade[:3]))
