"""How many joint commands are compensated in a second on one core, and what is left of the error.

Run by hand, from the project's folder: ``python -m tests.benchmarks.compensation``. At least 20,000 poses a second are
asked for; beside them stands what forward kinematics of the same poses costs, by Pinocchio from Python. Then one
command at a time, of a rigid arm and of one that sags: 150 us are asked for, or 300 times one
``pin.framesForwardKinematics`` called from Python.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from threadpoolctl import threadpool_limits

from tests.worlds import sagging
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.compensation import compensate
from urdfcal.robot.kinematics import tip_poses
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from urdfcal.result.fitted import FittedCalibration

RIGS = ("ur5", "panda", "elbow3r", "so101", "stanford")
POSES, REPEATS = 20_000, 3
ONE_BY_ONE, COMMANDS = ("ur5", "panda", "so101"), 1000


def main() -> None:
    sys.stdout.write("rig        poses/s   FK poses/s   as given    left: median     95 %      max (mm)\n")
    for rig in RIGS:
        simulated = simulate(read_rig(find_rig(rig)), poses=10, seed=0)
        nominal = simulated.session.chain
        real = replace(nominal, placements=simulated.truth.placements)
        q = nominal.random_values(POSES, np.random.default_rng(0))[:, [n in nominal.actuated for n in nominal.names]]
        seconds, kinematics = [], []
        with threadpool_limits(1):
            for _ in range(REPEATS):
                start = time.perf_counter()
                tip_poses(nominal, nominal.joint_values(q))
                kinematics.append(time.perf_counter() - start)
                start = time.perf_counter()
                found = compensate(nominal, real, q)
                seconds.append(time.perf_counter() - start)
        values = nominal.joint_values(q)
        before = np.linalg.norm((tip_poses(real, values) - tip_poses(nominal, values))[:, :3, 3], axis=1)
        left = 1e3 * np.quantile(found.position, [0.5, 0.95, 1.0])
        sys.stdout.write(
            f"{rig:9} {POSES / min(seconds):8.0f} {POSES / min(kinematics):12.0f} "
            f"{1e3 * np.sqrt(np.mean(before**2)):10.3f} {left[0]:15.6f} {left[1]:9.6f} {left[2]:9.3f}\n"
        )
    sys.stdout.write("\nrig        arm      median    95 % (us)   times framesForwardKinematics\n")
    for rig in ONE_BY_ONE:
        for arm, joint_models in (("rigid", {}), ("sags", {"compliance": True})):
            data = simulate(read_rig(find_rig(rig)), poses=40, seed=0)
            session = replace(sagging(data, 4e-5) if joint_models else data.session, joint_models=joint_models)
            one_at_a_time(rig, arm, calibrate(session, force=True))


def one_at_a_time(rig: str, arm: str, calibration: FittedCalibration) -> None:
    chain = calibration.chain
    model = chain.build_model()
    data = model.createData()
    values = chain.random_values(COMMANDS, np.random.default_rng(1))
    seconds, kinematics = [], []
    with threadpool_limits(1):
        calibration.compensate(chain.readings(values[0]))
        for of_all, q in zip(values, chain.readings(values), strict=True):
            start = time.thread_time_ns()
            for _ in range(10):
                pin.framesForwardKinematics(model, data, of_all)
            kinematics.append(1e-4 * (time.thread_time_ns() - start))
            start = time.thread_time_ns()
            calibration.compensate(q)
            seconds.append(1e-3 * (time.thread_time_ns() - start))
    median, most = np.quantile(seconds, [0.5, 0.95])
    sys.stdout.write(f"{rig:9} {arm:6} {median:8.0f} {most:8.0f} {median / np.median(kinematics):20.0f}\n")


if __name__ == "__main__":
    main()
