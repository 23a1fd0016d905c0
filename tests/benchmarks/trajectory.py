"""Whether a moving arm calibrates as well as a still one.

    python tests/benchmarks/trajectory.py [--seeds 5] [--rig ur5] [--waypoints 15] [--offsets 0.02 -0.007]

For every seed: simulate a robot, film it on its way from pose to pose (0.5 rad/s, 30 Hz frames, 125 Hz joint readings,
clocks off by the offsets), and calibrate. Beside it the same frames with the arm at rest in each (the same places, read
at the moment of the picture), and as many poses planned one by one, each seen by both cameras. Printed are the errors
of the time offsets, and the tip's rms errors over the workspace after base alignment.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from urdfcal.calibration import FittedCalibration, calibrate
from urdfcal.estimation.evaluation import compare
from urdfcal.robot.chain import Chain
from urdfcal.session.files import read_rig
from urdfcal.session.model import Estimate, Session
from urdfcal.session.rigs import find_rig
from urdfcal.session.simulate import Simulated, simulate
from urdfcal.session.simulate_motion import Motion, set_in_motion

WORKSPACE = 500
GEOMETRY_ALONE = Estimate("dh", "fixed", "fixed")


def at_rest(moving: Simulated, rng: np.random.Generator) -> Session:
    """The same frames of an arm that stood still in each, read by the same encoders."""
    session = moving.session
    readings = session.chain.readings(moving.truth.q)
    readings = readings + session.noise.joint * rng.standard_normal(readings.shape)
    return replace(session, q=session.chain.joint_values(readings), trajectory=None)


def tip_error(calibration: FittedCalibration, simulated: Simulated) -> float:
    """Rms over the workspace, mm."""
    drawn = calibration.chain
    q = drawn.random_values(WORKSPACE, np.random.default_rng(0))
    built, true = (
        Chain(drawn.name, drawn.base_link, drawn.tip_link, drawn.joints, placements, drawn.T_last_tip)
        for placements in (calibration.placements, simulated.truth.placements)
    )
    return 1e3 * float(np.sqrt(np.mean(compare(built, true, q).position ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--rig", default="ur5")
    parser.add_argument("--waypoints", type=int, default=15)
    parser.add_argument("--offsets", type=float, nargs="*", default=[0.02, -0.007])
    parser.add_argument("--planned", action="store_true", help="also as many planned poses (minutes)")
    arguments = parser.parse_args()
    rig = read_rig(find_rig(arguments.rig))
    print("seed  frames  offsets off by (ms)   moving  at rest  ratio   planned (tip error, mm)")
    ratios = []
    for seed in range(arguments.seeds):
        still = simulate(rig, poses=arguments.waypoints, seed=seed, pixel=0.1)
        moving = set_in_motion(still, Motion(time_offsets=tuple(arguments.offsets)))
        sessions = [moving.session, at_rest(moving, np.random.default_rng(seed))]
        if arguments.planned:
            planned = simulate(rig, poses=len(moving.session.poses) // 2, seed=seed, pixel=0.1)
            sessions.append(planned.session)
        fits = [calibrate(replace(session, estimate=GEOMETRY_ALONE), force=True) for session in sessions]
        errors = [tip_error(fit, still) for fit in fits]
        off = 1e3 * (fits[0].estimate.time_offsets - arguments.offsets)
        ratios.append(errors[0] / errors[1])
        clocks = " ".join(f"{value:+.4f}" for value in off)
        print(
            f"{seed:4} {len(moving.session.poses):7}   {clocks:20} {errors[0]:7.4f} {errors[1]:8.4f} {ratios[-1]:6.2f}",
            end="",
        )
        print("".join(f"{error:10.4f}" for error in errors[2:]), flush=True)
    print(f"median ratio {np.median(ratios):.3f}, largest {max(ratios):.3f}")


if __name__ == "__main__":
    main()
