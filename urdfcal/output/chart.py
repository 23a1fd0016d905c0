"""Charts as data: drawn here as SVG for the report, and into the recording as lines and dots (entities.py).

One description serves both. The recording needs such charts because rerun's own plots run over the chosen timeline
only; drawing the report's with matplotlib took a quarter of the time of a whole calibration. As SVG text stays text,
and nothing is fetched.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from urdfcal.output.palette import CALIBRATED, INK, NOMINAL, OUTLIER, viridis

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from urdfcal.arrays import Floats

Color: TypeAlias = "tuple[int, ...] | NDArray[np.uint8]"

# A logarithmic range shorter than this factor has hardly a round number inside.
_FLAT = 4.0
_TICKS = 5
# Units of a figure whose page gives it a width: text of 11 looks like the page's.
_WIDTH, _FONT, _LETTER, _ROW = 720.0, 11, 6.6, 15.0
_TOP, _BOTTOM, _LABEL, _RIGHT, _GAP = 24.0, 18.0, 15.0, 10.0, 12.0
_BAR, _BAR_ROOM = 7.0, 42.0
_WIDTHS = {"dots": 4.0, "lines": 1.3, "hairlines": 0.8}
# Darker than the recording's, on white paper.
_PAPER: dict[tuple[int, ...], str] = {CALIBRATED: "#12875a", NOMINAL: "#3d63c4", INK: "#555", OUTLIER: "#b030b0"}
# Shades of a colour that look the same share a path: 50,000 elements would stall the browser.
_SHADES = 12


@dataclass(frozen=True)
class Scale:
    """A range of values along an axis.

    Attributes:
        low: at the left or the bottom.
        high: at the right or the top.
        logarithmic: whether equal factors take equal room.
        whole: whether only whole numbers mean something.
        names: ticks that are names instead of numbers.
    """

    low: float
    high: float
    logarithmic: bool = False
    whole: bool = False
    names: Mapping[float, str] | None = None

    @classmethod
    def holding(cls, *values: ArrayLike, logarithmic: bool = False, whole: bool = False, room: float = 0.05) -> Scale:
        """A range that holds all finite values (the positive ones, if logarithmic) with a share of it as room beside.

        A single value has a range about it: there is none to take a share of.
        """
        flat = np.concatenate([np.ravel(np.asarray(v, dtype=float)) for v in values])
        flat = flat[np.isfinite(flat) & ((flat > 0.0) | (not logarithmic))]
        low, high = (float(flat.min()), float(flat.max())) if len(flat) else (1.0, 1.0)
        if logarithmic and high > _FLAT * low:
            factor = (high / low) ** room
            return cls(low / factor, high * factor, logarithmic=True)
        beside = room * (high - low) if high > low else max(abs(high), 1e-3)
        return cls(low - beside, high + beside, whole=whole)

    def share(self, values: ArrayLike) -> Floats:
        """Where values lie between ``low`` (0) and ``high`` (1); NaN where a logarithm has none."""
        values = np.asarray(values, dtype=float)
        if not self.logarithmic:
            return (values - self.low) / (self.high - self.low)
        ratio = np.where(values > 0.0, values, np.nan) / self.low
        result: Floats = np.log(ratio) / np.log(self.high / self.low)
        return result

    def ticks(self) -> Mapping[float, str]:
        """A handful of round values within the range, and how they are written; or the names."""
        if self.names is not None:
            return self.names
        if self.logarithmic:
            decades = 10.0 ** np.arange(np.floor(np.log10(self.low)), np.ceil(np.log10(self.high)) + 1)
            inside = np.count_nonzero((decades >= self.low) & (decades <= self.high))
            ticks = decades[:: 1 + inside // (_TICKS + 1)] if inside > 2 else np.outer(decades, [1, 2, 5]).ravel()
        else:
            raw = max((self.high - self.low) / _TICKS, 1.0 if self.whole else 0.0)
            power = 10.0 ** np.floor(np.log10(raw))
            step = power * next((m for m in (1, 2, 5) if m * power >= raw), 10)
            ticks = step * np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1)
        inside_range = ticks[(ticks >= self.low) & (ticks <= self.high)].tolist()
        return {tick: f"{tick + 0.0:.6g}" for tick in inside_range}


@dataclass(frozen=True, eq=False)
class Mark:
    """Dots, lines or cells of a chart.

    Attributes:
        kind: dots, lines or cells; cells are squares of side ``size`` around their values.
        name: of its own in the chart.
        x: (K,) values, of lines also (L, K).
        y: (K,) or (L, K) values.
        color: of all of them, or (K, 3) or (L, 3), one for each dot, line or cell.
        size: of cells, in the values' unit.
    """

    kind: Literal["dots", "lines", "hairlines", "cells"]
    name: str
    x: ArrayLike
    y: ArrayLike
    color: Color
    size: float = 0.0


@dataclass(frozen=True, eq=False)
class Chart:
    """A chart.

    Attributes:
        name: of its own in a recording.
        title: what it shows, and the units.
        x: the horizontal range.
        y: the vertical range.
        marks: its contents, the last on top.
        x_label: what the report writes below.
        legend: names of the marks that the report explains by their colours.
        breadth: its share of a row in the report.
        equal: whether both axes have one unit.
        axes: whether the report draws axes and grid.
        colors: range of the values that cells' colours stand for.
    """

    name: str
    title: str
    x: Scale
    y: Scale
    marks: Sequence[Mark]
    x_label: str = ""
    legend: tuple[str, ...] = ()
    breadth: float = 1.0
    equal: bool = False
    axes: bool = True
    colors: Scale | None = None

    def ticks(self, width: float, height: float) -> tuple[dict[float, str], dict[float, str]]:
        """Where both axes of an area of the given size are marked, from the left and from the top, and with what."""
        x, y = self.x.ticks(), self.y.ticks()
        across, down = width * self.x.share(list(x)), height * (1.0 - self.y.share(list(y)))
        return dict(zip(across.tolist(), x.values(), strict=True)), dict(zip(down.tolist(), y.values(), strict=True))

    def shapes(self, mark: Mark, width: float, height: float) -> tuple[list[Floats] | Floats, Color]:
        """Bring a mark onto an area of the given size, its origin at the top left.

        Returns:
            Points (K, 2) of dots and cells within the range, or lines (K, 2) each cut at the range; and their colours.
        """
        u, v = np.broadcast_arrays(width * self.x.share(mark.x), height * (1.0 - self.y.share(mark.y)))
        points = np.stack([u, v], axis=-1)
        if mark.kind in ("dots", "cells"):
            inside = ((points > -1e-6) & (points < np.add([width, height], 1e-6))).all(axis=-1)
            return points[inside], mark.color if isinstance(mark.color, tuple) else mark.color[inside]
        lines = np.clip(points.reshape(-1, *points.shape[-2:]), 0.0, [width, height])
        return [line[np.isfinite(line).all(axis=1)] for line in lines], mark.color


def bars(at: Floats, length: Floats, half: float) -> tuple[Floats, Floats]:
    """Outlines (L, 4) of bars from zero: across, and along."""
    zero = np.zeros_like(length)
    across = np.stack([at - half, at - half, at + half, at + half], axis=-1)
    return across, np.stack([zero, length, length, zero], axis=-1)


def svg(rows: Sequence[Sequence[Chart]], height: float) -> str:
    """Draw charts beside and below each other.

    Args:
        rows: the charts, each row as wide as the page.
        height: of a row, where its charts' names do not need more; 720 is the width.
    """
    parts: list[str] = []
    top = 0.0
    for row in rows:
        names = max(len(chart.y.names or ()) for chart in row)
        tall, left, unit = max(height, _ROW * names + _TOP + _BOTTOM), 0.0, _WIDTH / sum(c.breadth for c in row)
        for chart in row:
            parts += _chart(chart, left, top, unit * chart.breadth - _GAP, tall)
            left += unit * chart.breadth
        top += tall
    return (
        f'<svg viewBox="0 0 {_WIDTH:g} {top:g}" xmlns="http://www.w3.org/2000/svg" font-size="{_FONT}" fill="#333" '
        f'stroke-linecap="round" stroke-linejoin="round">{"".join(parts)}</svg>'
    )


def _chart(chart: Chart, left: float, top: float, width: float, height: float) -> Iterator[str]:
    names = chart.y.ticks().values() if chart.axes else ()
    beside = max([8.0, *(8.0 + _LETTER * len(name) for name in names)])
    room = width - beside - (_BAR_ROOM if chart.colors else _RIGHT)
    below = (_BOTTOM if chart.axes else 2.0) + (_LABEL if chart.x_label else 0.0)
    across, tall = room, height - _TOP - below
    if chart.equal:
        unit = min(across / (chart.x.high - chart.x.low), tall / (chart.y.high - chart.y.low))
        across, tall = unit * (chart.x.high - chart.x.low), unit * (chart.y.high - chart.y.low)
    yield f'<g transform="translate({left + beside:.1f} {top + _TOP:.1f})">'
    yield _text(0, -9, chart.title)
    yield from _legend(chart, room)
    if chart.axes:
        yield from _axes(chart, across, tall)
    for mark in chart.marks:
        yield from _mark(chart, mark, across, tall)
    if chart.colors:
        yield from _bar(chart.colors, across + 8.0, tall)
    yield "</g>"


def _legend(chart: Chart, end: float) -> Iterator[str]:
    colors = {mark.name: mark.color for mark in chart.marks}
    if sum(_LETTER * len(name) + 18.0 for name in (chart.title, *chart.legend)) > end:
        return  # the page explains it
    for name in reversed(chart.legend):
        yield _text(end, -9, name, "end")
        end -= _LETTER * len(name) + 6.0
        yield f'<path d="M{end:.1f} -13h0" stroke="{_hex(colors[name])}" stroke-width="7"/>'
        end -= 12.0


def _axes(chart: Chart, width: float, height: float) -> Iterator[str]:
    columns, rows = chart.ticks(width, height)
    grid = [f"M{u:.1f} 0V{height:.1f}" for u in columns]
    grid += [f"M0 {v:.1f}H{width:.1f}" for v in rows] if chart.y.names is None else []
    yield f'<path d="{"".join(grid)}" stroke="#ebebeb" stroke-width=".8"/>'
    yield f'<path d="M0 0V{height:.1f}H{width:.1f}" fill="none" stroke="#333" stroke-width=".8"/>'
    yield from (_text(u, height + 13, name, "middle") for u, name in _apart(columns).items())
    yield from (_text(-5, v + 4, name, "end") for v, name in rows.items())
    if chart.x_label:
        yield _text(width / 2, height + 13 + _LABEL, chart.x_label, "middle")


def _apart(names: Mapping[float, str]) -> dict[float, str]:
    """The names that fit beside each other."""
    shown: dict[float, str] = {}
    end = -np.inf
    for u, name in names.items():
        half = _LETTER * (len(name) + 1) / 2
        if u - half > end:
            shown[u], end = name, u + half
    return shown


def _mark(chart: Chart, mark: Mark, width: float, height: float) -> Iterator[str]:
    shapes, color = chart.shapes(mark, width, height)
    if mark.kind == "cells":
        side = mark.size * width / (chart.x.high - chart.x.low)
        elements = [f"M{u - side / 2:.1f} {v - side / 2:.1f}h{side:.2f}v{side:.2f}h-{side:.2f}z" for u, v in shapes]
        style = 'fill="{0}" stroke="{0}" stroke-width=".3"'
    else:
        if mark.kind == "dots":
            elements = [f"M{u:.1f} {v:.1f}h0" for u, v in shapes]
        else:
            elements = ["M" + "L".join(f"{u:.1f} {v:.1f}" for u, v in line) for line in shapes if len(line)]
        style = f'fill="none" stroke="{{0}}" stroke-width="{_WIDTHS[mark.kind]}"'
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
    return _PAPER.get(shade, "#{:02x}{:02x}{:02x}".format(*shade[:3]))
