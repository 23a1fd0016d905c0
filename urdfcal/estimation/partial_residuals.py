"""Partial residuals: what the measurements say of a joint, beside the joint model that explains it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import frozen
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.whitening import Whitening, joint_noise

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.arrays import Floats
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution

# More poses make the same picture.
_MOST_POSES = 500


@dataclass(frozen=True, eq=False)
class PartialResiduals:
    """A joint model of one joint, at N poses.

    Attributes:
        joint: its name.
        unit: of its values, rad or m.
        model: the joint model's name.
        axis: what it is shown over, and the unit of that.
        at: (N,) where the poses are on that axis.
        value: (N,) what the model adds to the reading. [unit]
        left: (N,) what more the measurements of the pose would have it add. [unit]
    """

    joint: str
    unit: str
    model: str
    axis: str
    at: Floats
    value: Floats
    left: Floats

    def __post_init__(self) -> None:
        for name in ("at", "value", "left"):
            object.__setattr__(self, name, frozen(getattr(self, name)))


def partial_residuals(problem: Problem, fit: Solution) -> Iterator[PartialResiduals]:
    """Compute partial residuals of each joint model that is part of an estimate, joint by joint.

    A pose's residuals are explained by a change of the one joint's value, by weighted least squares; with what the
    model says, that is what is seen of the joint without the model (Larsen and McCleary, Technometrics 14, 1972).

    Args:
        problem: what was measured; of several kinds of measurements the first is shown.
        fit: the estimate.
    """
    observed, kept = problem.observations[0], fit.kept[0]
    some = observed.even(_MOST_POSES)
    at = Tangent.at(problem, observed.at(some), fit.state, fit.parameters).linearise()
    N, m, D = at.residual.shape
    used = np.repeat(kept[some], D, axis=1)[..., None]
    effect = joint_noise(at, problem.mechanism.reading_jacobian, 1.0)
    whiten = Whitening.of(observed.covariance[some], effect[..., :0])
    r, B = (used * whiten(of) for of in (at.residual.reshape(N, m * D, 1), effect))
    readings = observed.readings.at(some)
    for model in problem.joint_models:
        if not isinstance(model, LinearJointModel) or not np.any(fit.state[model.key]):
            continue
        features, values = model.known_features(readings), model.jacobian(readings, fit.state[model.key])
        for j, joint in enumerate(problem.arm.chain.actuated_joints):
            mine = model.of_joints([joint.name]) & (fit.state[model.key] != 0.0)
            strength = np.sum(B[..., j] ** 2, axis=1)
            seen = strength > 0.0
            own = problem.mechanism.joints.index(joint)
            # What bends a link is no matter of the joint's own value.
            if not np.any(values[:, own][:, mine]) or not seen.any():
                continue
            left = -np.sum(B[..., j] * r[..., 0], axis=1)[seen] / strength[seen]
            value = (values[:, own][:, mine] @ fit.state[model.key][mine])[seen]
            over, axis = readings.q[:, own], f"{joint.name} [{joint.unit}]"
            if model.over is not None:
                words, turning, sliding = model.over
                over, axis = (
                    features[:, np.flatnonzero(mine)[0]],
                    f"{words} [{sliding if joint.prismatic else turning}]",
                )
            yield PartialResiduals(joint.name, joint.unit, model.name, axis, over[seen], value, left)
