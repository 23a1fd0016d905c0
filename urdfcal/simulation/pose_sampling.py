"""Sampling of the poses to measure: without collisions, every LED in every image, spread over images and joints."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats, Ints
    from urdfcal.robot.mechanism import Joint, Mechanism
    from urdfcal.simulation.collision import CollisionChecker
    from urdfcal.simulation.scene import Scene

MARGIN = 40.0
"""How far from an image's border an LED is planned to appear, px; the errors drawn move it by up to 25."""

# Share of a joint's range left free at either end.
_LIMIT_MARGIN = 0.02
# Cells of the image, about square, and of a joint's range, that the poses are spread over evenly.
_IMAGE_CELLS = (5, 4)
_JOINT_CELLS = 6
# Candidates a pose with the LED in view: an even choice is left when obstacles take nine in ten.
_CANDIDATES = 40
_BATCH = 4000
# After 200,000 draws (a second) the choice is among what was found: of 50 poses' candidates, if fewer than one
# configuration in a hundred shows the LED.
_MOST_BATCHES = 50


def sample_poses(
    scene: Scene,
    checker: CollisionChecker | None,
    count: int,
    rng: np.random.Generator,
    progress: Callable[[int], object] | None = None,
) -> Floats:
    """Sample poses one after the other, each where the poses before it left the largest gaps.

    A gap is a cell of an image, or of a joint's range, that few poses fall into.

    Args:
        scene: the nominal arm and cameras.
        checker: says which poses the arm can take; None when that is not known.
        count: how many poses.
        rng: the source of randomness.
        progress: called with the number of poses found since the last call.

    Returns:
        (count, n) values of all joints of the chain. [rad or m]

    Raises:
        SessionError: there are not enough such poses, with what stands in the way.
    """
    found = _in_view(scene, count, rng)
    cells, centres = _cells(scene, found), scene.camera_centres(found.q)
    filled = np.zeros(cells.max(initial=0) + 1)
    open_, score = np.ones(len(cells), dtype=bool), np.full(len(cells), 1.0)
    chosen: list[int] = []
    while len(chosen) < count and open_.any():
        best = int(np.argmax(np.where(open_, score, -1.0)))
        open_[best] = False
        if checker and not (checker.is_free(found.q[best]) and checker.is_seen(found.q[best], centres[best])):
            continue
        chosen.append(best)
        filled[cells[best]] += 1.0
        score = (1.0 / (1.0 + filled[cells])).sum(axis=1)
        if progress:
            progress(1)
    if len(chosen) < count:
        raise SessionError(
            f"{len(chosen)} of {count} poses found: of {found.drawn} random ones every camera sees the LED in "
            f"{len(cells)}, and {len(chosen)} of these keep clear of the arm, the table and the line of sight",
            where="stand",
            remedy="Let the cameras stand further away or look at the middle of the workspace, or ask for fewer poses.",
        )
    return found.q[chosen]


class _Candidates(NamedTuple):
    """Poses with every LED in view: q (M, n), its pixels (M, C, L, 2), and of how many draws they are."""

    q: Floats
    uv: Floats
    drawn: int


def _in_view(scene: Scene, count: int, rng: np.random.Generator) -> _Candidates:
    lower, upper = _limits(scene.chain)
    actuated = [i for i, joint in enumerate(scene.chain.joints) if joint.mimic is None]
    q: list[Floats] = []
    uv: list[Floats] = []
    needed, drawn = _CANDIDATES * count, 0
    while drawn < _MOST_BATCHES * _BATCH and sum(len(batch) for batch in q) < needed:
        readings = rng.uniform(lower[actuated], upper[actuated], (_BATCH, len(actuated)))
        values = scene.chain.joint_values(readings)
        pixels = scene.pixels(values)
        # A mimic joint may leave its own limits while its master keeps to them.
        good = scene.in_image(pixels, MARGIN).all(axis=(1, 2)) & ((values >= lower) & (values <= upper)).all(axis=1)
        q.append(values[good])
        uv.append(pixels[good])
        drawn += _BATCH
    return _Candidates(np.concatenate(q)[:needed], np.concatenate(uv)[:needed], drawn)


def _cells(scene: Scene, found: _Candidates) -> Ints:
    """Number the cells that each candidate falls into, (M, features): one a camera and LED, one a joint."""
    columns, rows = _IMAGE_CELLS
    sizes = np.array([camera.resolution for camera in scene.cameras])[:, None]
    across, down = np.moveaxis((found.uv - MARGIN) / (sizes - 2.0 * MARGIN), -1, 0)
    in_image = _bin(across, columns) * rows + _bin(down, rows)
    lower, upper = _limits(scene.chain)
    in_joint = _bin((found.q - lower) / np.where(upper > lower, upper - lower, 1.0), _JOINT_CELLS)
    cells = np.concatenate([in_image.reshape(len(found.q), in_image.shape[1] * in_image.shape[2]), in_joint], axis=1)
    first = np.arange(cells.shape[1]) * max(columns * rows, _JOINT_CELLS)
    return np.asarray(cells + first)


def _bin(share: Floats, count: int) -> Ints:
    return np.clip((share * count).astype(np.intp), 0, count - 1)


def _limits(chain: Mechanism) -> tuple[Floats, Floats]:
    """Return the range of every joint that poses are drawn from, (n,) and (n,)."""
    lower, upper = np.array([_range(joint) for joint in chain.joints]).T
    margin = _LIMIT_MARGIN * (upper - lower)
    return lower + margin, upper - margin


def _range(joint: Joint) -> tuple[float, float]:
    """Return a joint's limits; of more than a turn (or endless travel) the turn (or the metre) nearest to zero."""
    longest = 2.0 * np.pi
    if joint.prismatic:
        longest = joint.upper - joint.lower if np.isfinite(joint.upper - joint.lower) else 1.0
    if joint.upper - joint.lower <= longest:
        return joint.lower, joint.upper
    middle = min(max(0.0, joint.lower + longest / 2.0), joint.upper - longest / 2.0)
    return middle - longest / 2.0, middle + longest / 2.0
