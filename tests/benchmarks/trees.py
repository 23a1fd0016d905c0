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

from tests.benchmarks.accuracy import information_of, true_state
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.linearize import view
from urdfcal.estimation.model_spec import Freedoms
from urdfcal.estimation.observations import Observations, arrange, observe
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.tree_dh import rows_of
from urdfcal.simulation.simulate import Simulated, simulate

if TYPE_CHECKING:
    from urdfcal.estimation.state import State

RIGS = ("tiago", "tiago_dual", "ur5_handeye")
NEW_POSES = 200


def everywhere(simulated: Simulated, seed: int) -> Observations:
    """Every LED before every camera at poses that were not measured."""
    session = simulated.session
    cameras, leds = len(session.rig.cameras), len(session.leds)
    q = session.chain.random_values(NEW_POSES, np.random.default_rng(seed))
    pose, camera, led = (a.ravel() for a in np.meshgrid(range(NEW_POSES), range(cameras), range(leds), indexing="ij"))
    unit = np.broadcast_to(np.eye(2), (len(pose), 2, 2))
    return arrange(q, pose, led, camera, np.zeros((len(pose), 2)), unit, session.frames)


def seen(table, block: Observations, state: State) -> np.ndarray:
    """(N, m, 3) the LEDs in the cameras' frames, m."""
    T = state.T_cam_world[block.camera]
    return (T[..., :3, :3] @ view(table, block, state)[..., None])[..., 0] + T[..., :3, 3]


def one(simulated: Simulated, seed: int) -> tuple[float, float, float]:
    """Rms error at new poses of the drawn arm and of the calibrated one, and the bound, m."""
    session, truth = simulated.session, true_state(simulated)
    table, blocks, elsewhere = rows_of(session.chain), observe(session), everywhere(simulated, seed)
    standing = set(session.frames.standing[:1].tolist())
    extrinsics = tuple(
        "free" if session.frames.leader[c] == c and c not in standing else "fixed" for c in range(len(truth.cameras))
    )
    lenses = ("fixed",) * len(extrinsics)
    parameters = identify(
        table, blocks, truth, choose_parameters(session, table, truth, Freedoms("dh", lenses, extrinsics, False))
    ).parameters
    # What cannot be told is held at its true value: the start has it, all else is as drawn and as found.
    held = np.array(truth.offsets)
    for index, (row, name) in enumerate(parameters.rows):
        if parameters.active[index]:
            held[row, parameters.columns.index(name)] = 0.0
    start = first_state(session, table, np.zeros_like(truth.offsets))
    fixed = identify(
        table, blocks, start, choose_parameters(session, table, start, Freedoms("none", lenses, extrinsics, False))
    ).parameters
    drawn = solve(table, blocks, start, fixed, session.noise.joint)
    start = replace(start, offsets=held)
    fit = solve(table, blocks, start, parameters, session.noise.joint)

    reference = seen(table, elsewhere, truth)
    before, after = (
        float(np.sqrt(np.mean(np.sum((seen(table, elsewhere, solution.state) - reference) ** 2, axis=-1))))
        for solution in (drawn, fit)
    )
    information = sum(information_of(table, block, truth, parameters, session.noise.joint) for block in blocks)
    J = np.empty((*reference.shape, parameters.count))
    for k in range(parameters.count):  # finite differences will do for a benchmark
        step = 1e-6 * np.eye(parameters.count)[k]
        ahead, behind = (seen(table, elsewhere, parameters.move(truth, s * step)) for s in (1, -1))
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
