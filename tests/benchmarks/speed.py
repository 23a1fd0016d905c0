"""How fast an arm is calibrated, beside what else one could use, and beside the least it could cost.

    python tests/benchmarks/speed.py [--rounds 3] [--seed 0] [--cpu]

A simulated UR5 before two cameras, one LED, 0.1 px. Everything runs with one BLAS thread in a warm process; the
contenders take turns and the best round of each counts. Rates are on the same sightings, tip errors against the true
robot over the workspace, after base alignment.

- ours: from sightings to solution, that is start, identifiability and solver, tolerances as priors.
- scipy: the same start, parameters, whitening and priors, and `scipy.optimize.least_squares` (MINPACK's "lm" with
  2-point differences) over a loop of Pinocchio's forward kinematics. Once as one would write it, pose by pose, with
  `cv2.projectPoints` for pixels; once with our projection for all poses at once in place of that.
- FIGAROH (extra `bench`; left out, with a message, where it is not installed): its `BaseCalibration` from its files to
  its corrections, with its start, all six corrections a joint, and `estimation.method: map` with our tolerances as
  priors, on the points that ours has triangulated. Once with the cost function of its documentation and UR10 example,
  once with one that whitens the points as ours does and spares the logarithm of every pose, which positions do not
  need: the best that can be had from FIGAROH.
- the limit: as many iterations as ours took, of one pass of Pinocchio's forward kinematics and joint kinematic
  regressor over all poses, from Python, and one product J^T J of the problem's size. Beside it, "kept", the same with
  the regressors put into a small array, as they must be before there is a J. All accepted steps count, as they do in a
  calibration's history: of thousands of poses those on an even selection too (3 of 5 here), and those that use
  derivatives again; a plain descent over all poses takes as many.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import io
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pinocchio as pin
from threadpoolctl import threadpool_limits

from tests.states import at_joint_values, true_state_of
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.cameras import camera_poses, camera_values
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.estimation.measurements.pixels import triangulate
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import Parameters, choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import solve
from urdfcal.estimation.start import first_state
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.dh import DHTable
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.state import State
    from urdfcal.session.knowledge import Freedom
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated

POSES, COPIES = 500, (1, 10, 100)
KINDS = ("pixels", "points")
WORKSPACE = 500
KEPT = 512  # regressors that stay in cache
SCIPY, FIGAROH, LIMIT, GROWTH, MEMORY = 30.0, 100.0, 2.5, 1.2, 600.0
"""What issue 3 requires: rates to the others at 500 poses; to the limit at 5,000; growth of the cost of a pose; MB."""


@dataclass
class Best:
    """The best of several rounds, and what came out."""

    seconds: float = np.inf
    parts: dict[str, float] = field(default_factory=dict)
    placements: np.ndarray = field(default_factory=lambda: np.empty(0))
    iterations: int = 0
    shape: tuple[int, int] = (0, 0)

    def update(self, other: Best) -> None:
        if other.seconds < self.seconds:
            self.__dict__.update(other.__dict__)


@dataclass(frozen=True)
class Task:
    """What every contender is given."""

    session: Session
    kind: str
    clock: Callable[[], float]
    estimation: Problem

    @classmethod
    def of(cls, session: Session, kind: str, clock: Callable[[], float]) -> Task:
        tables = None if kind == "pixels" else [triangulate(session)]
        return cls(session, kind, clock, Problem.of(session, DHTable.from_chain(session.chain), tables))

    @property
    def table(self) -> DHTable:
        return self.estimation.arm

    @property
    def block(self) -> Observations:
        return self.estimation.observations[0]

    def start(self) -> State:
        offsets = np.zeros_like(self.table.nominal)
        if self.kind == "pixels":
            return first_state(self.session, self.table, offsets)
        # The points are given, so they are not triangulated again.
        seen = self.block.table
        given = Points(seen.pose, seen.led, seen.xyz, seen.sigma)
        return first_state(replace(self.session, measurements=(given,)), self.table, offsets)

    def parameters(self, start: State) -> Parameters:
        fixed: tuple[Freedom, ...] = ("fixed",) * (2 if self.kind == "pixels" else 0)
        candidates = choose_parameters(self.session, self.estimation, start, ModelSpec("dh", fixed, fixed))
        return identify(self.estimation, start, candidates).parameters


def ours(problem: Task) -> Best:
    times = [problem.clock()]
    start = problem.start()
    times.append(problem.clock())
    parameters = problem.parameters(start)
    times.append(problem.clock())
    fit = solve(problem.estimation, start, parameters)
    times.append(problem.clock())
    return Best(
        seconds=times[-1] - times[0],
        parts=dict(zip(("start", "identify", "solve"), np.diff(times), strict=True)),
        placements=problem.table.placements(fit.state[ARM]),
        iterations=len(fit.history),
        shape=(problem.block.value.size, parameters.count),
    )


def scipy_loop(problem: Task, predicted: Callable[[Task, State], np.ndarray]) -> Best:
    from scipy.optimize import least_squares

    begin = problem.clock()
    table, block = problem.table, problem.block
    start = problem.start()
    parameters = problem.parameters(start)
    W = whitening(problem.estimation, start)

    def residuals(step: np.ndarray) -> np.ndarray:
        state = parameters.retract(start, step)
        residual = (predicted(problem, state) - block.value).reshape(len(W), -1, 1)
        return np.concatenate([(W @ residual).ravel(), parameters.prior_residuals(state)[0]])

    found = least_squares(residuals, np.zeros(parameters.count), jac="2-point", method="lm")
    seconds = problem.clock() - begin
    return Best(seconds, placements=table.placements(parameters.retract(start, found.x)[ARM]))


def all_at_once(problem: Task, state: State) -> np.ndarray:
    return problem.estimation.predict(problem.block, state)


def pose_by_pose(problem: Task, state: State) -> np.ndarray:
    """The same, as one would write it."""
    table, block = problem.table, problem.block
    model = table.chain.build_model(table.placements(state[ARM]))
    data, last, tip = model.createData(), model.njoints - 1, pin.SE3(table.chain.T_last_tip)
    T_world_base = pin.SE3(state[BASE])
    poses = [(cv2.Rodrigues(T[:3, :3])[0], T[:3, 3]) for T in camera_poses(problem.estimation.attachments, state)]
    lenses = [
        (np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), camera.distortion)
        for camera in camera_values(problem.estimation.attachments, state)
        for fx, fy, cx, cy in [camera.intrinsics]
    ]
    result = np.zeros_like(block.value)
    for k, q in enumerate(block.readings.q):
        pin.forwardKinematics(model, data, q)
        T_world_tip = T_world_base * data.oMi[last] * tip
        for slot in np.flatnonzero(block.valid[k]):
            world = T_world_tip.act(state[LEDS][block.index["led"][k, slot]])
            if problem.kind == "pixels":
                c = block.index["camera"][k, slot]
                world = cv2.projectPoints(np.array([world]), *poses[c], *lenses[c])[0].ravel()
            result[k, slot] = world
    return result


def whitening(estimation: Problem, state: State) -> np.ndarray:
    """What gives the residuals of every pose unit variance, (N, m D, m D), joint readings being noisy as well."""
    (block,) = estimation.observations
    N, m, D = block.value.shape
    q = block.readings.q
    at = estimation.predict(block, state)
    slopes = [
        (estimation.predict(at_joint_values(block, q + step), state) - at) / 1e-6 for step in 1e-6 * np.eye(q.shape[1])
    ]
    J_q = estimation.joint_sigma * np.stack(slopes, axis=-1).reshape(N, m * D, -1)
    covariance = (J_q @ np.swapaxes(J_q, 1, 2)).reshape(N, m, D, m, D)
    each = np.arange(m)
    covariance[:, each, :, each, :] += np.moveaxis(block.covariance, 1, 0)
    return np.linalg.inv(np.linalg.cholesky(covariance.reshape(N, m * D, m * D)))


def figaroh_map(problem: Task, folder: Path, *, whitened: bool) -> Best:
    """FIGAROH on the points of ``problem``; its model, its files and the whitening are made off the clock."""
    from figaroh.calibration.base_calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm

    session = problem.session
    W = whitening(problem.estimation, problem.start())

    class Calibration(BaseCalibration):
        def cost_function(self, var: np.ndarray) -> np.ndarray:
            points = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
            if not whitened:
                residuals = self._compute_logmap_residuals(self.PEE_measured, points)
                return self.apply_measurement_weighting(residuals, pos_weight=1.0, orient_weight=0.5)
            residuals = (points - self.PEE_measured).reshape(3, -1)  # x of all samples, then y, then z
            return (W @ residuals.T[..., None])[..., 0].T.ravel()

    config = figaroh_files(problem, folder)
    robot = pin.RobotWrapper(pin.buildModelFromUrdf(str(session.urdf.path)))
    begin = problem.clock()
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        calibration = Calibration(robot, str(config))
        calibration.calib_config |= {"known_baseframe": False, "known_tipframe": False}
        calibration.initialize()
        calibration.solve(enable_logging=False)  # prints a report
    corrections = calibration.joint_corrections()
    seconds = problem.clock() - begin

    placements = np.array(session.chain.placements)
    for i, name in enumerate(session.chain.names):
        p, phi = (np.array([corrections[f"d_{what}{axis}_{name}"] for axis in "xyz"]) for what in ("p", "phi"))
        placements[i] = placements[i] @ pin.SE3(pin.exp3(phi), p).homogeneous
    return Best(seconds, placements=placements)


def figaroh_files(problem: Task, folder: Path) -> Path:
    chain, tolerances = problem.session.chain, problem.session.tolerances
    measured = np.hstack([problem.block.value[:, 0], problem.block.readings.q])
    names = ",".join(["x1", "y1", "z1", *chain.names])
    np.savetxt(folder / "points.csv", measured, fmt="%.17g", delimiter=",", header=names, comments="")
    config = folder / "config.yaml"
    config.write_text(
        f"""schema_version: "2.0"
robot: {{name: {chain.name}}}
tasks:
  calibration:
    kinematics: {{base_frame: {chain.base_link}, tool_frame: {chain.tip_link}}}
    parameters:
      calibration_level: full_params
      outlier_threshold: 0.02
      estimation:
        method: map
        priors: {{translation: {tolerances.length}, rotation: {tolerances.angle}, joint_offset: {tolerances.zero}}}
    measurements:
      markers: [{{measurable_dof: [true, true, true, false, false, false]}}]
    data: {{source_file: {folder / "points.csv"}, number_of_samples: {len(measured)}}}
"""
    )
    return config


def limit(problem: Task, shape: tuple[int, int]) -> np.ndarray:
    """The least that an iteration could cost: the calls alone, and with their results kept for J. [s]"""
    chain, q = problem.session.chain, problem.block.readings.q
    model = chain.build_model()
    data, last, tip = model.createData(), model.njoints - 1, pin.SE3(chain.T_last_tip)
    aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    regressor = np.zeros((KEPT, 6, 6 * len(chain.joints)))
    J = np.random.default_rng(0).standard_normal(shape)
    times = [problem.clock()]
    for q_k in q:
        pin.forwardKinematics(model, data, q_k)
        pin.computeJointKinematicRegressor(model, data, last, aligned, tip)
    times.append(problem.clock())
    for k, q_k in enumerate(q):
        pin.forwardKinematics(model, data, q_k)
        regressor[k % KEPT] = pin.computeJointKinematicRegressor(model, data, last, aligned, tip)
    times.append(problem.clock())
    J.T @ J
    times.append(problem.clock())
    calls, kept, product = np.diff(times)
    return np.array([calls, kept]) + product


def tiled(simulated: Simulated, copies: int, seed: int) -> Session:
    """The same poses several times over, each time with fresh noise."""
    session, truth, seen = simulated.session, simulated.truth, simulated.session.find(Detections)
    if copies == 1:
        return session
    rng = np.random.default_rng([seed, copies])
    exactly = Problem.of(replace(session, q=truth.q), DHTable.from_chain(session.chain))
    (block,) = exactly.observations
    exact = block.by_row(exactly.predict(block, true_state_of(simulated)))
    N, uv, q = len(session.poses), np.tile(exact, (copies, 1)), np.tile(truth.q, (copies, 1))
    pose = (seen.pose + N * np.arange(copies)[:, None]).ravel()
    return replace(
        session,
        poses=tuple(f"{k:06d}" for k in range(copies * N)),
        q=q + session.noise.joint * rng.standard_normal(q.shape),
        measurements=(
            Detections(
                pose,
                np.tile(seen.camera, copies),
                np.tile(seen.led, copies),
                uv + session.noise.pixel * rng.standard_normal(uv.shape),
                np.tile(seen.sigma, copies),
            ),
        ),
    )


def tip_error(simulated: Simulated, placements: np.ndarray, seed: int) -> float:
    """Root mean square over the workspace after base alignment. [mm]"""
    chain = simulated.session.chain
    q = chain.random_values(WORKSPACE, np.random.default_rng(seed))
    true, built = (replace(chain, placements=p) for p in (simulated.truth.placements, placements))
    return float(1e3 * np.sqrt(np.mean(compare(true, built, q).position ** 2)))


def peak_memory(kind: str, seed: int) -> float:
    """Of a process of its own that simulates and calibrates the largest session. [MB]"""
    command = [sys.executable, __file__, "--memory-of", kind, "--seed", str(seed)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def report_peak_memory(kind: str, seed: int) -> None:
    with threadpool_limits(1, user_api="blas"):
        simulated = simulate(read_rig(find_rig("ur5")), poses=POSES, seed=seed)
        ours(Task.of(tiled(simulated, COPIES[-1], seed), kind, time.perf_counter))
    unit = 2**20 if sys.platform == "darwin" else 2**10
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)


def contenders(problems: dict[str, Task], folder: Path) -> dict[str, tuple[str, Callable[[], Best], float]]:
    """Name -> kind of sightings, a run, and how many times faster than it ours must be."""
    result: dict[str, tuple[str, Callable[[], Best], float]] = {}
    for kind, problem in problems.items():
        result[f"{kind}: ours"] = kind, lambda p=problem: ours(p), 0.0
        result[f"{kind}: Pinocchio loop, scipy"] = kind, lambda p=problem: scipy_loop(p, pose_by_pose), SCIPY
        result[f"{kind}: the same, our projection"] = kind, lambda p=problem: scipy_loop(p, all_at_once), SCIPY
    if importlib.util.find_spec("figaroh") is None:
        print("FIGAROH is not installed and left out: pip install 'urdfcal[bench]'\n")
        return result
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two of its dependencies register the same converter
        importlib.import_module("figaroh.calibration.base_calibration")
    name, points = f"points: FIGAROH {metadata.version('figaroh')} map", problems["points"]
    result[name] = "points", lambda: figaroh_map(points, folder, whitened=False), FIGAROH
    result[f"{name}, whitened"] = "points", lambda: figaroh_map(points, folder, whitened=True), FIGAROH
    return result


def side_by_side(simulated: Simulated, rounds: int, seed: int, clock: Callable[[], float]) -> None:
    problems = {kind: Task.of(simulated.session, kind, clock) for kind in KINDS}
    with tempfile.TemporaryDirectory() as folder:
        runs = contenders(problems, Path(folder))
        best = {name: Best() for name in runs}
        for _ in range(rounds):
            for name, (kind, run, _) in runs.items():
                if name.endswith("ours"):
                    ours(problems[kind])  # whoever ran before has the caches
                best[name].update(run())
    drawn = tip_error(simulated, simulated.session.chain.placements, seed)
    print(f"{POSES} poses                            time [ms]  over ours  required  tip rms [mm]")
    print(f"the arm as drawn {'':48} {drawn:14.4f}")
    for name, (kind, _, required) in runs.items():
        seconds = best[name].seconds
        over, least = seconds / best[f"{kind}: ours"].seconds, f">= {required:.0f}" if required else ""
        error = tip_error(simulated, best[name].placements, seed)
        print(f"{name:35} {1e3 * seconds:9.1f} {over:10.1f} {least:>9} {error:13.4f}")


def growth(simulated: Simulated, rounds: int, seed: int, clock: Callable[[], float]) -> None:
    print("\n                                ours [ms]           itera-         limit           kept  us a pose")
    print("         poses   start identify    solve    total   tions   [ms]  over it   [ms]   over   & iter.    tip mm")
    for kind in KINDS:
        problems = [Task.of(tiled(simulated, copies, seed), kind, clock) for copies in COPIES]
        best, least = [Best() for _ in problems], np.full((len(problems), 2), np.inf)
        for _ in range(rounds):
            for k, problem in enumerate(problems):
                best[k].update(ours(problem))
                least[k] = np.minimum(least[k], limit(problem, best[k].shape))
        costs = []
        for problem, b, one in zip(problems, best, least, strict=True):
            N = len(problem.block.readings.q)
            costs.append(1e6 * b.parts["solve"] / N / b.iterations)
            parts = " ".join(f"{1e3 * part:8.1f}" for part in (*b.parts.values(), b.seconds))
            floors = "  ".join(f"{1e3 * t:7.1f} {b.seconds / t:5.1f}" for t in b.iterations * one)
            error = tip_error(simulated, b.placements, seed)
            print(f"{kind:7}{N:6} {parts} {b.iterations:6} {floors} {costs[-1]:9.2f} {error:11.4f}")
        print(f"{kind}: cost of a pose and iteration at {N} poses, over that at {POSES}: {costs[-1] / costs[0]:.2f}")
    print(f"required: at {POSES * COPIES[1]} poses at most {LIMIT} over the limit; cost of a pose at most {GROWTH}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--cpu", action="store_true", help="the process's own time: for a machine that is not yours alone"
    )
    parser.add_argument("--memory-of", choices=KINDS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory_of:
        report_peak_memory(arguments.memory_of, arguments.seed)
        return
    clock = time.process_time if arguments.cpu else time.perf_counter
    # First, while this process is small: its own peak would be passed on.
    peaks = {kind: peak_memory(kind, arguments.seed) for kind in KINDS}
    simulated = simulate(read_rig(find_rig("ur5")), poses=POSES, seed=arguments.seed)
    with threadpool_limits(1, user_api="blas"):
        side_by_side(simulated, arguments.rounds, arguments.seed, clock)
        growth(simulated, arguments.rounds, arguments.seed, clock)
    words = ", ".join(f"{peak:.0f} MB on {kind}" for kind, peak in peaks.items())
    print(f"peak memory at {POSES * COPIES[-1]} poses: {words} (required: < {MEMORY:.0f})")


if __name__ == "__main__":
    main()
