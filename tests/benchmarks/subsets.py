"""Which 8 of a real arm's measured poses to calibrate from: planned ones against random ones, judged on the rest.

    python -m tests.benchmarks.subsets SESSION [--count 8] [--draws 10] [--candidates 300] [--misfit 1 3]

Before anything is measured poses are planned for the nominal arm, among ``--candidates`` random ones, for ``--misfit``
times the noise that is declared, since no arm is as its model; ``--elastic`` with compliance for both. Errors are those
of `urdfcal evaluate RESULT` on the other poses, base and probe fitted to them as a plan serves the tip whatever the
base is: rms in mm; medians over the draws, and their quartiles.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import one_blas_thread, rms
from urdfcal.estimation.evaluation import explain
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.uncertainty import tip_sensitivity
from urdfcal.io.folder import read_session
from urdfcal.pipeline import calibrate
from urdfcal.planning.belief import Belief
from urdfcal.planning.design import Candidates, choose
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from urdfcal.session.model import Session

MODELS = ("compliance", "lag", "backlash", "harmonics")
# Poses that place base and probe for the nominal arm, to linearise at; what they tell does not count.
PLACED, WORKSPACE = 50, 200


def error(session: Session, chosen: np.ndarray) -> float:
    """What a calibration from some poses leaves on the others, rms; base and probe are fitted to these. [mm]."""
    calibration = calibrate(session.at(np.sort(chosen)), force=True)
    rest = session.at(np.setdiff1d(np.arange(len(session.poses)), chosen))
    (residual,) = explain(calibration.calibrated, rest, bends=calibration.joint_models).residuals
    return 1e3 * rms(np.linalg.norm(residual, axis=1))


def planned(session: Session, belief: Belief, among: np.ndarray, count: int, misfit: float) -> np.ndarray:
    """The poses that bring most."""
    workspace = session.q[np.linspace(0, len(session.q) - 1, WORKSPACE).astype(int)]
    A = tip_sensitivity(belief.problem, belief.state, belief.parameters, workspace)
    R = np.linalg.qr(A.reshape(-1, belief.parameters.count), mode="r") / np.sqrt(WORKSPACE)
    few = Problem.of(session.at(among), belief.problem.arm)
    (observed,) = few.observations
    candidates = Candidates(replace(belief, misfit=misfit).factors(few, observed), R.T)
    J = belief.parameters.prior_residuals(belief.state)[1]
    # What has no prior is the base and the probe, known by eye.
    known = J.T @ J + np.diag(np.where(np.any(J, axis=0), 0.0, 1e2))
    return among[list(choose(candidates, known, count))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session")
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--candidates", type=int, default=300)
    parser.add_argument("--misfit", type=float, nargs="*", default=[1.0, 3.0, 6.0])
    parser.add_argument("--elastic", action="store_true")
    arguments = parser.parse_args()
    models = {name: name == "compliance" and arguments.elastic for name in MODELS}
    session = replace(read_session(arguments.session), estimate=Estimate("dh"), joint_models=models)
    found: dict[str, list[float]] = {}
    rng, count = np.random.default_rng(0), arguments.count
    with one_blas_thread():
        placed = session.at(np.linspace(0, len(session.poses) - 1, PLACED).astype(int))
        belief = Belief.of_calibration(calibrate(replace(placed, estimate=Estimate("none")), force=True))
        for _ in range(arguments.draws):
            some = rng.choice(len(session.poses), arguments.candidates, replace=False)
            chosen = {f"{count} random": some[:count], f"{2 * count} random": some[: 2 * count]}
            for misfit in arguments.misfit:
                chosen[f"{count} planned, noise x {misfit:g}"] = planned(session, belief, np.sort(some), count, misfit)
            for name, poses in chosen.items():
                found.setdefault(name, []).append(error(session, poses))
    print(f"{'rms mm on the rest':24}{'median':>8}{'quartiles':>16}{'to random':>11}")
    base = float(np.median(found[f"{count} random"]))
    for name, errors in found.items():
        low, median, high = np.percentile(errors, [25.0, 50.0, 75.0])
        print(f"{name:24}{median:8.3f}{low:8.3f}{high:8.3f}{median / base - 1.0:11.0%}")


if __name__ == "__main__":
    main()
