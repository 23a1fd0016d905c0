"""How near the calibrated arm comes to the best that the data allow.

    python tests/benchmarks/accuracy.py [--seeds 20] [--poses 50] [--rigs ur5 ...] [--no-priors] [--outliers 0.1]

For every rig and seed: simulate, calibrate, and compare the tip with the true robot over the workspace, after base
alignment. Printed are medians over the seeds, and at the end rms:

- bound: what the estimate can be expected to reach, from the information of the true Jacobian (pixels and joint
  readings), propagated to the tip. Without priors it is Cramer and Rao's; with them it is the error that least squares
  with the session's tolerances has on robots as the simulator draws them;
- Bayes: the same with each parameter's own spread in the simulator as its prior, which nobody can know: the least
  error there is.

Ten poses of a ur5 (--poses 10 --rigs ur5 --seeds 40): the bound is 2.11 mm rms without priors and 0.79 mm with the
default tolerances, 2.65 times less (by medians 2.33 times), and the estimate reaches it. Tolerances as wide as the
simulator's spread of all lengths, of all angles and of all zeros would make it 2.76 times. Three times and more (Bayes:
4.2) takes to know of each parameter how good it is: that a is 0.2 mm off and not 1, alpha of parallel rows 4.5 mrad
and not 2.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tests.states import true_state_of
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.joint_models.time_offset import TIME_OFFSETS, time_offsets
from urdfcal.estimation.linearize import Tangent
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.dh import DHTable
from urdfcal.robot.kinematics import tip_motion
from urdfcal.rotations import skew
from urdfcal.session.knowledge import Estimate
from urdfcal.simulation.simulate import draw_offsets, simulate

if TYPE_CHECKING:
    from urdfcal.simulation.truth import Simulated

WORKSPACE = 500
# Draws of a robot that give the spreads to 1 %.
DRAWS = 4000


def information_of(problem: Problem, state, parameters) -> np.ndarray:
    """What pixels tell of the active parameters, joint readings being noisy: the inverse of the bound, (P, P)."""
    (block,) = problem.observations
    at = Tangent.at(problem, block, state, parameters).linearise()
    N, m, D, P = at.J.shape
    J, J_q, joint_sigma = at.J.reshape(N, m * D, P), at.J_q, problem.joint_sigma
    noise = np.zeros((N, m, D, m, D))
    each = np.arange(m)
    noise[:, each, :, each, :] = np.moveaxis(block.covariance, 1, 0)
    noise = noise.reshape(N, m * D, m * D) + joint_sigma**2 * J_q @ np.swapaxes(J_q, 1, 2)
    return np.einsum("nip,nij,njs->ps", J, np.linalg.inv(noise), J)


@dataclass(frozen=True)
class Knowledge:
    """What there is to know of P parameters, and what they do to the tip.

    Attributes:
        information: (P, P) of the pixels and the joint readings.
        tip: (3 k, P) how k tips move, whose base is aligned.
        prior: (P,) standard deviations that the calibration assumes; inf without.
        drawn: (P,) root mean squares of what the simulator draws; inf for the base.
    """

    information: np.ndarray
    tip: np.ndarray
    prior: np.ndarray
    drawn: np.ndarray

    @classmethod
    def of(cls, simulated: Simulated, q: np.ndarray, *, priors: bool) -> Knowledge:
        session = simulated.session
        table = DHTable.from_chain(session.chain)
        problem, truth = Problem.of(session, table), true_state_of(simulated)
        spec = ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2, priors=priors)
        parameters = identify(problem, truth, choose_parameters(session, problem, truth, spec)).parameters
        motion = tip_motion(table.chain, table.chain.build_model(table.placements(truth[ARM])), q)
        A = np.zeros((len(q), 3, parameters.count))
        twists = table.twists(truth[ARM], parameters.arm_rows)
        A[..., parameters.active_columns(ARM)[0]] = (motion.regressor @ twists)[:, :3]
        A = A.reshape(-1, parameters.count)
        rigid = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), -skew(motion.p)], axis=2).reshape(-1, 6)

        rng = np.random.default_rng(0)
        spread = np.sqrt(np.mean([draw_offsets(table, rng) ** 2 for _ in range(DRAWS)], axis=0))
        drawn = np.full(parameters.size, np.inf)
        drawn[parameters.columns(ARM)] = [spread[row, table.columns.index(name)] for row, name in table.parameters]
        drawn[parameters.columns(LEDS)] = np.repeat([led.sigma for led in session.leds], 3)
        clocks = parameters.columns(TIME_OFFSETS)
        drawn[clocks] = np.abs(time_offsets(truth))[: clocks.stop - clocks.start]
        return cls(
            information_of(problem, truth, parameters),
            A - rigid @ np.linalg.lstsq(rigid, A, rcond=None)[0],
            parameters.prior[parameters.active],
            drawn[parameters.active],
        )

    def reachable(self) -> float:
        """The tip's expected rms error by least squares with the priors that are assumed. [m]"""
        L = np.diag(self.prior**-2.0)
        pull = L @ np.where(np.isfinite(self.prior), self.drawn, 0.0)[:, None]
        H = np.linalg.inv(self.information + L)
        return self._rms(H @ (self.information + pull * np.eye(len(L)) * pull.T) @ H, slice(None))

    def bayes(self) -> float:
        """The same with the simulator's own spreads as priors: the least there is. [m]"""
        varied = np.flatnonzero(self.drawn > 0.0)
        precision = np.diag(self.drawn[varied] ** -2.0)
        return self._rms(np.linalg.inv(self.information[np.ix_(varied, varied)] + precision), varied)

    def _rms(self, covariance: np.ndarray, columns: slice | np.ndarray) -> float:
        A = self.tip[:, columns]
        return float(np.sqrt(3.0 * np.trace(A @ covariance @ A.T) / len(A)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--poses", type=int, default=50)
    parser.add_argument("--rigs", nargs="*", default=["elbow3r", "panda", "so101", "stanford", "ur5"])
    parser.add_argument("--no-priors", action="store_true")
    parser.add_argument("--outliers", type=float, default=0.0)
    arguments = parser.parse_args()
    print("medians in mm  nominal     error     bound     Bayes  error/bound  nominal/error   rms: error     bound")
    for name in arguments.rigs:
        rig = read_rig(find_rig(name))
        rows, found, moved = [], 0, 0
        for seed in range(arguments.seeds):
            simulated = simulate(rig, poses=arguments.poses, seed=seed, pixel=0.1, outliers=arguments.outliers)
            session = replace(simulated.session, estimate=Estimate("dh", "fixed", "fixed"))
            calibration = calibrate(session, priors=not arguments.no_priors, force=True)
            nominal = calibration.chain
            q = nominal.random_values(WORKSPACE, np.random.default_rng(seed))
            true, built = (
                nominal.with_placements(placements)
                for placements in (simulated.truth.placements, calibration.placements)
            )
            errors = [np.sqrt(np.mean(compare(robot, true, q).position ** 2)) for robot in (nominal, built)]
            bound = Knowledge.of(simulated, q, priors=not arguments.no_priors).reachable()
            rows.append([*errors, bound, Knowledge.of(simulated, q, priors=True).bayes()])
            found += len(calibration.document.outliers)
            moved += len(simulated.truth.outliers)
        before, after, bound, least = 1e3 * np.median(rows, axis=0)
        _, rms, rms_bound, _ = 1e3 * np.sqrt(np.mean(np.square(rows), axis=0))
        print(f"{name:12} {before:9.4f} {after:9.4f} {bound:9.4f} {least:9.4f}  {after / bound:11.3f}", end="")
        print(f" {before / after:14.2f} {rms:12.4f} {rms_bound:9.4f}", end="")
        print(f"   {found} of {moved} moved sightings listed" if moved else "")


if __name__ == "__main__":
    main()
