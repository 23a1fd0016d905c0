"""How near the calibrated arm comes to the best that the data allow.

    python tests/benchmarks/accuracy.py [--seeds 20] [--poses 50] [--rigs ur5 ...] [--no-priors] [--outliers 0.1]

For every rig and seed: simulate, calibrate, and compare the tip with the true robot over the workspace, after base
alignment. The bound is Cramer and Rao's: the inverse of the information of the true Jacobian (pixels and joint
readings, no priors), propagated to the tip. Printed are medians over the seeds.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from urdfcal.arrays import skew
from urdfcal.calibration import calibrate
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.freedoms import Freedoms
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.observations import observe
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.residuals import Tangent
from urdfcal.estimation.state import State
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import DHTable
from urdfcal.robot.kinematics import tip_motion
from urdfcal.session.files import read_rig
from urdfcal.session.model import Estimate
from urdfcal.session.rigs import find_rig, shipped_rigs
from urdfcal.session.simulate import Simulated, simulate

WORKSPACE = 500


def true_state(simulated: Simulated) -> State:
    session, truth = simulated.session, simulated.truth
    return State(
        offsets=truth.offsets,
        T_world_base=truth.T_world_base,
        leds=truth.leds,
        cameras=session.rig.cameras,
        T_cam_world=np.array(session.rig.T_cam_world),
    )


def bound(simulated: Simulated, q: np.ndarray) -> float:
    """The Cramer-Rao bound of the tip's rms error over the configurations q, after base alignment. [m]"""
    session = simulated.session
    table = DHTable.from_chain(session.chain)
    (block,) = observe(session)
    truth = true_state(simulated)
    candidates = choose_parameters(session, table, truth, Freedoms("dh", ("fixed",) * 2, ("fixed",) * 2, priors=False))
    parameters = identify(table, [block], truth, candidates).parameters
    at = Tangent.at(table, block, truth, parameters).linearise(slice(None))
    N, m, D, P = at.J.shape
    J, J_q = at.J.reshape(N, m * D, P), at.by_joints(table.chain).reshape(N, m * D, -1)
    noise = np.zeros((N, m, D, m, D))
    each = np.arange(m)
    noise[:, each, :, each, :] = np.moveaxis(block.covariance, 1, 0)
    noise = noise.reshape(N, m * D, m * D) + session.noise.joint**2 * J_q @ np.swapaxes(J_q, 1, 2)
    information = np.einsum("nip,nij,njs->ps", J, np.linalg.inv(noise), J)
    covariance = np.linalg.inv(information)

    motion = tip_motion(table.chain, table.chain.build_model(table.placements(truth.offsets)), q)
    A = np.zeros((len(q), 3, parameters.size))
    A[..., : len(parameters.rows)] = (motion.regressor @ table.twists(truth.offsets, parameters.rows))[:, :3]
    A = A[..., parameters.active].reshape(-1, P)
    rigid = np.concatenate([np.broadcast_to(np.eye(3), (len(q), 3, 3)), -skew(motion.p)], axis=2).reshape(-1, 6)
    A = A - rigid @ np.linalg.lstsq(rigid, A, rcond=None)[0]
    return float(np.sqrt(np.trace(A @ covariance @ A.T) / len(q)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--poses", type=int, default=50)
    parser.add_argument("--rigs", nargs="*", default=sorted(shipped_rigs()))
    parser.add_argument("--no-priors", action="store_true")
    parser.add_argument("--outliers", type=float, default=0.0)
    arguments = parser.parse_args()
    print("medians in mm  nominal     error     bound  error/bound  nominal/error")
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
                Chain(nominal.name, nominal.base_link, nominal.tip_link, nominal.joints, placements, nominal.T_last_tip)
                for placements in (simulated.truth.placements, calibration.placements)
            )
            errors = [np.sqrt(np.mean(compare(robot, true, q).position ** 2)) for robot in (nominal, built)]
            rows.append([*errors, bound(simulated, q)])
            found += len(calibration.outliers())
            moved += len(simulated.truth.outliers)
        before, after, best = 1e3 * np.median(rows, axis=0)
        print(f"{name:12} {before:9.4f} {after:9.4f} {best:9.4f}  {after / best:11.3f} {before / after:13.2f}", end="")
        print(f"   {found} of {moved} moved sightings listed" if moved else "")


if __name__ == "__main__":
    main()
