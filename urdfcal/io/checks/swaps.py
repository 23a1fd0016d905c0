"""Swap check: whether the cameras' rays meet as the tables name them, or with two names swapped."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements.pixels import side_by_side

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.arrays import Floats
    from urdfcal.io.tables import MeasurementTable

# Two hundred points decide as well as a hundred thousand.
_SAMPLE = 200
_FEWEST = 3
# True sigmas give a whitened rms of about 0.5; cameras that are a little off give a few units.
_GOOD_RMS = 3.0
# Exchanging something explains the detections if it makes the residual this many times smaller.
_BETTER = 10.0
_MOST = 0.5


class Rays(Enum):
    """What triangulation says about the detections."""

    MEET = "they meet"
    MISS = "they miss each other, whatever is exchanged"
    UNKNOWN = "fewer than two cameras of known place saw the same"


@dataclass(frozen=True)
class _Score:
    """How well the rays meet: share of points found, and their median whitened residual."""

    found: float
    rms: float

    @property
    def good(self) -> bool:
        return self.found >= _MOST and self.rms <= _GOOD_RMS

    def beats(self, other: _Score) -> bool:
        if self.found < _MOST:
            return False
        # Where nothing was found to compare with, garbage must not win.
        reference = other.rms if other.found >= _MOST else _BETTER**2 * _GOOD_RMS
        return _BETTER * self.rms < reference

    def __str__(self) -> str:
        if self.found < _MOST:
            return f"{self.found:.0%} of the rays meet"
        return f"the rays miss each other by {self.rms:.3g} sigma"


def check_names_by_rays(rig: Rig, table: MeasurementTable) -> tuple[Rays, list[str]]:
    """Triangulate the detections as named, and with cameras or u and v exchanged.

    Returns:
        What the rays do, and warnings.

    Raises:
        SessionError: an exchange makes the rays meet.
    """
    placed = [i for i, T in enumerate(rig.T_cam_world) if T is not None]
    seen = table.measurements
    _, _, uv, sigma = side_by_side(seen.index, seen.values, seen.sigma, len(rig.cameras))
    uv, sigma = uv[:, placed], sigma[:, placed]
    several = np.flatnonzero(np.isfinite(uv[:, :, 0]).sum(axis=1) > 1)
    if len(several) < _FEWEST:
        return Rays.UNKNOWN, []
    sample = several[np.linspace(0, len(several) - 1, min(_SAMPLE, len(several))).astype(int)]
    uv, sigma = uv[sample], sigma[sample]
    rig = Rig(tuple(rig.cameras[i] for i in placed), tuple(rig.T_cam_world[i] for i in placed))
    named = _score(rig, uv, sigma)
    scores = [(_score(rig, *changed), what) for what, *changed in _exchanges(rig, uv, sigma)]
    best, what = min(scores, key=lambda pair: (-(pair[0].found >= _MOST), pair[0].rms))
    if best.beats(named):
        raise SessionError(
            f"{what} look exchanged: as they are, {named}; with them exchanged, {best}",
            where=str(table.table.path),
            remedy="Check the table's columns and the names in the camera file.",
        )
    if named.good:
        return Rays.MEET, []
    return Rays.MISS, [f"{table.table.path}: {named}: are the cameras where the camera file says?"]


def _exchanges(rig: Rig, uv: Floats, sigma: Floats) -> Iterator[tuple[str, Floats, Floats]]:
    for pair in combinations(range(len(rig.cameras)), 2):
        order = np.arange(len(rig.cameras))
        order[list(pair)] = order[list(pair[::-1])]
        yield f"cameras {rig.names[pair[0]]!r} and {rig.names[pair[1]]!r}", uv[:, order], sigma[:, order]
    yield "u and v", uv[:, :, ::-1], sigma


def _score(rig: Rig, uv: Floats, sigma: Floats) -> _Score:
    result = rig.triangulate(uv, sigma)
    found = float(result.ok.mean())
    return _Score(found, float(np.median(result.rms[result.ok])) if found else np.inf)
