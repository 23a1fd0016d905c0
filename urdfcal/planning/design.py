"""Optimal design: of many candidate poses those that make the tip most accurate (METHOD 16).

What a pose k adds to the information of the parameters is F_k^T F_k, with F_k its whitened Jacobian. Poses are chosen
that minimise trace(C W), the tip's expected squared error, with C the parameters' covariance and W how the tip follows
the parameters: A-optimality, weighted (Fedorov 1972; Sun & Hollerbach, ICRA 2008). By the identity of Woodbury, pose k
takes trace[(1 + F C F^T)^-1 (F C W C F^T)] from it, for all candidates at once in a few matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import covariance_of, frozen, one_blas_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.arrays import Floats

# Passes of the exchange; the second one changes little, and what a third one changes is below 0.1 %.
_PASSES = 3
# Nine estimates in ten are at most so many standard deviations off.
_NINE_IN_TEN = 1.2816
BETTER = 1e-6
"""A pose is exchanged for one that is better by more than rounding."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """What candidate poses tell, and what it is to serve.

    Attributes:
        factors: (N, r, P) whitened Jacobian of each pose: F^T F is the information that it adds.
        tip: (P, w) L of W = L L^T: trace(C W) is the tip's expected squared error. [m per unit of the parameter]
    """

    factors: Floats
    tip: Floats

    def of(self, which: Sequence[int]) -> Candidates:
        """Return some of them, in that order."""
        return Candidates(self.factors[np.array(which, dtype=np.intp)], self.tip)

    def __add__(self, other: Candidates) -> Candidates:
        """Return these and others, which serve the same."""
        return Candidates(np.concatenate([self.factors, other.factors]), self.tip)

    def information(self, chosen: Sequence[int]) -> Floats:
        """Return what some of them add together, (P, P)."""
        F = self.of(chosen).factors.reshape(-1, self.factors.shape[2])
        return np.asarray(F.T @ F)

    def error(self, information: Floats) -> float:
        """Return the tip's expected rms error at an information (P, P). [m]."""
        return float(np.sqrt(np.sum((covariance_of(information) @ self.tip) * self.tip)))

    def likely(self, information: Floats) -> float:
        """Return what the tip's rms error is at most in nine of ten arms, at an information (P, P). [m].

        The squared error is a sum of squares of normal numbers: a chi-square of as many degrees of freedom as give it
        its mean and variance (Welch and Satterthwaite), by the cube root of Wilson and Hilferty.
        """
        strengths = np.linalg.eigvalsh(self.tip.T @ covariance_of(information) @ self.tip)
        mean, freedom = float(np.sum(strengths)), float(np.sum(strengths) ** 2 / np.sum(strengths**2))
        spread = 2.0 / (9.0 * freedom)
        return float(np.sqrt(mean * (1.0 - spread + _NINE_IN_TEN * np.sqrt(spread)) ** 3))

    def gains(self, information: Floats) -> Floats:
        """Return what each pose (N,) would take from the tip's expected squared error. [m^2]."""
        N, r, P = self.factors.shape
        C = covariance_of(information)
        with one_blas_thread():
            G = self.factors.reshape(-1, P) @ C
            B = (G @ self.tip).reshape(N, r, -1)
            S = np.eye(r) + G.reshape(N, r, P) @ np.swapaxes(self.factors, 1, 2)
            result: Floats = np.einsum("nij,nji->n", np.linalg.inv(S), B @ np.swapaxes(B, 1, 2))
        return result

    def course(self, known: Floats, chosen: Sequence[int]) -> tuple[Floats, Floats]:
        """Return :meth:`error` and :meth:`likely` before poses and after each of them, (K + 1,) each. [m]."""
        informations = [known + self.information(chosen[:k]) for k in range(len(chosen) + 1)]
        return frozen([self.error(of) for of in informations]), frozen([self.likely(of) for of in informations])

    def best(self, information: Floats, allowed: Callable[[int], bool], above: float = -np.inf) -> int | None:
        """Return the pose that brings most, of those that are allowed; None where none brings more than ``above``.

        What is allowed is asked of one after the other, the best ones first.
        """
        return first_allowed(self.gains(information), allowed, above)


def first_allowed(gains: Floats, allowed: Callable[[int], bool], above: float = -np.inf) -> int | None:
    """Return the largest of gains (N,) that is allowed; None where none of these is above a value."""
    for k in np.argsort(-gains, kind="stable").tolist():
        if gains[k] <= above:
            return None
        if allowed(k):
            return int(k)
    return None


def choose(
    candidates: Candidates,
    known: Floats,
    count: int,
    *,
    allowed: Callable[[int], bool] | None = None,
    until: float = 0.0,
    progress: Callable[[float], object] | None = None,
) -> tuple[int, ...]:
    """Choose poses one by one, each the one that brings most, then exchange each for a better one while there is any.

    Args:
        candidates: to choose from, each once.
        known: (P, P) information without them, priors included.
        count: how many at most.
        allowed: which of them may be chosen; all by default. It is asked only of those that would be.
        until: enough when the tip's rms error is no larger in nine of ten arms. [m]
        progress: called with the number of poses chosen since the last call.

    Returns:
        Indices of the chosen ones, what brings most first.
    """
    chosen: list[int] = []

    def free(k: int) -> bool:
        return k not in chosen and (allowed is None or allowed(k))

    information = known + candidates.information(chosen)
    while len(chosen) < count and candidates.likely(information) > until:
        best = candidates.best(information, free)
        if best is None:
            break
        chosen.append(best)
        information = information + candidates.information([best])
        if progress is not None:
            progress(1)
    for _ in range(_PASSES):
        if not _exchange(candidates, known, chosen, free):
            break
    return tuple(chosen[k] for k in enough(candidates.of(chosen), known, until))


def enough(candidates: Candidates, known: Floats, until: float = 0.0) -> list[int]:
    """Order all poses, those that bring most first, as many as make the tip's error no larger than ``until``. [m]."""
    order: list[int] = []

    def left(k: int) -> bool:
        return k not in order

    while len(order) < len(candidates.factors):
        information = known + candidates.information(order)
        best = candidates.best(information, left)
        if best is None or candidates.likely(information) <= until:
            break
        order.append(best)
    return order


def _exchange(candidates: Candidates, known: Floats, chosen: list[int], free: Callable[[int], bool]) -> bool:
    """Put a better pose in the place of each one, where there is one; say whether that changed anything."""
    changed = False
    for place, old in enumerate(chosen):
        gains = candidates.gains(known + candidates.information([k for k in chosen if k != old]))
        best = first_allowed(gains, free, gains[old] * (1.0 + BETTER))
        if best is not None:
            chosen[place], changed = best, True
    return changed
