"""How far two robots are apart, and how well one explains a session."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Floats, frozen
from urdfcal.errors import RobotError
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.joint_models.time_offset import time_offsets
from urdfcal.estimation.model_spec import nominal
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import solve
from urdfcal.estimation.time_offset_start import start_state
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.bending import bent
from urdfcal.session.moves import resolve_moves

if TYPE_CHECKING:
    from urdfcal.estimation.joint_models.found import FoundJointModels
    from urdfcal.estimation.solver import Progress, Solution
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.knowledge import Freedom
    from urdfcal.session.model import Session


_OF_JOINTS = frozenset(kind.name for kind in JOINT_MODELS if issubclass(kind, LinearJointModel))

# Tips that spread by less in a second direction do not fix an alignment; their axes then count at this length. [m]
_SPREAD = 0.01


@dataclass(frozen=True)
class Spread:
    """Distances or angles in five numbers.

    Attributes:
        rms: root mean square. [m, rad or px]
        mean: mean.
        median: half of the values are at most this.
        p95: 95 % of the values are at most this.
        max: largest.
    """

    rms: float
    mean: float
    median: float
    p95: float
    max: float

    @classmethod
    def of(cls, values: Floats) -> Spread:
        """Summarise non-negative values; NaN where there are none."""
        if values.size == 0:
            return cls(*[float("nan")] * 5)
        return cls(
            float(np.sqrt(np.mean(values**2))),
            float(np.mean(values)),
            float(np.median(values)),
            float(np.percentile(values, 95)),
            float(np.max(values)),
        )


@dataclass(frozen=True, eq=False)
class Difference:
    """The tips of two robots at the same joint values.

    Attributes:
        position: (N,) distance of the tips after the best rigid alignment at the base. [m]
        orientation: (N,) angle between them after it. [rad]
        position_unaligned: (N,) distance with the base links laid over each other. [m]
        orientation_unaligned: (N,) angle with the base links laid over each other. [rad]
        T_a_b: (4, 4) the alignment: b's base link in a's. [m]
    """

    position: Floats
    orientation: Floats
    position_unaligned: Floats
    orientation_unaligned: Floats
    T_a_b: Floats


def compare(a: Mechanism, b: Mechanism, q: Floats) -> Difference:
    """Compare two versions of one robot over joint configurations.

    The alignment minimises the tips' distances (Kabsch): how a robot is bolted down is nothing its URDF could know.

    Args:
        a: first robot's chain.
        b: second robot's chain, with the same joints.
        q: (N, n) joint values. [rad or m]

    Raises:
        RobotError: the chains do not have the same joints.
    """
    if a.names != b.names:
        raise RobotError(
            f"the two robots have different joints between base and tip: {', '.join(a.names)} and {', '.join(b.names)}",
            remedy="Compare two versions of the same robot, with the same --base and --tip.",
        )
    return compare_tips(tip_poses(a, q), tip_poses(b, q))


def compare_tips(tips_a: Floats, tips_b: Floats) -> Difference:
    """Compare where two versions of one robot have their tip, T_base_tip (N, 4, 4) each; see :func:`compare`."""
    T_a_b = kabsch(_markers(tips_b), _markers(tips_a))
    aligned = T_a_b @ tips_b
    return Difference(
        position=frozen(_distance(tips_a, aligned)),
        orientation=frozen(_angle(tips_a, aligned)),
        position_unaligned=frozen(_distance(tips_a, tips_b)),
        orientation_unaligned=frozen(_angle(tips_a, tips_b)),
        T_a_b=frozen(T_a_b),
    )


@dataclass(frozen=True, eq=False)
class Explanation:
    """A session under an arm that is not corrected.

    Attributes:
        residuals: for each kind of measurement (S, D) predicted minus measured, in the order of the problem's
            table, without frames that have no joint readings. [unit of the kind]
        fit: base pose, LED positions and camera poses.
        problem: of those measurements.
    """

    residuals: tuple[Floats, ...]
    fit: Solution
    problem: Problem


def explain(
    chain: Mechanism,
    session: Session,
    progress: Progress | None = None,
    bends: FoundJointModels | None = None,
) -> Explanation:
    """Fit base pose, LED positions and, for pixels, camera poses to a session; the arm stays as ``chain`` says.

    Args:
        chain: the arm.
        session: what was measured; its own chain is not used.
        progress: called after every solver step.
        bends: the arm's joint models; they act under the session's payload, gravity and torques.

    Raises:
        CalibrationError: no start from these measurements.
    """
    models = () if bends is None else bends.of_session(session)
    # Distances of places are a check of the arm.
    session = resolve_moves(replace(session, chain=chain, place_distances=()))
    # What joints do is not estimated: only what a session says of clocks counts.
    said = {name: of for name, of in session.joint_models.items() if name not in _OF_JOINTS}
    session = replace(session, joint_models=said)
    arm = rows_of(chain)
    start = start_state(session, arm, no_offsets(arm))
    session = session.recorded(time_offsets(start))
    problem = Problem.of(session if bends is None else bent(session, bends.bending), arm)
    rigid = (model for model in problem.joint_models if not isinstance(model, LinearJointModel))
    problem = replace(problem, joint_models=(*rigid, *models))
    spec = nominal(session, start)
    free: Freedom = "free"
    spec = replace(spec, extrinsics=(free,) * len(spec.extrinsics))
    start = start.replace({} if bends is None else bends.values)
    fit = solve(problem, start, choose_parameters(session, problem, start, spec), progress)
    residuals = [observed.by_row(problem.residual(observed, fit.state)) for observed in problem.observations]
    return Explanation(tuple(residuals), fit, problem)


def _markers(tips: Floats) -> Floats:
    """The points to align by: the tips' origins, and where those hardly spread out, their axes as well."""
    origins = tips[:, :3, 3]
    spread = np.linalg.svd(origins - origins.mean(axis=0), compute_uv=False) / np.sqrt(len(tips))
    if spread[1] > _SPREAD:
        return origins
    return np.concatenate([origins, *(origins + _SPREAD * tips[:, :3, axis] for axis in range(3))])


def _distance(a: Floats, b: Floats) -> Floats:
    result: Floats = np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1)
    return result


def _angle(a: Floats, b: Floats) -> Floats:
    # |R_a - R_b| = 2 sqrt(2) sin(angle / 2) stays accurate for small angles, where the trace does not.
    chord = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2)) / (2.0 * np.sqrt(2.0))
    result: Floats = 2.0 * np.arcsin(np.minimum(chord, 1.0))
    return result
