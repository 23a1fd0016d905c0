"""LEDs as points on links: where they are, where they are seen from, and how both move (METHOD 5).

Shared by all measurements of LEDs. Arrays are over N poses with m slots each; K = N m.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.targets import bend_key, point_places, print_key, print_scale
from urdfcal.session.target import bends_of

if TYPE_CHECKING:
    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.linearize import Jacobian
    from urdfcal.estimation.links import Links
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.state import State


def led_points(observed: Observations, links: Links, state: State) -> tuple[Floats, Floats]:
    """Find the LEDs of the slots in the base link.

    Returns:
        Lever arms (N, m, 3) from the origin of each LED's frame (in the world's frame: from the base link), in axes
        parallel to the base link's, and positions (N, m, 3) in the base link. [m]
    """
    led = observed.index["led"]
    frame = links.attachments.led[led]
    leds, each = point_places(links.attachments, state), np.arange(len(led))[:, None]
    lever, p_base = np.zeros((*led.shape, 3)), np.zeros((*led.shape, 3))
    for k, (R, p) in enumerate(zip(links.R, links.p, strict=True)):
        here = frame == k
        if not here.any():
            continue
        # Every LED at every pose as one product, of which the seen ones are taken.
        levers = (R.reshape(-1, 3) @ leds.T).reshape(len(R), 3, -1)[each, :, led]
        at = p[:, None] + levers
        levers = at if k == 0 else levers
        lever, p_base = (
            (levers, at)
            if here.all()
            else (np.where(here[..., None], levers, lever), np.where(here[..., None], at, p_base))
        )
    return lever, p_base


def seen_from(links: Links, p_base: Floats, frame: Ints) -> Floats:
    """Express points (N, m, 3) of the base link in the frame of each slot, (N, m). [m]."""
    result = np.zeros_like(p_base)
    for k, (R, p) in enumerate(zip(links.R, links.p, strict=True)):
        here = frame == k
        if here.any():
            place = (p_base - p[:, None]) @ R
            result = place if here.all() else np.where(here[..., None], place, result)
    return result


def by_frames(
    links: Links, E: Floats, lever: Floats, p_base: Floats, led_frame: Ints, view_frame: Ints
) -> tuple[Floats | None, ...]:
    """Differentiate by small motions of the frames.

    With p_base = p + R led, a motion (v, w) of the LED's frame moves it by v + w x R led; one of the frame it is seen
    from moves it backwards by v + w x (p_base - p) as that sees it.

    Args:
        links: where the frames are.
        E: (K, D, 3) derivative of the measured values by the LED's position in the base link.
        lever: (N, m, 3) as of :func:`led_points`. [m]
        p_base: (N, m, 3) as of :func:`led_points`. [m]
        led_frame: (N, m) frame that carries the LED.
        view_frame: (N, m) frame that it is seen from.

    Returns:
        For each frame (N, m D, 6), or None; see :class:`~urdfcal.estimation.measurements.base.ByFrame`.
    """
    N, m = led_frame.shape
    D = E.shape[1]
    result: list[Floats | None] = []
    for k, p in enumerate(links.p):
        carries, watches = led_frame == k, view_frame == k
        by: Floats | None = None
        if carries.any():
            by = _masked(_by_motion(E, lever), carries)
        if watches.any():
            origin = p_base if k == 0 else p_base - p[:, None]
            back = _masked(_by_motion(E, origin), watches)
            by = -back if by is None else by - back
        result.append(None if by is None else by.reshape(N, m * D, 6))
    return tuple(result)


def put_leds(J: Jacobian, observed: Observations, links: Links, E: Floats, lever: Floats, state: State) -> None:
    """Put the derivatives by the LEDs' positions in their frames, and by the scale and the bends of targets' prints.

    Args:
        J: takes them.
        observed: which points.
        links: where the frames are.
        E: (K, D, 3) derivative by the position in the base link.
        lever: (N, m, 3) as of :func:`led_points`. [m]
        state: where to differentiate.
    """
    _put_prints(J, observed, links, E, lever, state)
    if not J.wants(LEDS):
        return
    led = observed.index["led"]
    frames = links.attachments.led[: len(links.attachments.led) - len(links.attachments.target_points)]
    N, m = led.shape
    parts = np.zeros((N * m, E.shape[1], len(frames), 3))
    for index, frame in enumerate(frames.tolist()):
        d_led = (E.reshape(N, -1, 3) @ links.R[frame]).reshape(E.shape)
        parts[:, :, index] = d_led * (led == index).reshape(-1, 1, 1)
    J.put(LEDS, parts.reshape(N * m, E.shape[1], -1))


def _put_prints(J: Jacobian, observed: Observations, links: Links, E: Floats, lever: Floats, state: State) -> None:
    """Put the derivatives by the scales of targets' prints, points shrink towards their origin, and by their bends."""
    attachments = links.attachments
    first = len(attachments.led) - len(attachments.target_points)
    frame = attachments.led[observed.index["led"]]
    for k, name in enumerate(attachments.targets, attachments.first_target):
        key = print_key(name)
        if J.wants(key):
            mine = (frame == k) & observed.valid
            along = -np.where(mine[..., None], lever, 0.0) / print_scale(name, state)
            J.put(key, E @ along.reshape(-1, 3, 1))
        if J.wants(bent := bend_key(name)):
            mine = (frame == k) & observed.valid
            bends = np.zeros((*frame.shape, 3))
            own = np.flatnonzero(attachments.led[first:] == k)
            at = observed.index["led"][mine] - first - own[0]
            bends[mine] = bends_of(attachments.target_points[own])[at] / print_scale(name, state)
            normal = np.broadcast_to(links.R[k], (len(frame), 3, 3))[:, None, :, 2, None]
            J.put(bent, E @ (normal * bends[:, :, None]).reshape(-1, 3, 3))


def carry(matrices: Floats, right: Floats) -> Floats:
    """``matrices @ right`` as one product: many small ones cost several times as much."""
    N, rows, columns = matrices.shape
    result: Floats = (matrices.reshape(N * rows, columns) @ right).reshape(N, rows, right.shape[1])
    return result


def by_rotation(E: Floats, lever: Floats) -> Floats:
    """-E [lever]x, how values move as a lever arm (K, 3) rotates: the rows of E (K, D, 3) crossed with it."""
    a, b = np.moveaxis(E, -1, 0), lever.T[..., None]
    result = np.empty_like(E)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        result[..., i] = b[j] * a[k] - b[k] * a[j]
    return result


def _by_motion(E: Floats, lever: Floats) -> Floats:
    return np.concatenate([E, by_rotation(E, lever.reshape(-1, 3))], axis=-1)


def _masked(values: Floats, slots: Bools) -> Floats:
    return values if slots.all() else values * slots.reshape(-1, 1, 1)
