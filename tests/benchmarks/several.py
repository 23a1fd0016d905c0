"""What a bump in the middle of a session costs: nothing, if what moved is said, or both sides are calibrated together.

    python -m tests.benchmarks.several [--seeds 12] [--poses 60] [--rigs ur5 panda] [--bump 0.02]

Medians over the seeds of the tip's rms error over the workspace, in mm: of the session without a bump, of the bumped
one as it is, of it with ``moved: {base: [...]}``, of both sides as two sessions of one arm, and of the better side
alone; and of an LED that slipped, with ``moved: {led: [...]}``. Beside them the ratio to no bump.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tests.worlds import EVENT, bumped, slipped
from urdfcal.estimation.evaluation import compare
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.session.combine import combine
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated


def tip_error(session: Session, data: Simulated) -> float:
    """Rms error of the calibrated tip over the workspace. [mm]"""
    calibration = calibrate(session, force=True)
    chain = data.session.chain
    q = chain.random_values(500, np.random.default_rng(1))
    apart = compare(chain.with_placements(data.truth.placements), calibration.calibrated, q).position
    return 1e3 * float(np.sqrt(np.mean(apart**2)))


def errors(data: Simulated, bump: float) -> dict[str, float]:
    """The tip's error of each way to use what was measured. [mm]"""
    late, slid = bumped(data, bump), slipped(data, bump)
    every, first = np.arange(len(late.poses)), late.poses[EVENT : EVENT + 1]
    a, b = late.at(every[:EVENT]), late.at(every[EVENT:])
    return {
        "no bump": tip_error(data.session, data),
        "bumped": tip_error(late, data),
        "moved": tip_error(replace(late, moved={"base": first}), data),
        "together": tip_error(combine({"a": a, "b": b}), data),
        "better side": min(tip_error(a, data), tip_error(b, data)),
        "LED moved": tip_error(replace(slid, moved={slid.led_names[0]: first}), data),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--poses", type=int, default=60)
    parser.add_argument("--rigs", nargs="+", default=["ur5", "panda"])
    parser.add_argument("--bump", type=float, default=0.02, help="m, and rad")
    arguments = parser.parse_args()
    for name in arguments.rigs:
        rig = read_rig(find_rig(name))
        found = [
            errors(simulate(rig, poses=arguments.poses, seed=seed), arguments.bump) for seed in range(arguments.seeds)
        ]
        usual = float(np.median([each["no bump"] for each in found]))
        shown = {way: float(np.median([each[way] for each in found])) for way in found[0]}
        print(f"{name}: " + ", ".join(f"{way} {value:.3f} ({value / usual:.2f} x)" for way, value in shown.items()))


if __name__ == "__main__":
    main()
