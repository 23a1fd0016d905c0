"""Charts made of lines and dots: rerun's own plots run over the chosen timeline only, these are always there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from urdfcal.output.palette import BACKGROUND, FAINT, GRID, INK

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike

    from urdfcal.arrays import Floats
    from urdfcal.output.stream import Layer

Color: TypeAlias = tuple[int, ...]

# Size of the plotted area; only its shape is seen.
_WIDTH, _HEIGHT = 150.0, 105.0
# Rows with names need so much height each, lest the names overlap; beyond the limit they had better.
_ROW, _TALLEST = 7.0, 205.0
# Room for tick labels: numbers and names to the left, and right, above and below.
_NUMBERS, _NAMES, _RIGHT, _ABOVE, _BELOW = 24.0, 75.0, 8.0, 6.0, 16.0
# A logarithmic range shorter than this factor has hardly a round number inside.
_FLAT = 4.0
_TICKS = 5
# rerun takes negative radii as points on the screen.
_DOT, _LINE, _HAIR, _NONE = -2.0, -0.9, -0.5, 0.0


@dataclass(frozen=True)
class Scale:
    """A range of values along an axis.

    Attributes:
        low: at the left or the bottom.
        high: at the right or the top.
        logarithmic: whether equal factors take equal room.
    """

    low: float
    high: float
    logarithmic: bool = False

    @classmethod
    def holding(cls, *values: ArrayLike, logarithmic: bool = False) -> Scale:
        """A range that holds all finite values (the positive ones, if logarithmic) with some room beside them."""
        flat = np.concatenate([np.ravel(np.asarray(v, dtype=float)) for v in values])
        flat = flat[np.isfinite(flat) & ((flat > 0.0) | (not logarithmic))]
        low, high = (float(flat.min()), float(flat.max())) if len(flat) else (1.0, 1.0)
        if logarithmic and high > _FLAT * low:
            room = (high / low) ** 0.05
            return cls(low / room, high * room, logarithmic=True)
        room = 0.05 * (high - low) if high > low else max(abs(high), 1e-3)
        return cls(low - room, high + room)

    def share(self, values: ArrayLike) -> Floats:
        """Where values lie between ``low`` (0) and ``high`` (1); NaN where a logarithm has none."""
        values = np.asarray(values, dtype=float)
        if not self.logarithmic:
            return (values - self.low) / (self.high - self.low)
        ratio = np.where(values > 0.0, values, np.nan) / self.low
        result: Floats = np.log(ratio) / np.log(self.high / self.low)
        return result

    def ticks(self) -> Floats:
        """A handful of round values within the range."""
        if self.logarithmic:
            decades = 10.0 ** np.arange(np.floor(np.log10(self.low)), np.ceil(np.log10(self.high)) + 1)
            inside = np.count_nonzero((decades >= self.low) & (decades <= self.high))
            ticks = decades[:: 1 + inside // (_TICKS + 1)] if inside > 1 else np.outer(decades, [1, 2, 5]).ravel()
        else:
            raw = (self.high - self.low) / _TICKS
            power = 10.0 ** np.floor(np.log10(raw))
            step = power * next((m for m in (1, 2, 5) if m * power >= raw), 10)
            ticks = step * np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1)
        result: Floats = ticks[(ticks >= self.low) & (ticks <= self.high)]
        return result


@dataclass(frozen=True, eq=False)
class Dots:
    """Dots of a chart.

    Attributes:
        name: below the chart's entity.
        x: (K,) values.
        y: (K,) values.
        color: of all of them.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    color: Color


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines of a chart.

    Attributes:
        name: below the chart's entity.
        x: (L, K) values, or (K,) of one line.
        y: (L, K) or (K,) values.
        color: of all of them.
        thin: whether to draw hairlines.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    color: Color
    thin: bool = False


@dataclass(frozen=True, eq=False)
class Chart:
    """A chart, as data.

    Attributes:
        name: its entity.
        title: what it shows, its colours and units.
        x: the horizontal range.
        y: the vertical range.
        marks: what is drawn, the last on top.
        x_names: ticks that are names instead of numbers.
        y_names: likewise.
    """

    name: str
    title: str
    x: Scale
    y: Scale
    marks: Sequence[Dots | Lines]
    x_names: Mapping[float, str] | None = None
    y_names: Mapping[float, str] | None = None

    @property
    def _height(self) -> float:
        """Of the plotted area."""
        return max(_HEIGHT, min(_ROW * len(self.y_names or ()), _TALLEST))

    def view(self, parent: str) -> rrb.View:
        """The chart's view, its entity being a child of ``parent``."""
        left = _NUMBERS if self.y_names is None else _NAMES
        return rrb.Spatial2DView(
            origin=f"{parent}/{rr.escape_entity_path_part(self.name)}",
            name=self.title,
            visual_bounds=rrb.VisualBounds2D(
                x_range=[-left, _WIDTH + _RIGHT], y_range=[-_ABOVE, self._height + _BELOW]
            ),
            background=BACKGROUND,
        )

    def log(self, parent: Layer) -> None:
        """Draw the chart at a child of ``parent``."""
        chart = parent.at(self.name)
        x_names = {t: f"{t + 0.0:.6g}" for t in self.x.ticks()} if self.x_names is None else self.x_names
        y_names = {t: f"{t + 0.0:.6g}" for t in self.y.ticks()} if self.y_names is None else self.y_names
        x, y = _WIDTH * self.x.share(list(x_names)), self._height * (1.0 - self.y.share(list(y_names)))
        grid = [[[0.0, v], [_WIDTH, v]] for v in y]
        chart.at("grid").fixed(rr.LineStrips2D(grid, colors=GRID, radii=_HAIR, draw_order=-1.0))
        frame = [[0.0, 0.0], [0.0, self._height], [_WIDTH, self._height]]
        chart.at("frame").fixed(rr.LineStrips2D([frame], colors=FAINT, radii=_HAIR))
        beside = _NUMBERS if self.y_names is None else _NAMES
        # rerun writes labels centred below their points.
        places = [*([u, self._height] for u in x), *([-beside / 2, v - 5.0] for v in y)]
        names = [*x_names.values(), *y_names.values()]
        chart.at("ticks").fixed(rr.Points2D(places, radii=_NONE, labels=names, colors=INK, show_labels=True))
        for order, mark in enumerate(self.marks):
            self._log_mark(chart.at(mark.name), mark, float(order))

    def _log_mark(self, layer: Layer, mark: Dots | Lines, order: float) -> None:
        u, v = np.broadcast_arrays(_WIDTH * self.x.share(mark.x), self._height * (1.0 - self.y.share(mark.y)))
        places = np.stack([u, v], axis=-1)
        if isinstance(mark, Dots):
            inside = ((places > -1e-6) & (places < np.add([_WIDTH, self._height], 1e-6))).all(axis=-1)
            layer.fixed(rr.Points2D(places[inside], radii=_DOT, colors=mark.color, draw_order=order))
        else:
            lines = np.clip(places.reshape(-1, *places.shape[-2:]), 0.0, [_WIDTH, self._height])
            strips = [line[np.isfinite(line).all(axis=1)] for line in lines]
            radius = _HAIR if mark.thin else _LINE
            layer.fixed(rr.LineStrips2D(strips, colors=mark.color, radii=radius, draw_order=order))
