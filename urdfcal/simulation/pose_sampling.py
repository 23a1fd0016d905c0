"""Sampling of the poses to measure: without collisions, every LED in every image, spread over images and joints."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats, Ints
    from urdfcal.robot.mechanism import Mechanism
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
    q, uv, drawn = _in_view(scene, count, rng)
    cells, centres = _cells(scene, q, uv), scene.camera_centres(q)
    filled = np.zeros(cells.max(initial=0) + 1)
    open_, score = np.ones(len(cells), dtype=bool), np.full(len(cells), 1.0)
    chosen: list[int] = []
    while len(chosen) < count and open_.any():
        best = int(np.argmax(np.where(open_, score, -1.0)))
        open_[best] = False
        if checker and not (checker.is_free(q[best]) and checker.is_seen(q[best], centres[best])):
            continue
        chosen.append(best)
        filled[cells[best]] += 1.0
        score = (1.0 / (1.0 + filled[cells])).sum(axis=1)
        if progress:
            progress(1)
    if len(chosen) < count:
        raise SessionError(
            f"{len(chosen)} of {count} poses found: of {drawn} random ones every camera sees the LED in "
            f"{len(cells)}, and {len(chosen)} of these keep clear of the arm, the table and the line of sight",
            where="stand",
            remedy="Let the cameras stand further away or look at the middle of the workspace, or ask for fewer poses.",
        )
    return q[chosen]


def _in_view(scene: Scene, count: int, rng: np.random.Generator) -> tuple[Floats, Floats, int]:
    """Draw poses (M, n) with every LED in view, their pixels (M, C, L, 2), and say of how many draws they are."""
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
    return np.concatenate(q)[:needed], np.concatenate(uv)[:needed], drawn


def _cells(scene: Scene, q: Floats, uv: Floats) -> Ints:
    """Number the cells that each candidate falls into, (M, features): one a camera and LED, one a joint."""
    columns, rows = _IMAGE_CELLS
    sizes = np.array([camera.resolution for camera in scene.cameras])[:, None]
    across, down = np.moveaxis((uv - MARGIN) / (sizes - 2.0 * MARGIN), -1, 0)
    in_image = _bin(across, columns) * rows + _bin(down, rows)
    lower, upper = _limits(scene.chain)
    in_joint = _bin((q - lower) / np.where(upper > lower, upper - lower, 1.0), _JOINT_CELLS)
    cells = np.concatenate([in_image.reshape(len(q), in_image.shape[1] * in_image.shape[2]), in_joint], axis=1)
    first = np.arange(cells.shape[1]) * max(columns * rows, _JOINT_CELLS)
    return np.asarray(cells + first)


def _bin(share: Floats, count: int) -> Ints:
    return np.clip((share * count).astype(np.intp), 0, count - 1)


def _limits(chain: Mechanism) -> tuple[Floats, Floats]:
    """Return the range of every joint that poses are drawn from, (n,) and (n,).

    Of more than a turn (or endless travel) it is the turn (or the metre) nearest to zero.
    """
    lower, upper = np.array([(joint.lower, joint.upper) for joint in chain.joints]).T
    travel, slides = upper - lower, [joint.prismatic for joint in chain.joints]
    longest = np.where(slides, np.where(np.isfinite(travel), travel, 1.0), 2.0 * np.pi)
    middle = np.clip(0.0, lower + longest / 2.0, upper - longest / 2.0)
    lower = np.where(travel > longest, middle - longest / 2.0, lower)
    upper = np.where(travel > longest, middle + longest / 2.0, upper)
    margin = _LIMIT_MARGIN * (upper - lower)
    return lower + margin, upper - margin
