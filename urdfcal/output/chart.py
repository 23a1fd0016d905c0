"""Charts as data: drawn as SVG for the report (svg.py), and into the recording as lines and dots (entities.py).

One description serves both. The recording needs such charts because rerun's own plots run over the chosen timeline
only; drawing the report's with matplotlib took a quarter of the time of a whole calibration.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from urdfcal.arrays import Floats

Color: TypeAlias = "tuple[int, ...] | NDArray[np.uint8]"

# A logarithmic range shorter than this factor has hardly a round number inside.
_FLAT = 4.0
_TICKS = 5


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
    """Dots, lines, bars or cells of a chart.

    Attributes:
        kind: dots, lines, outlines of bars (:func:`bars`), or cells, squares of side ``size`` around their values.
        name: of its own in the chart.
        x: (K,) values, of lines also (L, K).
        y: (K,) or (L, K) values.
        color: of all of them, or (K, 3) or (L, 3), one for each dot, line or cell.
        size: of cells, in the values' unit.
    """

    kind: Literal["dots", "lines", "hairlines", "bars", "cells"]
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
        labels: texts, each centred above a place (x, y).
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
    labels: tuple[tuple[float, float, str], ...] = ()

    def ticks(self, width: float, height: float) -> tuple[dict[float, str], dict[float, str]]:
        """Where both axes of an area of the given size are marked, from the left and from the top, and with what."""
        x, y = self.x.ticks(), self.y.ticks()
        across, down = width * self.x.share(list(x)), height * (1.0 - self.y.share(list(y)))
        return dict(zip(across.tolist(), x.values(), strict=True)), dict(zip(down.tolist(), y.values(), strict=True))

    def shapes(self, mark: Mark, width: float, height: float) -> tuple[list[Floats] | Floats, Color]:
        """Bring a mark onto an area of the given size, its origin at the top left.

        Returns:
            Points (K, 2) of dots within the range and of cells that reach into it, or lines (K, 2) each cut at the
            range; and their colours.
        """
        u, v = np.broadcast_arrays(width * self.x.share(mark.x), height * (1.0 - self.y.share(mark.y)))
        points = np.stack([u, v], axis=-1)
        if mark.kind in ("dots", "cells"):
            beyond = 1e-6 + mark.size / 2 * np.divide(
                [width, height], [self.x.high - self.x.low, self.y.high - self.y.low]
            )
            inside = ((points > -beyond) & (points < np.add([width, height], beyond))).all(axis=-1)
            return points[inside], mark.color if isinstance(mark.color, tuple) else mark.color[inside]
        lines = np.clip(points.reshape(-1, *points.shape[-2:]), 0.0, [width, height])
        return [line[np.isfinite(line).all(axis=1)] for line in lines], mark.color


def bars(at: Floats, length: Floats, half: float) -> tuple[Floats, Floats]:
    """Outlines (L, 4) of bars from zero: across, and along."""
    zero = np.zeros_like(length)
    across = np.stack([at - half, at - half, at + half, at + half], axis=-1)
    return across, np.stack([zero, length, length, zero], axis=-1)


def reference_length(most: float) -> float:
    """The largest of 1, 2, 5, 10 ... and their parts that is no longer."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(power * max(m for m in (1, 2, 5) if m * power <= most * (1 + 1e-9)))
