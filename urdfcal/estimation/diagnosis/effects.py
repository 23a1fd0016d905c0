"""Effects that may hide in residuals: what moves, in which way, and the sentence that says so (METHOD 15)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from urdfcal.estimation.blocks.base_pose import base_keys
from urdfcal.estimation.blocks.cameras import has_cameras, lens_key, pose_key
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.estimation.diagnosis.residuals import Part
from urdfcal.estimation.joint_models.linear import LinearJointModel

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from urdfcal.arrays import Floats
    from urdfcal.estimation.joint_models import Readings
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session

Movable = Literal["joint", "led", "target", "camera", "base"]


@dataclass(frozen=True, eq=False)
class Subject:
    """Something that may have moved: a joint, an LED, a target, a camera, or the robot's base.

    Attributes:
        kind: of it.
        name: of it; of the base that of the part of the session.
        columns: derivative (N, m D, k) of a kind of measurement by its motion.
    """

    kind: Movable
    name: str
    columns: Callable[[Part], Floats]

    @property
    def called(self) -> str:
        """What a sentence calls it."""
        base = f"the robot's base in {self.name!r}" if self.name else "the robot's base"
        known = {"joint": self.name, "led": f"LED {self.name!r}", "base": base}
        return known.get(self.kind, f"{self.kind} {self.name!r}")

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
    for j, joint in enumerate(problem.mechanism.joints):
        if joint.mimic is None:
            yield Subject("joint", joint.name, partial(Part.by_joint, joint=j))
    for k, led in enumerate(session.leds):
        yield Subject("led", led.name, partial(Part.by, key=LEDS, coordinates=slice(3 * k, 3 * k + 3)))
    for target in session.targets:
        yield Subject("target", target.name, partial(Part.by, key=target_key(target.name)))
    if has_cameras(state) and len(session.rig.names) > 1:
        for c, name in enumerate(session.rig.names):
            yield Subject("camera", name, partial(Part.by, key=pose_key(name), camera=c))
    for key, name in zip(base_keys(session.parts), session.parts, strict=True):
        yield Subject("base", name, partial(Part.by, key=key))


def effects(session: Session, problem: Problem, state: State) -> Iterator[Effect]:
    """List what a rigid arm between perfect joints, before perfect lenses, does not have."""
    for model in problem.joint_models:
        if isinstance(model, LinearJointModel):
            yield from _joint_effects(model, problem.readings, state[model.key])
    for c, name in enumerate(session.rig.names if has_cameras(state) else ()):
        if session.rig.lens[c] != c:
            continue  # another's, which is tested
        what = f"the detections of camera {name!r} err with their place in the image: its intrinsics are not as given"
        yield Effect(f"{name}: lens", partial(Part.by, key=lens_key(name)), partial(_say, what))
        yield from _focal_effects(name, state)


def _focal_effects(name: str, state: State) -> Iterator[Effect]:
    """A focal length alone is found where all of a lens would need more evidence."""
    focal = state[lens_key(name)].intrinsics[:2, None]

    def longer(part: Part) -> Floats:
        columns: Floats = part.by(lens_key(name), slice(0, 2)) @ focal
        return columns

    def sentence(p: Floats) -> str:
        return f"the focal length of camera {name!r} is {1e2 * p[0]:+.2g} % off: its intrinsics are not as given"

    yield Effect(f"{name}: focal length", longer, sentence)


def drifts(session: Session, problem: Problem, state: State) -> Iterator[Effect]:
    """List what may have moved steadily from the first pose to the last."""
    order = np.linspace(0.0, 1.0, len(session.poses))
    for subject in subjects(session, problem, state):
        yield Effect(f"{subject.called}: drift", partial(_drifted, subject, order), partial(_say_drift, subject))


def _joint_effects(model: LinearJointModel, readings: Readings, p: Floats) -> Iterator[Effect]:
    """What a joint model would explain, joint by joint and, where they have it together, of all; not where it is in."""
    features, joints = model.known_features(readings), model.mechanism.actuated_joints
    out = (p == 0.0) & (np.ptp(features, axis=0) > 0.0)
    columns: dict[str, Callable[[Part], Floats]] = {}
    for j, joint in enumerate(joints):
        for label, places in model.groups.items():
            some = [k for k, of in enumerate(model.joints) if of == j]
            some = [some[place] for place in places if some and out[some[place]]]
            if some and model.shows(joint, readings.q[:, model.mechanism.names.index(joint.name)]):
                columns[joint.name] = partial(_carried, model, some, readings)
                yield Effect(f"{joint.name}: {label}", columns[joint.name], partial(model.sentence, joint, label))
    if model.together and len(columns) > 1:
        every = [k for k, name in enumerate(model.names_of_joints) if name in columns]
        (label,) = model.groups

        def all_of_them(sizes: Floats) -> str:
            return model.sentence_of_all("the joints", 1e3 * float(np.abs(sizes * features[:, every]).max()))

        yield Effect(f"all joints: {label}", partial(_carried, model, every, readings), all_of_them)


def _carried(model: LinearJointModel, some: Sequence[int], readings: Readings, part: Part) -> Floats:
    """Columns (N, m D, k) of some parameters of a joint model."""
    by_model = model.jacobian(readings.at(part.pose), model.nominal)[..., some]
    columns: Floats = part.at.J_q @ by_model
    return columns


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
