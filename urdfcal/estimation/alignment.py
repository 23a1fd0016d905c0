"""Place the base and the LEDs by points in space, in closed form (METHOD 10)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import CalibrationError

if TYPE_CHECKING:
    from urdfcal.arrays import Bools, Floats, Ints

# Alternations of base pose and LED positions; the solver refines whatever is left.
_ALTERNATIONS = 20
# LEDs that move by less have settled. [m]
_STILL = 1e-6
# Points this many times further off than the median are left out of the start.
_GROSS = 5.0


def place_base(
    T_base_led: Floats, led: Ints, points: Floats, guesses: Floats, unknown: Bools, exact: Bools
) -> tuple[Floats, Floats]:
    """Find T_world_base and the LED positions that carry the arm onto measured points.

    The equations R^T P_k - R^T t - R_k led = p_k are linear once R^T is any matrix; its nearest rotation starts an
    alternation between Kabsch's alignment and the mean LED position. LEDs of given place start a second one; the
    better of the two is kept.

    Args:
        T_base_led: (S, 4, 4) of the link that carries each point's LED, on the nominal arm. [m]
        led: (S,) LED of each point.
        points: (S, 3) in the world. [m]
        guesses: (L, 3) LED positions in their links' frames to start from. [m]
        unknown: (L,) LEDs whose guess is none.
        exact: (L,) LEDs whose guess is kept.

    Returns:
        T_world_base (4, 4) and leds (L, 3); LEDs never seen keep their guess.

    Raises:
        CalibrationError: fewer than four points.
    """
    least = 4 if np.any(unknown[led]) else 3
    if len(points) < least:
        raise CalibrationError(
            f"only {len(points)} points in space: {least} or more are needed to place the base",
            remedy="Measure more poses, or check that both cameras see the LED.",
        )
    R, p = T_base_led[:, :3, :3], T_base_led[:, :3, 3]
    seen = np.unique(led)
    kept = np.ones(len(points), dtype=bool)
    candidates = [guesses]
    if np.any(unknown[seen]):
        candidates.append(_linear_leds(R, p, led, points, guesses))
    best: tuple[float, Floats, Floats] | None = None
    for leds in candidates:
        for _ in range(2):  # once with all points, once without the grossly wrong ones
            T, leds = _alternate(R[kept], p[kept], led[kept], points[kept], leds, ~exact)
            predicted = (p + (R @ leds[led][..., None])[..., 0]) @ T[:3, :3].T + T[:3, 3]
            distance = np.linalg.norm(predicted - points, axis=1)
            kept = distance <= _GROSS * np.median(distance)
        score = float(np.median(distance))
        if best is None or score < best[0]:
            best = (score, T, leds)
        kept = np.ones(len(points), dtype=bool)
    return best[1], best[2]  # type: ignore[index]  # there is at least one candidate


def kabsch(source: Floats, target: Floats) -> Floats:
    """The rigid T (4, 4) that minimises sum |T source - target|^2, both (N, 3) (Kabsch, Acta Cryst. A32, 1976)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((source - a).T @ (target - b))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    T = np.eye(4)
    T[:3, :3] = Vt.T @ sign @ U.T
    T[:3, 3] = b - T[:3, :3] @ a
    return T


def _linear_leds(R: Floats, p: Floats, led: Ints, points: Floats, guesses: Floats) -> Floats:
    """LED positions from the linear relaxation A P_k + s - R_k led = p_k."""
    S, L = len(points), len(guesses)
    system = np.zeros((S, 3, 12 + 3 * L))
    centred = points - points.mean(axis=0)
    for axis in range(3):
        system[:, axis, 3 * axis : 3 * axis + 3] = centred
        system[:, axis, 9 + axis] = 1.0
    for index in range(L):
        system[:, :, 12 + 3 * index : 15 + 3 * index] = -R * (led == index)[:, None, None]
    solution = np.linalg.lstsq(system.reshape(3 * S, -1), p.ravel(), rcond=1e-9)[0]
    return np.where(np.isin(np.arange(L), led)[:, None], solution[12:].reshape(L, 3), guesses)


def _alternate(R: Floats, p: Floats, led: Ints, points: Floats, leds: Floats, movable: Bools) -> tuple[Floats, Floats]:
    leds = leds.copy()
    for _ in range(_ALTERNATIONS):
        T = kabsch(p + (R @ leds[led][..., None])[..., 0], points)
        in_tip = (np.swapaxes(R, 1, 2) @ ((points - T[:3, 3]) @ T[:3, :3] - p)[..., None])[..., 0]
        before = leds.copy()
        for index in np.flatnonzero(movable & np.isin(np.arange(len(leds)), led)):
            leds[index] = np.median(in_tip[led == index], axis=0)
        if np.abs(leds - before).max() < _STILL:
            break
    return kabsch(p + (R @ leds[led][..., None])[..., 0], points), leds
