"""Which lights of several cameras are one: those whose rays meet."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import islice, pairwise, product
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.cameras.rig import Rig

# Cameras that were calibrated well miss by 0.1 to 0.5 px. How badly these do shows in the images with one light
# each: the gate is this many times their median.
_GATE, _LEAST_GATE = 6.0, 1.0
# Cameras that miss by more than this are not where the file says: their rays decide nothing. [px]
_LOST = 5.0
# A reflection off metal or glass has a tenth to half of the light's brightness.
_BRIGHTER = 2.0
# Combinations of lights that are tried for one LED at one pose.
_MOST = 200


@dataclass(frozen=True, eq=False)
class LightCandidate:
    """A light that may be the LED.

    Attributes:
        camera: index of the camera that sees it.
        row: its place in that camera's list.
        uv: (2,) where. [px]
        flux: how bright.
    """

    camera: int
    row: int
    uv: Floats
    flux: float


Rejections = dict[tuple[int, int], str]
"""Reasons by (camera, row) why a light is not the LED."""


def associate(
    rig: Rig, groups: Sequence[Sequence[LightCandidate]], moved: Collection[int] = ()
) -> tuple[Rejections, list[str]]:
    """Choose at most one light for each camera.

    Args:
        rig: the cameras.
        groups: for every LED at every pose, the lights that may be it, of all cameras.
        moved: indices of cameras that were moved, whose rays decide nothing.

    Returns:
        The lights that are not taken, and warnings.
    """
    verdict: Rejections = {}
    placed = {i for i, T in enumerate(rig.T_cam_world) if T is not None} - set(moved)
    seen: list[Sequence[LightCandidate]] = [[c for c in group if c.camera in placed] for group in groups]
    several = [group for group in seen if len({c.camera for c in group}) > 1]
    sets = [_combinations(group) for group in several]
    misses = _misses(rig, [combination for of_group in sets for combination in of_group])
    starts = np.cumsum([0, *map(len, sets)])
    by_group = [misses[a:b] for a, b in pairwise(starts)]
    single = [m[0] for m, of_group in zip(by_group, sets, strict=True) if len(of_group) == 1 and np.isfinite(m[0])]
    usual = float(np.median(single)) if single else 0.0
    warnings = []
    if usual > _LOST:
        warnings.append(
            f"the cameras' rays miss each other by {usual:.1f} px: they do not decide which light is the LED. "
            "Are the cameras where the camera file says?"
        )
    else:
        gate = max(_LEAST_GATE, _GATE * usual)
        for group, of_group, m in zip(several, sets, by_group, strict=True):
            verdict |= _judge(group, of_group, m, gate)
    for group in groups:
        for camera in {c.camera for c in group}:
            verdict |= _brightest([c for c in group if c.camera == camera and (camera, c.row) not in verdict])
    return verdict, warnings


def _combinations(group: Sequence[LightCandidate]) -> list[tuple[LightCandidate, ...]]:
    """All choices of one light for each of two or more cameras, those with most cameras first."""
    by_camera: Mapping[int, list[LightCandidate | None]] = defaultdict(list)
    for candidate in group:
        by_camera[candidate.camera].append(candidate)
    if len(by_camera) > 2:
        # One of three cameras may see only something else.
        for lights in by_camera.values():
            lights.append(None)
    chosen = (tuple(c for c in choice if c is not None) for choice in product(*by_camera.values()))
    found = [choice for choice in islice(chosen, _MOST) if len(choice) > 1]
    return sorted(found, key=len, reverse=True)


def _misses(rig: Rig, combinations: Sequence[Sequence[LightCandidate]]) -> Floats:
    """How far (rms) the rays of each combination miss each other, px; infinite where they do not meet at all."""
    uv = np.full((len(combinations), len(rig.cameras), 2), np.nan)
    for i, combination in enumerate(combinations):
        for candidate in combination:
            uv[i, candidate.camera] = candidate.uv
    result = rig.triangulate(uv, 1.0)
    # The point takes three of the residuals' degrees of freedom.
    views = np.array([len(combination) for combination in combinations])
    rms = result.rms * np.sqrt(2.0 * views / np.maximum(2.0 * views - 3.0, 1.0))
    return np.where(result.ok, rms, np.inf)


def _judge(
    group: Sequence[LightCandidate], combinations: Sequence[tuple[LightCandidate, ...]], misses: Floats, gate: float
) -> Rejections:
    """Keep the combination of most cameras whose rays meet, if there is no doubt which it is."""
    meet = [i for i in range(len(combinations)) if misses[i] <= gate]
    if not meet:
        known = f"miss each other by {misses.min():.1f} px" if np.isfinite(misses.min()) else "do not meet"
        return {(c.camera, c.row): f"the cameras' rays {known}" for c in group}
    most = max(len(combinations[i]) for i in meet)
    # Mean brightness, on a scale of factors.
    flux = {i: float(np.mean([np.log(c.flux) for c in combinations[i]])) for i in meet if len(combinations[i]) == most}
    best, *rest = sorted(flux, key=lambda i: -flux[i])
    if rest and flux[best] - flux[rest[0]] < np.log(_BRIGHTER):
        return {(c.camera, c.row): "another light is as bright, and the rays of both meet" for c in group}
    kept = {(c.camera, c.row) for c in combinations[best]}
    others = {(c.camera, c.row): "its ray does not meet the other camera's" for c in group}
    dim = {(c.camera, c.row) for i in rest for c in combinations[i]}
    others |= dict.fromkeys(dim, "weaker than another light whose rays meet: a reflection?")
    return {key: reason for key, reason in others.items() if key not in kept}


def _brightest(lights: Sequence[LightCandidate]) -> Rejections:
    """Of several lights in one image, the brightest by far."""
    order = sorted(lights, key=lambda c: -c.flux)
    if len(order) > 1 and order[0].flux < _BRIGHTER * order[1].flux:
        return {(c.camera, c.row): "another light is as bright, and nothing tells which is the LED" for c in order}
    return {(c.camera, c.row): "weaker than another light: a reflection?" for c in order[1:]}
