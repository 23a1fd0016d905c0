"""Which 8 of a real arm's measured poses to calibrate from: planned ones against random ones, judged on the rest.

    python tests/benchmarks/subsets.py SESSION [--start 3] [--count 8] [--draws 20]

Planning knows the arm as ``--start`` random poses give it, which count among the planned ones. Errors are distances of
what was measured in the other poses from what the calibrated arm predicts, rms in mm.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import rms
from urdfcal.errors import UrdfcalError
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.uncertainty import tip_sensitivity
from urdfcal.io.folder import read_session
from urdfcal.pipeline import calibrate
from urdfcal.planning.belief import Belief
from urdfcal.planning.design import Candidates, choose
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from urdfcal.session.model import Session


def error(session: Session, chosen: np.ndarray) -> float:
    """What a calibration from some poses leaves on the others, rms. [mm]"""
    calibration = calibrate(session.at(np.sort(chosen)), force=True)
    problem = Problem.of(session, calibration.problem.arm)
    (observed,) = problem.observations
    rest = ~np.isin(observed.pose, chosen)
    return 1e3 * rms(problem.off(observed, calibration.fit.state)[rest][observed.valid[rest]])


def planned(session: Session, start: np.ndarray, count: int) -> np.ndarray:
    """The poses that were there, and those that bring most beside them."""
    belief = Belief.of_calibration(calibrate(session.at(np.sort(start)), force=True))
    problem = Problem.of(session, belief.problem.arm)
    (observed,) = problem.observations
    A = tip_sensitivity(belief.problem, belief.state, belief.parameters, session.q)
    R = np.linalg.qr(A.reshape(-1, belief.parameters.count), mode="r") / np.sqrt(len(session.q))
    candidates = Candidates(belief.factors(problem, observed), R.T)
    free = ~np.isin(np.arange(len(session.poses)), start)
    return np.concatenate([start, choose(candidates, belief.information, count - len(start), free=free)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session")
    parser.add_argument("--start", type=int, default=3)
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--draws", type=int, default=20)
    arguments = parser.parse_args()
    session = replace(read_session(arguments.session), estimate=Estimate("dh"))
    found: dict[str, list[float]] = {"planned": [], "random": [], "twice": []}
    for seed in range(arguments.draws):
        order = np.random.default_rng(seed).permutation(len(session.poses))
        count = arguments.count
        try:
            chosen = planned(session, order[: arguments.start], count)
            errors = [error(session, of) for of in (chosen, order[:count], order[: 2 * count])]
        except UrdfcalError as failed:
            print(f"seed {seed}: {failed}")
            continue
        for name, value in zip(found, errors, strict=True):
            found[name].append(value)
    for name, values in found.items():
        print(
            f"{name:8} median {np.median(values):.3f} mm of {len(values)}, 10 to 90 %:", np.percentile(values, [10, 90])
        )


if __name__ == "__main__":
    main()
