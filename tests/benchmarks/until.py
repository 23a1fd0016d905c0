"""Whether `urdfcal plan --until X` stops where the arm is as good as asked for.

    python -m tests.benchmarks.until [--arms 100] [--start 8] [--processes 1]

Each arm is simulated, measured in ``--start`` random poses and calibrated; then what `--until` asks for is measured,
too, until it asks for nothing more. Asked for: the true tip error over the joints' ranges is within 1.2 X in 90 %.
"""

from __future__ import annotations

import argparse

import numpy as np
from joblib import Parallel, delayed

from tests.measuring import measured_too, true_error
from urdfcal.arrays import one_blas_thread
from urdfcal.errors import UrdfcalError
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.planning.planner import Planner
from urdfcal.simulation.simulate import simulate

# What some 15 to 40 poses bring. [m]
RIGS = {"ur5": (1.5e-4, 3e-4), "panda": (1.5e-4, 3e-4), "so101": (1.5e-4, 3e-4), "elbow3r": (1e-4, 2e-4)}
RIGS |= {"stanford": (1.5e-4, 3e-4), "tiago": (6e-4, 1.2e-3)}
MOST, ROUNDS = 100, 10


def stopped(name: str, seed: int, start: int) -> tuple[float, int, int, float] | str:
    """X and the true error [m] when it stopped, poses and rounds until then; or why it did not."""
    until = float(np.random.default_rng(seed).uniform(*RIGS[name]))
    with one_blas_thread():
        simulated = simulate(read_rig(find_rig(name)), seed=seed, poses=start)
        session = simulated.session
        for round_ in range(ROUNDS + 1):
            try:
                plan = Planner(session).plan(MOST, until=until)
            except UrdfcalError as error:
                return f"{name} {seed}: {error.what}"
            if not plan.count:
                error = true_error(simulated, calibrate(session, force=True))
                return until, len(session.poses), round_, error
            if plan.likely[-1] > until:
                return f"{name} {seed}: {1e3 * until:.3g} mm is not reached"
            session = measured_too(session, simulated, plan.q[plan.rank >= 0], 100 * seed + round_)
    return f"{name} {seed}: goes on after {ROUNDS} rounds"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=100)
    parser.add_argument("--start", type=int, default=8)
    parser.add_argument("--rigs", nargs="*", default=["ur5", "panda", "so101", "elbow3r", "stanford"])
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    each = -(-arguments.arms // len(arguments.rigs))
    print(f"{'rig':10}{'arms':>5}{'poses':>7}{'rounds':>7}{'error / X':>11}{'9 in 10':>9}{'within 1.2 X':>14}")
    every, troubles = [], []
    for name in arguments.rigs:
        tasks = (delayed(stopped)(name, seed, arguments.start) for seed in range(each))
        results = Parallel(n_jobs=arguments.processes)(tasks)
        troubles += [result for result in results if isinstance(result, str)]
        rows = [result for result in results if not isinstance(result, str)]
        every += rows
        if rows:
            _print(name, rows)
    _print("all", every)
    print("\n".join(troubles))


def _print(name: str, rows: list[tuple[float, int, int, float]]) -> None:
    until, poses, rounds, error = np.array(rows).T
    ratio = error / until
    print(f"{name:10}{len(rows):5}{np.median(poses):7.0f}{np.median(rounds):7.0f}{np.median(ratio):11.2f}", end="")
    print(f"{np.percentile(ratio, 90.0):9.2f}{np.mean(ratio <= 1.2):14.2f}", flush=True)


if __name__ == "__main__":
    main()
