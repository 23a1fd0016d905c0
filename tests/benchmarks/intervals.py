"""Whether the intervals are true where the arm, or the scale, is not what was thought.

    python tests/benchmarks/intervals.py [--seeds 10] [--rigs ur5,panda]

Whole calibrations, joint models chosen by the data. Prints how many of the 95 % intervals of the arm's parameters hold
the truth (93 ... 97 % is right on clean sessions, 90 % is required elsewhere), and of how many sessions the true tip
error is within the claimed interval, and below its upper end.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != Path(__file__).resolve().parent]
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.benchmarks.verdicts import clean, error  # noqa: E402
from tests.worlds import erring, sagging, scaled  # noqa: E402
from urdfcal.estimation.blocks.arm import ARM  # noqa: E402
from urdfcal.pipeline import calibrate  # noqa: E402
from urdfcal.robot.dh import PARAMETERS  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated

SCALE_SIGMA = 3e-3


def of_another_scale(data: Simulated) -> Session:
    """A wrong scale within the sigma that is declared for it."""
    wrong = float(np.random.default_rng(data.truth.seed).normal(0.0, SCALE_SIGMA))
    return replace(scaled(data, wrong), scale_sigma=SCALE_SIGMA)


WORLDS: dict[str, Callable[[Simulated], Session]] = {
    "clean": lambda data: data.session,
    "sag": lambda data: sagging(data, 4e-5),
    "eccentric": lambda data: erring(data, eccentricity=5e-4),
    "scale": of_another_scale,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rigs", default="ur5,panda")
    arguments = parser.parse_args()
    print(f"{'rig':8} {'session':10} {'parameters':>10} {'tip within':>10} {'tip below':>10}")
    for rig in arguments.rigs.split(","):
        for name, make in WORLDS.items():
            held, within, below = [], [], []
            for seed in range(arguments.seeds):
                data = clean(rig, seed)
                calibration = calibrate(make(data), force=True)
                fit = calibration.comparison.chosen.fit
                sigma = fit.parameters.sigmas(fit.covariance)[fit.parameters.columns(ARM)]
                offsets = fit.state[ARM] - data.truth.offsets
                off = np.array([offsets[row, PARAMETERS.index(name)] for row, name in calibration.table.parameters])
                held.append((np.abs(off) < 1.96 * sigma)[np.isfinite(sigma) & (sigma > 0.0)])
                true, (low, high) = error(data, calibration.placements), calibration.evidence.tip.interval
                within.append(low <= true <= high)
                below.append(true <= high)
            shares = (np.mean(np.concatenate(held)), np.mean(within), np.mean(below))
            print(f"{rig:8} {name:10} " + " ".join(f"{share:10.1%}" for share in shares), flush=True)


if __name__ == "__main__":
    main()
