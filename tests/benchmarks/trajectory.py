"""Whether a moving arm calibrates as well as a still one.

    python -m tests.benchmarks.trajectory [--seeds 10] [--rig ur5] [--waypoints 50] [--every 8]

For every seed: simulate a robot, film it on its way from pose to pose (0.5 rad/s, 30 Hz frames, 125 Hz joint readings,
clocks off by 20 and -7 ms), and calibrate from every eighth frame. Printed are the errors of the time offsets, the
tip's rms errors over the workspace after base alignment, and two ratios:

- to the same frames with the arm at rest in each: what is lost by moving, because the clocks have to be found and joint
  values are read between readings;
- to as many poses that `urdfcal simulate` plans for a still arm (half as many as frames: each is seen by both cameras),
  which fill images and joint ranges evenly: what is lost, moreover, by being on the way between poses.

Below them what the information of the true Jacobian lets expect (the bound of accuracy.py). The errors of single robots
scatter by a third about it, and their ratios by more: look at the median and the rms over seeds.

The second ratio is a matter of the places alone, and these of how many poses the arm is driven through: the bounds'
ratio is 1.8 with 15 poses, 1.25 with 30, 1.15 with 50 (medians of the errors' ratios: 1.7 with 15, 1.1 with 50). What
lies between two poses is nearer to the middle of the joints' ranges and images than they are. It is no matter of

- the camera that sees an LED without the other: on the way both see it in 97 to 100 % of the frames;
- joint noise: without any the bounds' ratio is the same to 1 % (ur5, 2e-5 rad);
- joint noise that is counted for each camera's frame: it is drawn for each, too, which tells more than one reading for
  both (the tip of still poses would gain 0.3 % with the ur5's encoders, 16 % with the so101's);
- neighbouring frames that share readings through the spline: to know their correlation would take less than 0.001 % off
  the error of a ur5 and 0.3 % of a so101's. The spline's noise is 0.87 of the readings' variance: standard deviations
  are that little too wide (0.1 % and 7 % of the tip's). A curve that smooths readings over 0.2 s could take off 0.2 %
  and 18 %, if their errors are as white as here.

All frames of seed 0 (--every 1): 0.0080 mm, bounds 0.0072 and of planned poses 0.0064 mm, offsets within 0.008 ms.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks.accuracy import Knowledge
from urdfcal.estimation.evaluation import compare
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate
from urdfcal.session.trajectory import AT_REST
from urdfcal.simulation.motion import MotionSettings, set_in_motion
from urdfcal.simulation.simulate import simulate
from urdfcal.simulation.truth import Simulated

if TYPE_CHECKING:
    from urdfcal.result.fitted import FittedCalibration

WORKSPACE = 500
GEOMETRY_ALONE = Estimate("dh", "fixed", "fixed")


def thinned(moving: Simulated, every: int) -> Simulated:
    """Every so many frames of each camera."""
    kept = np.arange(0, len(moving.session.poses), every)
    return Simulated(moving.session.at(kept), replace(moving.truth, q=moving.truth.q[kept]))


def at_rest(moving: Simulated, rng: np.random.Generator) -> Simulated:
    """The same frames of an arm that stood still in each, read by the same encoders."""
    session = moving.session
    readings = session.chain.readings(moving.truth.q)
    readings = readings + session.noise.joint * rng.standard_normal(readings.shape)
    return Simulated(
        replace(session, q=session.chain.joint_values(readings), motion=AT_REST),
        replace(moving.truth, time_offsets=np.zeros(0)),
    )


def tip_error(calibration: FittedCalibration, simulated: Simulated, q: np.ndarray) -> float:
    """Rms over the workspace, mm."""
    drawn = calibration.chain
    built, true = (
        drawn.with_placements(placements) for placements in (calibration.placements, simulated.truth.placements)
    )
    return 1e3 * float(np.sqrt(np.mean(compare(built, true, q).position ** 2)))


def row(moving: float, rest: float, planned: float) -> str:
    """Three errors in mm and the two ratios."""
    return f"{moving:9.4f}{rest:9.4f}{planned:9.4f}{moving / rest:17.2f}{moving / planned:16.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rig", default="ur5")
    parser.add_argument("--waypoints", type=int, default=50)
    parser.add_argument("--every", type=int, default=8, help="1: all frames, several minutes a seed")
    parser.add_argument("--offsets", type=float, nargs="*", default=[0.02, -0.007])
    arguments = parser.parse_args()
    rig = read_rig(find_rig(arguments.rig))
    q = rig.chain.random_values(WORKSPACE, np.random.default_rng(0))
    print(f"{'':44} tip error (mm)             ratio to the same  ratio to poses")
    print(f"{'seed':5}{'filmed':>8}{'frames':>8}  {'time offsets off by (ms)':23}", end="")
    print(f"{'moving':>9}{'at rest':>9}{'planned':>9}{'frames at rest':>17}{'as planned':>16}")
    errors, bounds, clocks = [], [], []
    for seed in range(arguments.seeds):
        still = simulate(rig, poses=arguments.waypoints, seed=seed, pixel=0.1)
        filmed = set_in_motion(still, MotionSettings(time_offsets=tuple(arguments.offsets)))
        moving = thinned(filmed, arguments.every)
        data = [
            moving,
            at_rest(moving, np.random.default_rng(seed)),
            simulate(rig, poses=len(moving.session.poses) // 2, seed=seed, pixel=0.1),
        ]
        fits = [calibrate(replace(of.session, estimate=GEOMETRY_ALONE), force=True) for of in data]
        errors.append([tip_error(fit, of, q) for fit, of in zip(fits, data, strict=True)])
        bounds.append([1e3 * Knowledge.of(of, q, priors=True).reachable() for of in data])
        clocks.append(1e3 * (fits[0].estimate.time_offsets - arguments.offsets))
        log, off = filmed.session.motion.log, " ".join(f"{value:+.4f}" for value in clocks[-1])
        print(f"{seed:<5}{np.ptp(log.time):6.0f} s{len(moving.session.poses):8}  {off:23}", end="")
        print(row(*errors[-1]), flush=True)
    ratios = np.array(errors)[:, :1] / np.array(errors)[:, 1:]
    print(f"{'median of the ratios':73}{np.median(ratios[:, 0]):17.2f}{np.median(ratios[:, 1]):16.2f}")
    print(f"{'rms over the seeds':46}{row(*np.sqrt(np.mean(np.square(errors), axis=0)))}")
    print(f"{'bound':46}{row(*np.sqrt(np.mean(np.square(bounds), axis=0)))}")
    print(f"time offsets within {np.abs(clocks).max():.3f} ms")


if __name__ == "__main__":
    main()
