"""Simulated sessions that one thing is wrong with: with the arm, with the world around it, or with what is declared."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from tests.states import true_state_of
from urdfcal.arrays import inverse
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.cameras import pose_key
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.joint_models.linear import LinearJointModel
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.problem import Problem
from urdfcal.robot.chain import Chain
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.session.knowledge import Estimate, Noise
from urdfcal.simulation.joint_errors import draw_joint_errors, true_joint_values

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Session
    from urdfcal.simulation.truth import Simulated

RIGID = {model.name: False for model in JOINT_MODELS if issubclass(model, LinearJointModel)}
"""A session's joint models where the arm is rigid between perfect joints, and that is not weighed."""
ALONE = {"estimate": Estimate("dh", "fixed"), "joint_models": RIGID}
"""What a session says of itself where nothing but the rows of a rigid arm is in question."""
EVENT = 30
"""The pose from which on something is otherwise."""


def seen(data: Simulated, q: Floats | None = None, late: Callable[[State], State] | None = None) -> Session:
    """The session, had the joints truly been at ``q``, or been anything else from pose ``EVENT`` on."""
    session = data.session
    problem, state = Problem.of(session, rows_of(session.chain)), true_state_of(data)
    (observed,) = problem.observations

    def predicted(values: Floats, state: State) -> Floats:
        readings = replace(observed.readings, q=values[observed.pose])
        return problem.predict(replace(observed, readings=readings), state)

    before = predicted(data.truth.q, state)
    after = predicted(data.truth.q if q is None else q, state)
    if late is not None:
        changed = predicted(data.truth.q, late(state))
        after = np.where((observed.pose >= EVENT)[:, None, None], changed, after)
    detections = session.find(Detections)
    return with_detections(session, uv=detections.uv + observed.by_row(after - before))


def with_detections(session: Session, **changes: Floats) -> Session:
    return replace(session, measurements=(replace(session.find(Detections), **changes),))


def direction(count: int, seed: int = 0) -> Floats:
    value = np.random.default_rng(seed).normal(size=count)
    return value / np.linalg.norm(value)


def twist(size: float, seed: int) -> Floats:
    """A motion of so many metres, and as many radians."""
    return size * np.concatenate([direction(3, seed), direction(3, seed + 1)])


def joint(data: Simulated, share: float) -> int:
    return round(share * (len(data.session.chain.names) - 1))


def scaled(data: Simulated, size: float) -> Session:
    rig = data.session.rig
    places = [None if T is None else np.array(T) for T in rig.T_cam_world]
    for T in places[1:]:
        T[:3, 3] *= 1.0 + size
    return replace(data.session, rig=replace(rig, T_cam_world=tuple(places)))


def repeated(data: Simulated, _: float) -> Session:
    """The first ten poses, measured five times each."""
    session, rng = data.session.at(np.arange(10)), np.random.default_rng(data.truth.seed)
    detections = session.find(Detections)
    rows = np.tile(np.arange(len(detections)), 5)
    pose = np.concatenate([detections.pose + 10 * k for k in range(5)])
    sigma = np.sqrt(2.0) * session.noise.pixel
    table = Detections(
        pose, detections.camera[rows], detections.led[rows],
        detections.uv[rows] + rng.normal(0.0, session.noise.pixel, (len(rows), 2)), np.array(sigma),
    )  # fmt: skip
    return replace(
        session,
        poses=tuple(f"{k}" for k in range(50)),
        q=np.tile(session.q, (5, 1)),
        previous=None,
        measurements=(table,),
        noise=replace(session.noise, pixel=sigma),
    )


def declared(data: Simulated, _: float, pixel: float = 1.0, joint_noise: float | None = None) -> Session:
    noise = data.session.noise
    noise = Noise(pixel * noise.pixel, noise.point, noise.joint if joint_noise is None else joint_noise)
    detections = data.session.find(Detections)
    return replace(with_detections(data.session, sigma=pixel * detections.sigma), noise=noise)


def displaced_led(data: Simulated, _: float) -> Session:
    led = data.session.leds[0]
    led = replace(led, position=led.position + 0.043 * direction(3))
    return replace(data.session, leds=(led, *data.session.leds[1:]))


def harmonic(data: Simulated, size: float, share: float, order: int) -> Session:
    q, j = data.truth.q.copy(), joint(data, share)
    q[:, j] += size * np.sin(order * q[:, j] + 0.7)
    return seen(data, q)


def erring(data: Simulated, **sizes: float | dict[str, float]) -> Session:
    """The session, had its joints the errors that rig.yaml can say."""
    exact = replace(data.session.unmeasured(), q=data.truth.readings)
    return seen(data, true_joint_values(exact, draw_joint_errors(sizes, exact, data.truth.seed)))


def sagging(data: Simulated, size: float) -> Session:
    return erring(data, compliance=size)


def backlash(data: Simulated, size: float, share: float) -> Session:
    return erring(data, backlash={data.session.chain.names[joint(data, share)]: size})


def gain(data: Simulated, size: float, share: float) -> Session:
    return erring(data, gain={data.session.chain.names[joint(data, share)]: size})


def jumped(data: Simulated, size: float, share: float) -> Session:
    q, j = data.truth.q.copy(), joint(data, share)
    q[EVENT:, j] += size
    return seen(data, q)


def slipped(data: Simulated, size: float) -> Session:
    return seen(data, late=lambda state: state.replace({LEDS: state[LEDS] + size * direction(3, 5)}))


def bumped(data: Simulated, size: float) -> Session:
    return seen(data, late=lambda state: state.replace({BASE: state[BASE] @ pin.exp6(twist(size, 6)).homogeneous}))


def camera_bumped(data: Simulated, size: float) -> Session:
    key = pose_key(data.session.rig.names[1])
    return seen(data, late=lambda state: state.replace({key: pin.exp6(twist(size, 7)).homogeneous @ state[key]}))


def drifting(data: Simulated, size: float) -> Session:
    session, parts = data.session, []
    problem, state = Problem.of(session, rows_of(session.chain)), true_state_of(data)
    (observed,) = problem.observations
    observed = replace(observed, readings=replace(observed.readings, q=data.truth.q[observed.pose]))
    for share in (0.0, 1.0):
        parts.append(problem.predict(observed, state.replace({LEDS: state[LEDS] + share * size * direction(3, 8)})))
    moved = (parts[1] - parts[0]) * (observed.pose / (len(session.poses) - 1))[:, None, None]
    return with_detections(session, uv=session.find(Detections).uv + observed.by_row(moved))


def other_lens(data: Simulated, size: float) -> Session:
    rig = data.session.rig
    lens = rig.cameras[0]
    lens = lens.with_parameters(lens.parameters * np.where(np.arange(len(lens.parameters)) < 2, 1.0 + size, 1.0))
    return replace(data.session, rig=replace(rig, cameras=(lens, *rig.cameras[1:])))


def other_sign(data: Simulated, _: float, share: float) -> Session:
    q, j = np.array(data.session.q), joint(data, share)
    q[:, j] *= -1.0
    return replace(data.session, q=q)


def exchanged(data: Simulated, _: float, first: int) -> Session:
    q = np.array(data.session.q)
    q[:, [first, first + 1]] = q[:, [first + 1, first]]
    return replace(data.session, q=q)


def shifted(data: Simulated, _: float, by: int) -> Session:
    return replace(data.session, q=np.roll(data.session.q, by, axis=0))


def inverted(data: Simulated, _: float) -> Session:
    rig = data.session.rig
    return replace(data.session, rig=replace(rig, T_cam_world=(rig.T_cam_world[0], inverse(rig.T_cam_world[1]))))


def images(data: Simulated, _: float, change: Callable[[Floats, Floats], Floats]) -> Session:
    detections = data.session.find(Detections)
    size = np.array([camera.resolution for camera in data.session.rig.cameras], dtype=float)[detections.camera]
    return with_detections(data.session, uv=change(detections.uv, size))


def other_robot(data: Simulated, _: float) -> Session:
    """Another size of the same family: a UR5 named where a UR3 stands."""
    urdf = Urdf.read("package://example-robot-data/robots/ur_description/urdf/ur3_robot.urdf")
    chain = Chain.from_urdf(urdf, data.session.chain.tip_link, data.session.chain.base_link)
    return replace(data.session, chain=chain, urdf=urdf)
