"""Effects that may hide in residuals: what moves, in which way, and the sentence that says so (METHOD 15)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.cameras import has_cameras, lens_key, pose_key
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.estimation.diagnosis.residuals import Part
from urdfcal.estimation.diagnosis.torque import gravity_torques

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from urdfcal.arrays import Floats
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.state import State
    from urdfcal.robot.mechanism import Joint, Mechanism
    from urdfcal.session.model import Session

Movable = Literal["joint", "led", "target", "camera", "base"]

# Joints that moved by less between poses did not move. [rad or m]
_STILL = 1e-6
# A joint that turns by less shows no harmonics: they look like a zero offset or a gear ratio. [rad]
_TURN = 1.0


@dataclass(frozen=True, eq=False)
class Subject:
    """Something that may have moved: a joint, an LED, a target, a camera, or the robot's base.

    Attributes:
        kind: of it.
        name: of it; empty for the base.
        columns: derivative (N, m D, k) of a kind of measurement by its motion.
    """

    kind: Movable
    name: str
    columns: Callable[[Part], Floats]

    @property
    def called(self) -> str:
        """What a sentence calls it."""
        if self.kind == "joint":
            return self.name
        return (
            "the robot's base" if self.kind == "base" else f"{'LED' if self.kind == 'led' else self.kind} {self.name!r}"
        )

    def size(self, motion: Floats) -> str:
        """Say how far it moved; motion (1,) for a joint, (3,) for an LED, (6,) else. [rad or m]."""
        if self.kind == "joint":
            return f"{1e3 * abs(motion[0]):.2g} mrad"
        if self.kind == "led":
            return f"{1e3 * np.linalg.norm(motion):.2g} mm"
        return f"{1e3 * np.linalg.norm(motion[:3]):.2g} mm and {1e3 * np.linalg.norm(motion[3:]):.2g} mrad"


@dataclass(frozen=True, eq=False)
class Effect:
    """Something that every pose shows in its own way.

    Attributes:
        name: short, for tables and tests.
        columns: derivative (N, m D, k) of a kind of measurement by its k sizes.
        sentence: says what it is, from the sizes (k,).
    """

    name: str
    columns: Callable[[Part], Floats]
    sentence: Callable[[Floats], str]


def subjects(session: Session, problem: Problem, state: State) -> Iterator[Subject]:
    """List what may have moved while a session was measured."""
    for j, joint in enumerate(problem.arm.chain.joints):
        if joint.mimic is None:
            yield Subject("joint", joint.name, partial(Part.by_joint, joint=j))
    for k, led in enumerate(session.leds):
        yield Subject("led", led.name, partial(Part.by, key=LEDS, coordinates=slice(3 * k, 3 * k + 3)))
    for target in session.targets:
        yield Subject("target", target.name, partial(Part.by, key=target_key(target.name)))
    if has_cameras(state) and len(session.rig.names) > 1:
        for c, name in enumerate(session.rig.names):
            yield Subject("camera", name, partial(Part.by, key=pose_key(name), camera=c))
    yield Subject("base", "", partial(Part.by, key=BASE))


def effects(session: Session, problem: Problem, state: State) -> Iterator[Effect]:
    """List what a rigid arm between perfect joints, before perfect lenses, does not have."""
    chain, q = problem.arm.chain, problem.readings.q
    for j, joint in enumerate(chain.joints):
        if joint.mimic is None:
            yield from _joint_effects(j, joint, q[:, j])
    tau = gravity_torques(session, chain, q)
    if tau is not None:
        yield from _torque_effects(chain, tau)
    for c, name in enumerate(session.rig.names if has_cameras(state) else ()):
        what = f"the detections of camera {name!r} err with their place in the image: its intrinsics are not as given"
        yield Effect(f"{name}: lens", partial(Part.by, key=lens_key(name), camera=c), partial(_say, what))
        yield from _focal_effects(c, name, state)


def _focal_effects(c: int, name: str, state: State) -> Iterator[Effect]:
    """A focal length alone is found where all of a lens would need more evidence."""
    focal = state[lens_key(name)].intrinsics[:2, None]

    def longer(part: Part) -> Floats:
        columns: Floats = part.by(lens_key(name), slice(0, 2), c) @ focal
        return columns

    def sentence(p: Floats) -> str:
        return f"the focal length of camera {name!r} is {1e2 * p[0]:+.2g} % off: its intrinsics are not as given"

    yield Effect(f"{name}: focal length", longer, sentence)


def drifts(session: Session, problem: Problem, state: State) -> Iterator[Effect]:
    """List what may have moved steadily from the first pose to the last."""
    order = np.linspace(0.0, 1.0, len(session.poses))
    for subject in subjects(session, problem, state):
        yield Effect(f"{subject.called}: drift", partial(_drifted, subject, order), partial(_say_drift, subject))


def _joint_effects(j: int, joint: Joint, q: Floats) -> Iterator[Effect]:
    name, unit, turn = joint.name, "mm" if joint.prismatic else "mrad", np.ptp(q)
    for h, times in ((1, "once"), (2, "twice")) if not joint.prismatic and turn > _TURN else ():

        def harmonic(p: Floats, times: str = times) -> str:
            return (
                f"{name} errs with its own angle, {1e3 * np.hypot(*p):.2g} mrad, {times} a turn: encoder eccentricity, "
                "or the gear's error"
            )

        yield Effect(f"{name}: harmonic {h}", _by_joint(j, np.stack([np.sin(h * q), np.cos(h * q)], axis=1)), harmonic)
    if turn > 0.0:
        step = np.diff(q, prepend=q[:1])

        def gain(p: Floats) -> str:
            return f"{name} moves {1e2 * p[0]:+.2g} % more than it reads: gear ratio, or screw pitch"

        def approach(p: Floats) -> str:
            return f"{name} is {2e3 * abs(p[0]):.2g} {unit} apart between approaches from its two sides: backlash"

        yield Effect(f"{name}: gain", _by_joint(j, (q - q.mean())[:, None]), gain)
        yield Effect(
            f"{name}: approach", _by_joint(j, np.sign(np.where(np.abs(step) > _STILL, step, 0.0))[:, None]), approach
        )


def _torque_effects(chain: Mechanism, tau: Floats) -> Iterator[Effect]:
    moved = [j for j in range(len(chain.joints)) if np.ptp(tau[:, j]) > 0.0]
    columns = {j: _by_joint(j, tau[:, [j]]) for j in moved}
    for j, of in columns.items():

        def yields(p: Floats, name: str = chain.names[j]) -> str:
            return f"{name} yields under the arm's weight, {abs(p[0]):.1e} rad/(N m): the arm bends"

        yield Effect(f"{chain.names[j]}: torque", of, yields)

    def all_yield(p: Floats) -> str:
        most = 1e3 * float(np.abs(p * np.abs(tau[:, moved]).max(axis=0)).max())
        return f"the joints yield under the arm's weight, by up to {most:.2g} mrad: the arm bends"

    yield Effect(
        "all joints: torque", lambda part: np.concatenate([of(part) for of in columns.values()], axis=-1), all_yield
    )


def _by_joint(joint: int, values: Floats) -> Callable[[Part], Floats]:
    """Columns of a joint that errs by values (poses, k) times k sizes."""
    return lambda part: part.by_joint(joint) * values[part.pose][:, None, :]


def _drifted(subject: Subject, order: Floats, part: Part) -> Floats:
    return subject.columns(part) * order[part.pose][:, None, None]


def _say_drift(subject: Subject, motion: Floats) -> str:
    return (
        f"{subject.called} moved steadily from the first pose to the last, by {subject.size(motion)}: warming up, or "
        "settling"
    )


def _say(what: str, sizes: Floats) -> str:
    del sizes
    return what
