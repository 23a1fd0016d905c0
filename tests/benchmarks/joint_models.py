"""Whether joint models are found where they are, and only there.

    python -m tests.benchmarks.joint_models [--seeds 10] [--poses 60] [--rigs ur5 panda so101] [--worlds rigid gain]
    python -m tests.benchmarks.joint_models --measured ../shared/data
    python -m tests.benchmarks.joint_models --speed 5000

Simulated: every world is a rig of which the joints are not where they are read, in one way or in all of them; `auto` is
the calibration that chooses. Printed for each world and rig, root mean squares over the seeds:

- bound: the tip's error over the workspace that is to be expected of the true model with tolerances as priors, what is
  wrong with the joints being unknown (Cramer-Rao);
- known: the same with the size of what is wrong with the joints as a prior, too, which nobody has;
- auto, true, off: the tip's error of the calibration that chooses, of the one with the true model switched on, and of
  the rigid one. Readings of the workspace are as good as the session's: each pose is reached from the one before;
- held: share of the chosen models' parameters within their 95 % intervals;
- found: how often models were chosen that are there, and, after the comma, that are not.

Required: auto at most 1.2 times the bound, better 1.2 times the one with known sizes; of rigid arms
at most 1.03 times off, and nothing chosen in 95 %.

Measured: from one UR10 session to the other, and left-out regions, with and without joint models.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, get_args

import numpy as np

from tests.benchmarks.accuracy import information_of
from tests.states import true_state_of
from urdfcal.arrays import rms
from urdfcal.errors import UrdfcalError
from urdfcal.estimation.alignment import kabsch
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.evaluation import explain
from urdfcal.estimation.identifiability import identify
from urdfcal.estimation.joint_models import JOINT_MODELS, Readings
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.estimation.solver import solve
from urdfcal.estimation.uncertainty import _aligned
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.knowledge import Estimate, JointError
from urdfcal.session.trajectory import AT_REST
from urdfcal.simulation.simulate import draw_offsets, simulate

if TYPE_CHECKING:
    from urdfcal.arrays import Floats
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated

WORKSPACE = 500
SPREAD_DRAWS = 1000
AS_GIVEN = Estimate("dh", "fixed", "fixed")
LINEAR = tuple(model for model in JOINT_MODELS if issubclass(model, LinearJointModel))
OFF = {model.name: False for model in LINEAR}
# The joint model that corrects an error of another name.
CALLED = {"eccentricity": "harmonics"}


@dataclass(frozen=True)
class World:
    """A simulated session whose joints are not where they are read.

    Attributes:
        data: the session, as it was measured, and the truth.
        p: what is wrong, by the model's name.
    """

    data: Simulated
    p: dict[str, Floats]

    @classmethod
    def of(cls, rig: str, seed: int, poses: int, names: tuple[str, ...]) -> World:
        rig = read_rig(find_rig(rig))
        joint = rig.chain.actuated[int(np.random.default_rng([7, seed]).integers(len(rig.chain.actuated)))]
        known = {**dict.fromkeys(get_args(JointError), "default"), "gain": {joint: 1e-3}}
        errors = {name: size for name, size in known.items() if CALLED.get(name, name) in names}
        data = simulate(replace(rig, errors=errors), poses=poses, seed=seed)
        return cls(data, dict(data.truth.joint_errors))

    def session(self, **joint_models: object) -> Session:
        return replace(self.data.session, estimate=AS_GIVEN, joint_models=joint_models)

    @property
    def asked(self) -> dict[str, object]:
        """What the session says if it does not know; bending is only looked at where it is asked for."""
        return {"bending": "auto"} if "bending" in self.p else {}

    @property
    def true_models(self) -> dict[str, object]:
        """What the session would say of joint models if it knew."""
        known = {model.name: model for model in models(replace(self.data.session, joint_models=self.asked))}
        on = {name: dict.fromkeys(np.array(known[name].names_of_joints)[p != 0.0], True) for name, p in self.p.items()}
        return {
            **OFF,
            **{name: {**dict.fromkeys(known[name].names_of_joints, False), **said} for name, said in on.items()},
        }

    def joint_values(self, problem: Problem, readings: Readings) -> Floats:
        q = readings.q
        for model in problem.joint_models:
            if model.name in self.p:
                q = q + model.values(readings, self.p[model.name])
        return q

    def bounds(self) -> list[float]:
        """The tip's rms error that is to be expected of the true model, sizes of its parameters unknown, known. [m]"""
        session = self.session(**self.true_models)
        table = rows_of(session.chain)
        problem = Problem.of(session, table)
        keys = {model.name: model.key for model in problem.joint_models}
        state = true_state_of(self.data).replace({keys[name]: p for name, p in self.p.items()})
        spec = ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2)
        parameters = identify(problem, state, choose_parameters(session, problem, state, spec)).parameters
        prior = np.array(parameters.prior)
        rng = np.random.default_rng(0)
        spread = np.sqrt(np.mean([draw_offsets(table, rng) ** 2 for _ in range(SPREAD_DRAWS)], axis=0))
        drawn = prior.copy()
        drawn[parameters.columns(ARM)] = [spread[row, table.columns.index(name)] for row, name in table.parameters]
        on, information = parameters.active, information_of(problem, state, parameters)
        A, _ = _aligned(problem, SimpleNamespace(parameters=parameters, state=state), 0)
        found = []
        for known in (False, True):
            for name, p in self.p.items():
                where = parameters.columns(keys[name])
                prior[where] = drawn[where] = rms(p[p != 0.0]) if known else np.inf
            L = np.diag(prior[on] ** -2.0)
            pull = L @ np.where(np.isfinite(prior[on]), drawn[on], 0.0)[:, None]
            H = np.linalg.inv(information + L)
            covariance = H @ (information + pull * np.eye(len(L)) * pull.T) @ H
            found.append(float(np.sqrt(np.einsum("nij,jk,nik->", A, covariance, A) / len(A))))
        return found

    def error(self, calibration: FittedCalibration) -> float:
        """The tip's rms error over the workspace, the best alignment at the base. [m]"""
        chain = calibration.chain
        q = chain.random_values(WORKSPACE, np.random.default_rng(1))
        each = np.arange(len(q))
        readings = Readings(q, each, AT_REST, np.zeros_like(each), previous=np.roll(q, 1, axis=0))
        problem, told = calibration.problem, lambda q: replace(readings, q=q, previous=np.roll(q, 1, axis=0))
        found = problem.joint_values(told(problem.told(q)), calibration.fit.state)
        here = tip_poses(problem.mechanism, found, problem.placements(calibration.fit.state))[:, :3, 3]
        # Of a world whose links bend the true mechanism has flexures, whatever the calibration knows.
        real = Problem.of(self.session(**self.asked), rows_of(chain))
        values = self.joint_values(real, told(real.told(q)))
        true = tip_poses(self.data.truth.chain, values, self.data.truth.placements)[:, :3, 3]
        T = kabsch(here, true)
        return rms(np.linalg.norm(here @ T[:3, :3].T + T[:3, 3] - true, axis=1))

    def held(self, calibration: FittedCalibration) -> list[bool]:
        """Which of the chosen models' parameters are within their intervals."""
        fit, found = calibration.fit, []
        for model in models(replace(self.data.session, joint_models=self.asked)):
            where, active = fit.parameters.active_columns(model.key)
            if active.any():
                true = self.p.get(model.name, model.nominal)
                sigma = np.sqrt(np.diag(fit.covariance))[where]
                found += (np.abs(fit.state[model.key] - true)[active] < 1.96 * sigma).tolist()
        return found


def models(session: Session) -> list[LinearJointModel]:
    return [model for kind in LINEAR if (model := kind.of(session)) is not None]


def chosen(calibration: FittedCalibration) -> set[str]:
    return {term.model for term in calibration.comparison.chosen.spec.terms}


def simulated(rigs: list[str], worlds: list[str], seeds: int, poses: int) -> None:
    print("tip, mm                      bound     known      auto  auto/bound  auto/known    true       off ", end="")
    print(" auto/off  held   found")
    for name in worlds:
        names = tuple(set(OFF) - {"bending"}) if name == "together" else () if name == "rigid" else (name,)
        for rig in rigs:
            rows, held, hits, false, nothing = [], [], 0, 0, 0
            for seed in range(seeds):
                world = World.of(rig, seed, poses, names)
                auto, true, off = (
                    calibrate(world.session(**said), force=True) for said in (world.asked, world.true_models, OFF)
                )
                rows.append([*world.bounds(), *(world.error(of) for of in (auto, true, off))])
                held += world.held(auto)
                hits += len(chosen(auto) & set(names))
                false += len(chosen(auto) - set(names))
                nothing += not chosen(auto)
            bound, known, auto, true, off = 1e3 * np.sqrt(np.mean(np.square(rows), axis=0))
            print(f"{name:14} {rig:10} {bound:9.4f} {known:9.4f} {auto:9.4f} {auto / bound:11.3f}", end="")
            print(f" {auto / known:11.3f} {true:9.4f} {off:9.4f} {auto / off:9.3f}", end="")
            print(f" {np.mean(held) if held else np.nan:6.3f}  {hits} of {len(names) * seeds},", end="")
            print(f" {false}; nothing {nothing} of {seeds}", flush=True)


def measured(folder: Path) -> None:
    sessions = {name: read_session(folder / f"ur10_{name}") for name in ("spread", "cubes")}
    for a, b in (("spread", "cubes"), ("cubes", "spread")):
        for words, said in (("auto", {}), ("off", OFF)):
            calibration = calibrate(replace(sessions[a], joint_models=said), force=True)
            chain = calibration.chain.with_placements(calibration.placements)
            (residual,) = explain(chain, sessions[b], bends=calibration.joint_models).residuals
            elsewhere = 1e3 * calibration.evidence.regions.rms
            print(f"ur10 {a} -> {b} {words:5} {1e3 * rms(np.linalg.norm(residual, axis=1)):.3f} mm", end="")
            print(f"   left-out regions {elsewhere:.3f} mm  {', '.join(sorted(chosen(calibration)))}", flush=True)
    for name in ("irb120_liaowu", "motoman_right", "panda_sockets"):
        for words, said in (("auto", {}), ("off", OFF)):
            try:
                session = read_session(folder / name)
            except UrdfcalError as error:
                print(f"{name}: {error}")
                break
            calibration = calibrate(replace(session, joint_models=said), force=True)
            held_out = 1e3 * calibration.comparison.chosen.rms("distance")
            print(
                f"{name} {words:5} held out {held_out:.3f} mm, regions {1e3 * calibration.evidence.regions.rms:.3f}",
                end="",
            )
            print(f" mm  {', '.join(sorted(chosen(calibration)))}", flush=True)


def speed(poses: int) -> None:
    """Time one solve of the rigid arm, and of one with compliance."""
    data = simulate(read_rig(find_rig("ur5")), poses=poses, seed=0)
    spec = ModelSpec("dh", ("fixed",) * 2, ("fixed",) * 2)
    taken = {}
    for words, on in (("rigid", False), ("compliance", True)) * 2:
        session = replace(data.session, joint_models={**OFF, "compliance": on})
        problem = Problem.of(session, rows_of(session.chain))
        state = true_state_of(data)
        start = state.replace({ARM: np.zeros_like(state[ARM])})
        parameters = identify(problem, start, choose_parameters(session, problem, start, spec)).parameters
        before = time.perf_counter()
        solve(problem, start, parameters)
        taken[words] = time.perf_counter() - before
    print(f"{poses} poses: rigid {taken['rigid']:.3f} s, with compliance {taken['compliance'] / taken['rigid']:.2f} x")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--poses", type=int, default=60)
    parser.add_argument("--rigs", nargs="*", default=["ur5", "panda", "so101"])
    parser.add_argument("--worlds", nargs="*", default=["rigid", *OFF, "together"])
    parser.add_argument("--measured", type=Path)
    parser.add_argument("--speed", type=int)
    arguments = parser.parse_args()
    if arguments.measured:
        measured(arguments.measured)
    elif arguments.speed:
        speed(arguments.speed)
    else:
        simulated(arguments.rigs, arguments.worlds, arguments.seeds, arguments.poses)


if __name__ == "__main__":
    main()
