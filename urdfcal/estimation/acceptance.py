"""Whether an arm is as good as it must be, from poses that its calibration has not seen (METHOD 13)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import rms
from urdfcal.errors import RobotError, SessionError
from urdfcal.estimation.assessment import MANY_OUTLIERS
from urdfcal.estimation.evaluation import explain
from urdfcal.estimation.validation import rms_interval
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Sequence

    from urdfcal.arrays import Bools, Ints
    from urdfcal.estimation.joint_models.found import FoundJointModels
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.solver import Progress
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Session


@dataclass(frozen=True)
class Acceptance:
    """The error of an arm at the LED, in poses that it was not calibrated with.

    Attributes:
        rms: what the measurements' own noise adds is in it; what the fit of base, LEDs and cameras took away, too. [m]
        interval: of the rms, 95 %. [m]
        configurations: how many distinct ones were judged, of a moving arm seconds.
        measurements: how many count.
        outliers: how many were left out.
        limit: what the rms may be at most. [m]
        repeats: poses in the configuration of an earlier one, or next to it.
        enlarged: rms over that of the residuals, which base, LEDs and cameras were fitted to.
    """

    rms: float
    interval: tuple[float, float]
    configurations: int
    measurements: int
    outliers: int
    limit: float
    repeats: tuple[str, ...] = ()
    enlarged: float = 1.0

    @property
    def too_many_outliers(self) -> bool:
        """Whether so many measurements were left out that the rest does not speak for all."""
        return self.outliers > MANY_OUTLIERS * (self.outliers + self.measurements)

    @property
    def within(self) -> bool | None:
        """Whether the arm is within the limit; None where that cannot be told."""
        low, high = self.interval
        if self.too_many_outliers or low <= self.limit < high:
            return None
        return high <= self.limit


def accept(
    chain: Mechanism,
    session: Session,
    limit: float,
    seed: int = 0,
    progress: Progress | None = None,
    bends: FoundJointModels | None = None,
) -> Acceptance:
    """Judge an arm by a session: base, LEDs and camera poses are fitted to it, the arm is not.

    Args:
        chain: the arm, calibrated.
        session: what was measured in new poses; its own chain is not used.
        limit: what the rms error at the LED may be at most. [m]
        seed: of the bootstrap.
        progress: called after every solver step.
        bends: the arm's joint models.

    Raises:
        RobotError: the arm has other joints than the session.
        SessionError: there are too few measurements to tell anything beside base, LEDs and cameras.
        CalibrationError: no start from these measurements.
    """
    if chain.names != session.chain.names:
        raise RobotError(
            f"the arm's joints are {', '.join(chain.names)}, the session's {', '.join(session.chain.names)}",
            remedy="Name a calibration of the robot that was measured.",
        )
    explained = explain(chain, session, progress, bends)
    problem, fit = explained.problem, explained.fit
    observations = problem.observations
    distance = [problem.off(of, fit.state) for of in observations]
    unit = problem.readings.unit
    numbers, taken = _numbers(observations, fit.kept, unit), fit.parameters.count
    if numbers <= taken:
        raise SessionError(
            f"{numbers} measured numbers of distinct configurations cannot judge an arm beside {taken} unknowns of "
            "base, LEDs and cameras",
            remedy="Measure more poses: a dozen, well apart.",
        )
    kept = [values[used] for values, used in zip(distance, fit.kept, strict=True)]
    found = rms(np.concatenate(kept))
    low, high = rms_interval(observations, fit.kept, distance, unit, seed)
    scale, width = _taken_away(numbers, taken)
    outliers, measurements = fit.counts
    judged = [of.pose[used.any(axis=1)] for of, used in zip(observations, fit.kept, strict=True)]
    poses = np.unique(np.concatenate(judged))
    moving = isinstance(session.motion, Trajectory)  # its configurations are seconds
    first = np.unique(unit[poses], return_index=True)[1]
    return Acceptance(
        rms=scale * found,
        interval=tuple(scale * found * (end / found) ** width for end in (low, high)) if found else (0.0, 0.0),
        configurations=len(first),
        measurements=measurements,
        outliers=outliers,
        limit=limit,
        repeats=() if moving else tuple(session.poses[pose] for pose in np.delete(poses, first).tolist()),
        enlarged=scale,
    )


def _taken_away(numbers: int, taken: int) -> tuple[float, float]:
    """What makes up for unknowns that were fitted to the same measurements: factors on an rms, and on its interval.

    The interval is that of its logarithm. It is wider by as much as fewer independent configurations are left, of
    which Student's t counts three errors each.
    """
    from scipy.special import stdtrit

    scale, left = float(np.sqrt(numbers / (numbers - taken))), (numbers - taken) / 3.0
    return scale, scale * float(stdtrit(left, 0.975) / stdtrit(np.inf, 0.975))


def _numbers(observations: Sequence[Observations], kept: Sequence[Bools], unit: Ints) -> int:
    """How many errors of the arm were measured: three of an LED in a configuration, however often it was seen there.

    One camera sees two of them. What repeats a configuration repeats its errors.
    """
    seen: dict[tuple[int, int], int] = {}
    for observed, used in zip(observations, kept, strict=True):
        keys = [np.broadcast_to(unit[observed.pose][:, None], used.shape)[used]]
        keys += [observed.index[name][used] for name in sorted(observed.index, key=lambda name: name != "led")]
        for one, led, *_ in np.unique(np.stack(keys, axis=1), axis=0).tolist():
            seen[one, led] = seen.get((one, led), 0) + observed.dimension
    return sum(min(count, 3) for count in seen.values())
