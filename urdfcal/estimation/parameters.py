"""The parameters of an estimate: which there are, their names, units, priors, and their packing into a vector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Bools, Floats, frozen, inverse
from urdfcal.estimation.camera_prior import CameraPrior
from urdfcal.estimation.state import State

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from urdfcal.estimation.model_spec import Freedoms
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.model import Led, Session, Tolerances

LED_TOLERANCE = 0.02
"""Standard deviation of an LED position given without one: a hand-held ruler on a gripper. [m]"""

CLOCK = 1.0
"""Standard deviation of a camera's time offset: driver and transport delay a frame by 10 to 100 ms, clocks that are set
by hand or seldom differ by a second; a moving arm tells it to a fraction of a millisecond whatever is believed. [s]"""

_POSE_AXES = ("x", "y", "z", "rx", "ry", "rz")


class Geometry(Protocol):
    """The arm's parameters: DH rows, or whole placements."""

    @property
    def chain(self) -> Mechanism:
        """The joints as drawn."""

    @property
    def columns(self) -> tuple[str, ...]:
        """What each column of an offsets array adds to."""

    @property
    def labels(self) -> tuple[str, ...]:
        """What each row of an offsets array belongs to: a joint, or the mount of a branch."""

    @property
    def parameters(self) -> tuple[tuple[int, str], ...]:
        """(row index, column name) of every parameter."""

    @property
    def zeros(self) -> tuple[tuple[int, str], ...]:
        """Those of them that are joints' zero offsets."""

    def reason(self, row: int, name: str) -> str:
        """Why a parameter of a row is never a candidate."""

    def placements(self, offsets: Floats) -> Floats:
        """Joint placements (n, 4, 4) under offsets (rows, columns)."""

    def twists(self, offsets: Floats, parameters: Iterable[tuple[int, str]]) -> Floats:
        """Body twists (6 n, p) of the placements for each parameter."""


@dataclass(frozen=True, eq=False)
class Parameters:
    """The packing of the estimated part of a ``State`` into one vector.

    The full vector holds the DH offsets, the base pose, the LEDs, the camera poses, the lenses, the clocks; ``active``
    says which of its entries are estimated, the others keep their value.

    Attributes:
        rows: (row index, parameter) of each of the arm's offsets.
        columns: the parameters' order in an offsets array.
        leds: number of LEDs, three coordinates each.
        cameras: indices of the cameras whose pose in the frame they are fixed in is a parameter.
        leader: (C,) for each camera the first one in the same frame: where that goes, the others go with it.
        lenses: indices of the cameras whose intrinsics are parameters.
        lens_sizes: number of intrinsics of each of them.
        clocks: indices of the cameras whose time offset is a parameter.
        names: of every entry of the full vector.
        active: (P,) bool.
        prior: (P,) standard deviation about the centre; inf where there is no prior. [unit of the entry]
        correlation: (P, P) of the priors' errors: cameras calibrated together err together.
        measured: (P,) bool, whose prior is a calibration of the cameras and no tolerance.
        centre: the state the priors are centred at.
        distances: (LED, LED, distance, standard deviation) of each measured LED distance. [m]
        zeros: indices of the joints' zero offsets.
        reasons: why an entry is not active.
    """

    rows: tuple[tuple[int, str], ...]
    columns: tuple[str, ...]
    leds: int
    cameras: tuple[int, ...]
    leader: tuple[int, ...]
    lenses: tuple[int, ...]
    lens_sizes: tuple[int, ...]
    clocks: tuple[int, ...]
    names: tuple[str, ...]
    active: Bools
    prior: Floats
    correlation: Floats
    measured: Bools
    centre: State
    distances: tuple[tuple[int, int, float, float], ...]
    zeros: frozenset[int]
    reasons: Mapping[int, str]

    @property
    def size(self) -> int:
        """Length of the full vector."""
        return len(self.names)

    @cached_property
    def count(self) -> int:
        """Number of active entries."""
        return int(np.count_nonzero(self.active))

    @property
    def base(self) -> slice:
        """Where T_world_base is in the full vector."""
        return slice(len(self.rows), len(self.rows) + 6)

    def led(self, index: int) -> slice:
        """Where an LED is in the full vector."""
        first = self.base.stop + 3 * index
        return slice(first, first + 3)

    def camera(self, position: int) -> slice:
        """Where the pose of ``cameras[position]`` is in the full vector."""
        first = self.base.stop + 3 * self.leds + 6 * position
        return slice(first, first + 6)

    def lens(self, position: int) -> slice:
        """Where the intrinsics of ``lenses[position]`` are in the full vector."""
        first = self.base.stop + 3 * self.leds + 6 * len(self.cameras)
        return slice(first + sum(self.lens_sizes[:position]), first + sum(self.lens_sizes[: position + 1]))

    def clock(self, position: int) -> slice:
        """Where the time offset of ``clocks[position]`` is in the full vector."""
        first = self.lens(len(self.lenses)).start + position
        return slice(first, first + 1)

    def holding(self, held: Mapping[int, str]) -> Parameters:
        """The same packing with more entries held at their value, each for a reason."""
        active = np.array(self.active)
        active[list(held)] = False
        return replace(self, active=frozen(active, bool), reasons={**self.reasons, **held})

    def scales(self, state: State) -> Floats:
        """What brings a unit of each parameter to about the same effect: pixels of a lens count in focal lengths."""
        scales = np.ones(self.size)
        for position, c in enumerate(self.lenses):
            fx, fy = state.cameras[c].intrinsics[:2]
            first = self.lens(position).start
            scales[first : first + 4] = fx, fy, fx, fy
        return scales

    @property
    def _clock_block(self) -> slice:
        return slice(self.clock(0).start, self.size)

    def move(self, state: State, step: Floats) -> State:
        """Apply a step of the active entries: poses move on the manifold, everything else adds.

        Args:
            state: where to start.
            step: (count,) change of the active entries.
        """
        full = np.zeros(self.size)
        full[self.active] = step
        offsets = np.array(state.offsets)
        for value, (row, name) in zip(full, self.rows, strict=False):
            offsets[row, self.columns.index(name)] += value
        leds = state.leds + full[self.base.stop : self.base.stop + 3 * self.leds].reshape(-1, 3)
        T_cam_world = np.array(state.T_cam_world)
        for position, c in enumerate(self.cameras):
            motion = pin.exp6(full[self.camera(position)]).homogeneous
            if self.leader[c] == c:
                led = [k for k, leader in enumerate(self.leader) if leader == c and k != c]
                T_cam_world[led] = T_cam_world[led] @ inverse(T_cam_world[c]) @ motion @ T_cam_world[c]
            T_cam_world[c] = motion @ T_cam_world[c]
        cameras = list(state.cameras)
        for position, c in enumerate(self.lenses):
            cameras[c] = cameras[c].with_parameters(cameras[c].parameters + full[self.lens(position)])
        time_offsets = np.array(state.time_offsets)
        time_offsets[list(self.clocks)] += full[self._clock_block]
        return State(
            offsets=offsets,
            T_world_base=state.T_world_base @ pin.exp6(full[self.base]).homogeneous,
            leds=leds,
            cameras=tuple(cameras),
            T_cam_world=T_cam_world,
            time_offsets=time_offsets,
        )

    @cached_property
    def _whitening(self) -> tuple[Floats, Bools]:
        """W (p, P), what makes deviations from the centre independent and of unit variance; its rows that are measured.

        There is a row for every active entry with a prior. Held ones stand first in the Cholesky factor: the others'
        rows then are what the prior says of them once those have their value.
        """
        known = np.isfinite(self.prior)
        held, told = np.flatnonzero(known & ~self.active), np.flatnonzero(known & self.active)
        order = np.concatenate([held, told])
        factor = np.linalg.cholesky(self.correlation[np.ix_(order, order)])
        W = np.zeros((len(told), self.size))
        W[:, order] = np.linalg.inv(factor)[len(held) :] / self.prior[order]
        return W, self.measured[told]

    def prior_residuals(self, state: State) -> tuple[Floats, Floats]:
        """Deviation from the priors' centre in standard deviations, and its derivative.

        Returns:
            r (p,) and J (p, count), a row for every active entry with a prior and for every LED distance; errors
            that go together are told apart (whitened).
        """
        deviation, J = self._deviation(state)
        W, _ = self._whitening
        distances, J_distances = self.distance_residuals(state)
        return np.concatenate([W @ deviation, distances]), np.vstack([W @ J, J_distances])[:, self.active]

    def measured_jacobian(self, state: State) -> Floats:
        """Derivative (k, count) of what was measured beside the sightings: LED distances and calibrated cameras."""
        W, measured = self._whitening
        return np.vstack([W[measured] @ self._deviation(state)[1], self.distance_residuals(state)[1]])[:, self.active]

    def _deviation(self, state: State) -> tuple[Floats, Floats]:
        """How far every entry is from the priors' centre (P,), and its derivative (P, P); the base has no centre."""
        full = np.zeros(self.size)
        for i, (row, name) in enumerate(self.rows):
            full[i] = state.offsets[row, self.columns.index(name)] - self.centre.offsets[row, self.columns.index(name)]
        full[self.base.stop : self.base.stop + 3 * self.leds] = (state.leds - self.centre.leds).ravel()
        J = np.eye(self.size)
        for position, c in enumerate(self.cameras):
            now, centre = (_by_leader(of.T_cam_world, c, self.leader[c]) for of in (state, self.centre))
            difference = pin.SE3(now @ inverse(centre))
            where = self.camera(position)
            full[where] = pin.log6(difference).vector
            # exp6(step) stands to the left: log6(exp6(s) D) moves by Jlog6(D) Ad(D^-1) s.
            J[where, where] = pin.Jlog6(difference) @ difference.inverse().action
        for position, c in enumerate(self.lenses):
            full[self.lens(position)] = state.cameras[c].parameters - self.centre.cameras[c].parameters
        clocks = list(self.clocks)
        full[self._clock_block] = state.time_offsets[clocks] - self.centre.time_offsets[clocks]
        return full, J

    def distance_residuals(self, state: State) -> tuple[Floats, Floats]:
        """Deviation from the measured LED distances in standard deviations, and its derivative by the full vector."""
        r, J = np.zeros(len(self.distances)), np.zeros((len(self.distances), self.size))
        for k, (a, b, distance, sigma) in enumerate(self.distances):
            difference = state.leds[a] - state.leds[b]
            length = float(np.linalg.norm(difference))
            r[k] = (length - distance) / sigma
            J[k, self.led(a)] = difference / max(length, 1e-12) / sigma
            J[k, self.led(b)] = -J[k, self.led(a)]
        return r, J


def choose_parameters(session: Session, table: Geometry, centre: State, freedoms: Freedoms) -> Parameters:
    """List the parameters of an estimate, with tolerances and what was measured of LEDs and cameras as priors.

    Args:
        session: names, LED and camera knowledge, tolerances.
        table: the arm's parameters.
        centre: where priors without a measured value are centred.
        freedoms: which of arm, lenses and camera poses may move.
    """
    rows: list[tuple[int, str]] = []
    names: list[str] = []
    prior: list[float] = []
    held: dict[int, str] = {}
    chosen = {"none": (), "offsets": table.zeros}.get(freedoms.geometry, table.parameters)
    zeros = set(table.zeros)
    for i, name in chosen:
        joint = table.labels[i]
        tolerance = _tolerance(session.tolerances, joint, name, zero=(i, name) in zeros)
        if tolerance == 0.0:
            held[len(rows)] = "fixed by the session's tolerances"
        rows.append((i, name))
        names.append(f"{joint}.{name}")
        prior.append(tolerance if freedoms.priors and tolerance > 0.0 else np.inf)
    frames = session.frames
    if centre.cameras and not len(frames.standing):
        held |= {len(names) + k: "all cameras ride on the robot: its base is the world" for k in range(6)}
    names += [f"T_world_base.{axis}" for axis in _POSE_AXES]
    prior += [np.inf] * 6
    for led in session.leds:
        sigma = _led_sigma(led)
        for axis in "xyz":
            if sigma == 0.0:
                held[len(names)] = "its position is given as exact"
            names.append(f"{led.name}.{axis}")
            prior.append(sigma if freedoms.priors and sigma > 0.0 else np.inf)
    world = frames.standing[:1]  # where the first camera stands is what the world is
    moving = [c for c, freedom in enumerate(freedoms.extrinsics) if c not in world and freedom != "fixed"]
    lenses = [c for c, freedom in enumerate(freedoms.intrinsics) if freedom != "fixed"]
    cameras = len(names)
    names += [f"{centre.cameras[c].name}.{axis}" for c in moving for axis in _POSE_AXES]
    names += [f"{centre.cameras[c].name}.{name}" for c in lenses for name in centre.cameras[c].parameter_names]
    known = CameraPrior.of(session, freedoms, moving, lenses)
    held |= {cameras + int(k): "its calibration gives it as exact" for k in np.flatnonzero(known.sigma == 0.0)}
    prior += np.where(known.sigma > 0.0, known.sigma, np.inf).tolist()
    seen = slice(cameras, len(names))
    free_clocks = session.estimate.time_offset != "fixed"
    clocks = tuple(range(len(centre.time_offsets))) if free_clocks else ()
    names += [f"{centre.cameras[c].name}.time_offset" for c in clocks]
    prior += [CLOCK] * len(clocks)
    correlation, measured = np.eye(len(names)), np.zeros(len(names), bool)
    correlation[seen, seen], measured[seen] = known.correlation, known.measured
    return Parameters(
        rows=tuple(rows),
        columns=table.columns,
        leds=len(session.leds),
        cameras=tuple(moving),
        leader=tuple(frames.leader.tolist()) if centre.cameras else (),
        lenses=tuple(lenses),
        lens_sizes=tuple(len(centre.cameras[c].parameters) for c in lenses),
        clocks=clocks,
        names=tuple(names),
        active=frozen(np.ones(len(names)), bool),
        prior=frozen(prior),
        correlation=frozen(correlation),
        measured=frozen(measured, bool),
        centre=_as_given(session, centre),
        distances=tuple(
            (session.led_names.index(d.leds[0]), session.led_names.index(d.leds[1]), d.distance, d.sigma)
            for d in session.led_distances
        ),
        zeros=frozenset(k for k, row in enumerate(rows) if row in zeros),
        reasons={},
    ).holding(held)


def _as_given(session: Session, state: State) -> State:
    """The state with everything that the session gives as given, and an arm as drawn."""
    leds = [at if led.position is None else led.position for led, at in zip(session.leds, state.leds, strict=True)]
    clocks = np.zeros_like(state.time_offsets)
    given = replace(state, offsets=np.zeros_like(state.offsets), leds=np.array(leds), time_offsets=clocks)
    if not state.cameras or session.rig is None:
        return given
    places = [at if T is None else T for T, at in zip(session.frames.T_cam_frame, state.T_cam_world, strict=True)]
    return replace(given, cameras=session.rig.cameras, T_cam_world=np.array(places))


def _by_leader(T: Floats, c: int, leader: int) -> Floats:
    """A camera's place by the one that leads it; a leader's own in the frame that it is fixed in."""
    result: Floats = T[c] if c == leader else T[c] @ inverse(T[leader])
    return result


def _tolerance(tolerances: Tolerances, joint: str, name: str, *, zero: bool) -> float:
    by_kind = tolerances.length if name in ("d", "a", "x", "y", "z") else tolerances.angle
    default = tolerances.zero if zero else by_kind
    return tolerances.joints.get(joint, {}).get(name, default)


def _led_sigma(led: Led) -> float:
    if led.position is None:
        return np.inf
    return LED_TOLERANCE if led.sigma is None else led.sigma
