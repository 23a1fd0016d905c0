"""How near joints that branch, and cameras that ride on them, come to the best that the data allow.

    python -m tests.benchmarks.trees [--seeds 20] [--poses 50] [--rigs tiago ...]

For every rig and seed: simulate, calibrate without priors, and compare where each camera should see each LED in space,
at new poses, with the truth: the LED's place in the camera's frame holds everything that can be told, and nothing of
what cannot (where a base stands that no camera sees; how a torso moves that carries both camera and arm). The bound is
Cramer and Rao's: the inverse of the information of the true Jacobian (pixels and joint readings, no priors),
propagated to these places. One camera on a robot of turning joints has no scale but a link's length: of every lost
direction the truth's own value is held, in the estimate as in the bound. Printed are medians over the seeds.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks.accuracy import information_of
from tests.states import true_state_of
from urdfcal.estimation.blocks.arm import ARM, no_offsets
from urdfcal.estimation.blocks.cameras import camera_poses
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.tree_dh import rows_of
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from urdfcal.estimation.state import State
    from urdfcal.simulation.truth import Simulated

RIGS = ("tiago", "tiago_dual", "ur5_handeye")
NEW_POSES = 200


def everywhere(simulated: Simulated, seed: int) -> Problem:
    """Every LED before every camera at poses that were not measured."""
    session = simulated.session
    cameras, leds = len(session.rig.cameras), len(session.leds)
    q = session.chain.random_values(NEW_POSES, np.random.default_rng(seed))
    pose, camera, led = (a.ravel() for a in np.meshgrid(range(NEW_POSES), range(cameras), range(leds), indexing="ij"))
    blank = Detections(pose, camera, led, np.zeros((len(pose), 2)), 1.0)
    labels = tuple(map(str, range(NEW_POSES)))
    new = replace(session, poses=labels, q=q, time=None, measurements=(blank,))
    return Problem.of(new, rows_of(session.chain))


def seen(problem: Problem, state: State) -> np.ndarray:
    """(N, m, 3) the LEDs in the cameras' frames, m."""
    (block,) = problem.observations
    T = camera_poses(problem.attachments, state)[block.index["camera"]]
    _, points = block.table.points(block, problem.links(block.readings, state), state)
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


def one(simulated: Simulated, seed: int) -> tuple[float, float, float]:
    """Rms error at new poses of the drawn arm and of the calibrated one, and the bound, m."""
    session, truth = simulated.session, true_state_of(simulated)
    table, attachments, elsewhere = rows_of(session.chain), session.attachments, everywhere(simulated, seed)
    problem = Problem.of(session, table)
    world = set(attachments.eye_to_hand[:1].tolist())
    references = enumerate(attachments.reference.tolist())
    extrinsics = tuple("free" if of == c and c not in world else "fixed" for c, of in references)
    lenses = ("fixed",) * len(extrinsics)
    spec = ModelSpec("dh", lenses, extrinsics, priors=False)
    parameters = identify(problem, truth, choose_parameters(session, problem, truth, spec)).parameters
    # What is unidentifiable is fixed at its true value: the start has it, all else is nominal or as found.
    known = np.array(truth[ARM])
    for row, name in parameters.arm_rows:
        known[row, table.columns.index(name)] = 0.0
    start = first_state(session, table, no_offsets(problem.arm))
    arm_fixed = choose_parameters(session, problem, start, spec.nominal_arm)
    nominal = solve(problem, start, identify(problem, start, arm_fixed).parameters)
    fit = solve(problem, start.replace({ARM: known}), parameters)

    reference = seen(elsewhere, truth)
    before, after = (
        float(np.sqrt(np.mean(np.sum((seen(elsewhere, solution.state) - reference) ** 2, axis=-1))))
        for solution in (nominal, fit)
    )
    information = information_of(problem, truth, parameters)
    J = np.empty((*reference.shape, parameters.count))
    for k in range(parameters.count):  # finite differences will do for a benchmark
        step = 1e-6 * np.eye(parameters.count)[k]
        ahead, behind = (seen(elsewhere, parameters.retract(truth, s * step)) for s in (1, -1))
        J[..., k] = (ahead - behind) / 2e-6
    J = J.reshape(-1, parameters.count)
    bound = float(np.sqrt(np.sum((J @ np.linalg.inv(information)) * J) / (len(J) / 3)))
    return before, after, bound


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--poses", type=int, default=50)
    parser.add_argument("--rigs", nargs="*", default=RIGS)
    arguments = parser.parse_args()
    print("medians in mm   nominal     error     bound  error/bound  (required: at most 1.1)")
    for name in arguments.rigs:
        rig = read_rig(find_rig(name))
        rows = [one(simulate(rig, poses=arguments.poses, seed=seed), seed) for seed in range(arguments.seeds)]
        before, after, best = 1e3 * np.median(rows, axis=0)
        print(f"{name:12} {before:10.4f} {after:9.4f} {best:9.4f}  {after / best:11.3f}", flush=True)


if __name__ == "__main__":
    main()
