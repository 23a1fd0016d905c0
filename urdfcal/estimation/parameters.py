"""The parameters of an estimate: which there are, their names, units, priors, and their packing into a vector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.estimation.state import State

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from urdfcal.estimation.freedoms import Freedoms
    from urdfcal.robot.chain import Chain
    from urdfcal.session.model import Freedom, Led, Session, Tolerances
    from urdfcal.vision.rig import Rig

LED_TOLERANCE = 0.02
"""Standard deviation of an LED position given without one: a hand-held ruler on a gripper. [m]"""

FREE_LENS = (0.2, 0.3, 1.0, 0.1)
"""Standard deviations of a free lens: focal length (share of it), principal point (share of the longer image side),
radial and decentring coefficients. Next to no prior: it spans any real lens and keeps k3 from running off where
sightings leave the picture's corners empty; the principal points of ../shared/data/motoman_right are a quarter of the
image off."""

REFINED_LENS = (0.005, 0.005, 0.02, 0.001)
"""The same for a lens to be refined whose calibration gave no standard deviations: a careful board calibration."""

REFINED_POSE = (0.002, 0.002, 0.002, 0.002, 0.002, 0.002)
"""Standard deviations of a camera pose to be refined that was calibrated without any. [m, rad]"""

CLOCK = 1.0
"""Standard deviation of a camera's time offset: driver and transport delay a frame by 10 to 100 ms, clocks that are set
by hand or seldom differ by a second; a moving arm tells it to a fraction of a millisecond whatever is believed. [s]"""

_POSE_AXES = ("x", "y", "z", "rx", "ry", "rz")


class Geometry(Protocol):
    """The arm's parameters: DH rows, or whole placements."""

    @property
    def chain(self) -> Chain:
        """The arm as drawn."""

    @property
    def columns(self) -> tuple[str, ...]:
        """What each column of an offsets array adds to."""

    @property
    def parameters(self) -> tuple[tuple[int, str], ...]:
        """(joint index, column name) of every parameter."""

    @property
    def zeros(self) -> tuple[tuple[int, str], ...]:
        """Those of them that are joints' zero offsets."""

    def placements(self, offsets: Floats) -> Floats:
        """Joint placements (n, 4, 4) under offsets (n, columns)."""

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
        cameras: indices of the cameras whose pose is a parameter.
        lenses: indices of the cameras whose intrinsics are parameters.
        lens_sizes: number of intrinsics of each of them.
        clocks: indices of the cameras whose time offset is a parameter.
        names: of every entry of the full vector.
        active: (P,) bool.
        prior: (P,) standard deviation about the centre; inf where there is no prior. [unit of the entry]
        centre: the state the priors are centred at.
        distances: (LED, LED, distance, standard deviation) of each measured LED distance. [m]
        zeros: indices of the joints' zero offsets.
        reasons: why an entry is not active.
    """

    rows: tuple[tuple[int, str], ...]
    columns: tuple[str, ...]
    leds: int
    cameras: tuple[int, ...]
    lenses: tuple[int, ...]
    lens_sizes: tuple[int, ...]
    clocks: tuple[int, ...]
    names: tuple[str, ...]
    active: Bools
    prior: Floats
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
            T_cam_world[c] = pin.exp6(full[self.camera(position)]).homogeneous @ T_cam_world[c]
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

    def prior_residuals(self, state: State) -> tuple[Floats, Floats]:
        """Deviation from the priors' centre in standard deviations, and its derivative.

        Returns:
            r (p,) and J (p, count), a row for every active entry with a prior and for every LED distance.
        """
        full = np.zeros(self.size)
        for i, (row, name) in enumerate(self.rows):
            full[i] = state.offsets[row, self.columns.index(name)] - self.centre.offsets[row, self.columns.index(name)]
        full[self.base.stop : self.base.stop + 3 * self.leds] = (state.leds - self.centre.leds).ravel()
        blocks: list[tuple[slice, Floats]] = []
        for position, c in enumerate(self.cameras):
            difference = pin.SE3(state.T_cam_world[c]) * pin.SE3(self.centre.T_cam_world[c]).inverse()
            full[self.camera(position)] = pin.log6(difference).vector
            # exp6(step) stands to the left: log6(exp6(s) D) moves by Jlog6(D) Ad(D^-1) s.
            blocks.append((self.camera(position), pin.Jlog6(difference) @ difference.inverse().action))
        for position, c in enumerate(self.lenses):
            full[self.lens(position)] = state.cameras[c].parameters - self.centre.cameras[c].parameters
        clocks = list(self.clocks)
        full[self._clock_block] = state.time_offsets[clocks] - self.centre.time_offsets[clocks]
        J = np.eye(self.size)
        for where, block in blocks:
            J[where, where] = block
        used = self.active & np.isfinite(self.prior)
        r, J = full[used] / self.prior[used], (J / self.prior[:, None])[used]
        distances, J_distances = self.distance_residuals(state)
        return np.concatenate([r, distances]), np.vstack([J, J_distances])[:, self.active]

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
        joint = table.chain.joints[i].name
        tolerance = _tolerance(session.tolerances, joint, name, zero=(i, name) in zeros)
        if tolerance == 0.0:
            held[len(rows)] = "fixed by the session's tolerances"
        rows.append((i, name))
        names.append(f"{joint}.{name}")
        prior.append(tolerance if freedoms.priors and tolerance > 0.0 else np.inf)
    names += [f"T_world_base.{axis}" for axis in _POSE_AXES]
    prior += [np.inf] * 6
    for led in session.leds:
        sigma = _led_sigma(led)
        for axis in "xyz":
            if sigma == 0.0:
                held[len(names)] = "its position is given as exact"
            names.append(f"{led.name}.{axis}")
            prior.append(sigma if freedoms.priors and sigma > 0.0 else np.inf)
    moving = [c for c, freedom in enumerate(freedoms.extrinsics) if c and freedom != "fixed"]
    for c in moving:
        names += [f"{centre.cameras[c].name}.{axis}" for axis in _POSE_AXES]
        prior += [np.inf] * 6 if freedoms.extrinsics[c] == "free" else list(_pose_sigma(session.rig, c))
    lenses = [c for c, freedom in enumerate(freedoms.intrinsics) if freedom != "fixed"]
    for c in lenses:
        camera = centre.cameras[c]
        names += [f"{camera.name}.{name}" for name in camera.parameter_names]
        prior += list(_lens_sigma(session.rig, c, freedoms.intrinsics[c]))
    free_clocks = session.estimate.time_offset != "fixed"
    clocks = tuple(range(len(centre.time_offsets))) if free_clocks else ()
    names += [f"{centre.cameras[c].name}.time_offset" for c in clocks]
    prior += [CLOCK] * len(clocks)
    return Parameters(
        rows=tuple(rows),
        columns=table.columns,
        leds=len(session.leds),
        cameras=tuple(moving),
        lenses=tuple(lenses),
        lens_sizes=tuple(len(centre.cameras[c].parameters) for c in lenses),
        clocks=clocks,
        names=tuple(names),
        active=frozen(np.ones(len(names)), bool),
        prior=frozen(prior),
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
    rig = session.rig
    places = [at if T is None else T for T, at in zip(rig.T_cam_world, state.T_cam_world, strict=True)]
    return replace(given, cameras=rig.cameras, T_cam_world=np.array(places))


def _tolerance(tolerances: Tolerances, joint: str, name: str, *, zero: bool) -> float:
    by_kind = tolerances.length if name in ("d", "a", "x", "y", "z") else tolerances.angle
    default = tolerances.zero if zero else by_kind
    return tolerances.joints.get(joint, {}).get(name, default)


def _led_sigma(led: Led) -> float:
    if led.position is None:
        return np.inf
    return LED_TOLERANCE if led.sigma is None else led.sigma


def _pose_sigma(rig: Rig | None, c: int) -> Floats:
    known = rig.sigmas[c] if rig is not None else None
    return np.array(REFINED_POSE) if known is None or known.pose is None else known.pose


def _lens_sigma(rig: Rig | None, c: int, freedom: Freedom) -> Floats:
    if rig is None:
        raise ValueError("lenses without a rig")
    known, camera = rig.sigmas[c], rig.cameras[c]
    if freedom == "refine" and known is not None:
        return np.where(known.parameters > 0.0, known.parameters, np.inf)
    focal, centre, bend, decentring = FREE_LENS if freedom == "free" else REFINED_LENS
    f, width = camera.intrinsics[0], max(camera.resolution)
    by_name = {"fx": focal * f, "fy": focal * f, "cx": centre * width, "cy": centre * width}
    by_name |= {"p1": decentring, "p2": decentring}
    return np.array([by_name.get(name, bend) for name in camera.parameter_names])
