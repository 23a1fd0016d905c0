"""A first state without any guess from the user: closed forms on the nominal arm (METHOD 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.arrays import evenly, inverse, numbered
from urdfcal.estimation.alignment import place_base
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import base_keys
from urdfcal.estimation.blocks.leds import LEDS, led_positions
from urdfcal.estimation.blocks.scale import SCALE
from urdfcal.estimation.blocks.targets import nominal_targets, target_key
from urdfcal.estimation.joint_models import joint_models_of
from urdfcal.estimation.measurements import Measurement
from urdfcal.estimation.state import Key, State
from urdfcal.estimation.target_start import place_targets
from urdfcal.robot.kinematics import link_poses

if TYPE_CHECKING:
    from collections.abc import Mapping

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.measurements.base import WorldPoints
    from urdfcal.session.model import Session

# A few points in space, as where cameras' views overlap, are worth less than one camera's many detections.
_ENOUGH = 6
# More poses than this of each LED in each camera make the start no better than the solver needs it, only slower.
_POSES = 200


@dataclass(frozen=True, eq=False)
class Start:
    """What kinds of measurement start their unknowns from.

    Attributes:
        session: what was measured, and what is known.
        links: (F, N, 4, 4) T_base_link of the session's frames 1, 2, ... at every pose, on the arm to start from. [m]
        unknown_leds: (L,) LEDs whose position nothing has determined yet.
    """

    session: Session
    links: Floats
    unknown_leds: Bools

    @classmethod
    def of(cls, session: Session, arm: ArmParameterization, offsets: Floats) -> Start:
        """Place the links of an arm with given offsets (rows, columns)."""
        tips = session.attachments.tips
        links = np.array(link_poses(session.chain, session.q, tips, arm.placements(offsets)))
        return cls(session, links, np.array([led.position is None for led in session.leds], dtype=bool))

    def frame(self, frame: int, pose: Ints, state: State, T_world_base: Floats | None = None) -> Floats:
        """T_base_frame (S, 4, 4) of a frame at some poses (S,).

        Args:
            frame: which.
            pose: (S,) indices.
            state: where the targets are, and the bases.
            T_world_base: (N, 4, 4) instead of the state's; where that has none, the world is the base. [m]
        """
        attachments = self.session.attachments
        if frame >= attachments.first_target:
            own: Floats = state[target_key(attachments.frames[frame])]
            return self.frame(int(attachments.carrier[frame]), pose, state, T_world_base) @ own
        if frame:
            link: Floats = self.links[frame - 1, pose]
            return link
        if T_world_base is None:
            keys = base_keys(attachments.parts)
            T_world_base = np.array([state[key] if key in state else np.eye(4) for key in keys])[self.session.part]
        return inverse(T_world_base[pose])

    def placed(self, state: State) -> Bools:
        """Return which LEDs and points of targets (L + M,) are roughly known in their frames."""
        attachments = self.session.attachments
        known = np.array([target_key(name) in state for name in attachments.targets], dtype=bool)
        own = attachments.led[len(self.session.leds) :] - attachments.first_target
        return np.concatenate([[led.position is not None for led in self.session.leds], known[own]]).astype(bool)


def first_state(
    session: Session, arm: ArmParameterization, offsets: Floats, known: Mapping[Key[Any], Any] | None = None
) -> State:
    """Place base, LEDs and cameras by what is measured.

    3-D points (measured, or triangulated by eye-to-hand cameras of known pose) give the base pose and the LED positions
    in closed form; the kinds of measurement then start what they need themselves: a camera of unknown pose is placed
    by PnP, LEDs of unknown position that nothing else placed where the cameras' rays meet. Of many poses an even
    selection serves.

    Args:
        session: what was measured.
        arm: the arm's parameters.
        offsets: the arm to start from, of the arm's shape; zeros for the nominal arm.
        known: values of joint models that are not to start at their nominal one.

    Raises:
        CalibrationError: too few measurements to place the base or a camera.
    """
    session = session.at(_selection(session))
    models = joint_models_of(session)
    joints = {**{model.key: model.nominal for model in models}, **(known or {})}
    scale = {} if session.scale_sigma is None else {SCALE: np.zeros(1)}
    state = State({ARM: offsets, **nominal_places(session), **joints, **scale})
    at = Start.of(session, arm, offsets + sum(model.offsets(arm, joints[model.key]) for model in models))
    tables = [table for table in session.measurements if isinstance(table, Measurement)]
    bases = base_keys(session.attachments.parts)
    tables.sort(key=lambda table: not table.defines_world(session.attachments))  # the others need the world
    for table in tables:
        points = table.world_points(session)
        if points is not None:
            for k, key in enumerate(bases):
                at, state = _by_points(points, at, state, k, key)
    if not any(table.defines_world(session.attachments) for table in tables):
        state = state.replace({key: np.eye(4) for key in bases})
    state = place_targets(at, tables, state)
    for table in tables:
        state = table.start(at, state)
    state = state.replace({key: np.eye(4) for key in bases if key not in state})
    state = place_targets(at, tables, state)
    unplaced = (*bases, *(target_key(name) for name in session.attachments.targets))
    return state.replace({key: np.eye(4) for key in unplaced if key not in state})


def nominal_places(session: Session) -> dict[Key[Any], Floats]:
    """Return the places of LEDs and targets as the session gives them; no key of a target of unknown pose."""
    return {LEDS: led_positions(session.leds), **nominal_targets(session.targets)}


def _by_points(points: WorldPoints, at: Start, state: State, part: int, base: Key[Floats]) -> tuple[Start, State]:
    """Place the base of a part, and LEDs, by points in space, if there are enough of them and it is not placed."""
    session, frames = at.session, at.session.attachments.led
    moving = (session.part[points.pose] == part) & (frames[points.led] != 0) & (points.led < len(session.leds))
    pose, led, xyz = points.pose[moving], points.led[moving], points.xyz[moving]
    if base in state or not len(xyz) or (not points.complete and len(xyz) < _ENOUGH):
        return at, state
    exact = np.array([led.sigma == 0.0 for led in session.leds])
    T_base_led = at.links[frames[led] - 1, pose]
    T_world_base, leds = place_base(T_base_led, led, xyz, state[LEDS], at.unknown_leds, exact)
    unknown = at.unknown_leds.copy()
    if len(xyz) >= _ENOUGH:
        unknown[np.unique(led)] = False
    return Start(session, at.links, unknown), state.replace({base: T_world_base, LEDS: leds})


def _selection(session: Session) -> Ints:
    """Indices of poses spread evenly over the session, and over what is measured of each LED by each camera."""
    every = np.arange(len(session.poses))
    if len(every) <= _POSES:
        return every
    chosen = [evenly(every, _POSES)]
    for table in session.measurements:
        views = numbered([session.part[table.pose], *(of for key, of in table.index.items() if key != "pose")])
        chosen += [evenly(table.pose[views == view], _POSES) for view in np.unique(views)]
    return np.unique(np.concatenate(chosen))
