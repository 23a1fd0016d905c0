"""Poses that an arm can take and the cameras see it in: drawn at random, near others, and checked when they matter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.simulation.planning import are_in_view, in_view, joint_limits

if TYPE_CHECKING:
    from urdfcal.arrays import Floats, Ints
    from urdfcal.simulation.planning import CollisionChecker
    from urdfcal.simulation.scene import Scene


class Reach:
    """Where every camera sees every LED, and of these poses which the arm can take.

    What is in view is quick to say of thousands of poses; collisions and what hides an LED take a millisecond each, and
    are looked at for those poses that are about to be chosen.
    """

    def __init__(self, scene: Scene, checker: CollisionChecker | None, margin: float) -> None:
        """Take the arm and cameras as believed, with the outermost points of targets.

        Args:
            scene: arm and cameras.
            checker: says what the arm can take; None where that is not known.
            margin: from the images' borders. [px]
        """
        self.margin = margin
        self._scene, self._checker = scene, checker
        self._known: dict[bytes, bool] = {}

    def draw(self, count: int, rng: np.random.Generator) -> Floats:
        """Draw poses (N, n) in view, ``count`` of them or as many as there are. [rad or m]."""
        q, _, _ = in_view(self._scene, count, rng, self.margin)
        return q

    def near(self, q: Floats, spread: float, count: int, rng: np.random.Generator) -> tuple[Floats, Ints]:
        """Draw poses in view near others.

        Args:
            q: (K, n) the others. [rad or m]
            spread: standard deviation, as a share of the joints' ranges.
            count: draws near each.
            rng: the source of randomness.

        Returns:
            (N, n) those in view, and (N,) which one each is near.
        """
        chain, (lower, upper) = self._scene.chain, joint_limits(self._scene.chain)
        lower, upper, of = chain.readings(lower), chain.readings(upper), np.repeat(np.arange(len(q)), count)
        steps = spread * (upper - lower) * rng.standard_normal((len(of), len(lower)))
        values = chain.joint_values(np.clip(chain.readings(q[of]) + steps, lower, upper))
        good, _ = are_in_view(self._scene, values, self.margin)
        return values[good], of[good]

    def takes(self, q: Floats) -> bool:
        """Return whether at ``q`` (n,), in view, the arm keeps clear of everything and hides no LED."""
        if self._checker is None:
            return True
        key = q.tobytes()
        if key not in self._known:
            # Most poses near others collide: where the cameras are is worked out for the rest alone.
            self._known[key] = self._checker.is_free(q) and self._checker.is_seen(
                q, self._scene.camera_centres(q[None])[0]
            )
        return self._known[key]
