"""The parameters of an estimate: which there are, their names, units, priors, and their packing into a vector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.estimation.state import State
from urdfcal.robot.dh import PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.robot.dh import DHRow, DHTable, Parameter
    from urdfcal.session.model import Session, Tolerances

Geometry = Literal["dh", "offsets", "none"]

LED_TOLERANCE = 0.02
"""Standard deviation of an LED position given without one: a hand-held ruler on a gripper. [m]"""

_POSE_AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class Parameters:
    """The packing of the estimated part of a ``State`` into one vector.

    The full vector holds the DH offsets, the base pose, the LEDs, the camera poses, the lenses; ``active``
    says which of its entries are estimated, the others keep their value.

    Attributes:
        rows: (row index, parameter) of each DH offset.
        leds: number of LEDs, three coordinates each.
        cameras: indices of the cameras whose pose is a parameter.
        lenses: indices of the cameras whose intrinsics are parameters.
        lens_sizes: number of intrinsics of each of them.
        names: of every entry of the full vector.
        active: (P,) bool.
        prior: (P,) standard deviation about the centre; inf where there is no prior. [unit of the entry]
        centre: the state the priors are centred at.
        reasons: why an entry is not active.
    """

    rows: tuple[tuple[int, Parameter], ...]
    leds: int
    cameras: tuple[int, ...]
    lenses: tuple[int, ...]
    lens_sizes: tuple[int, ...]
    names: tuple[str, ...]
    active: Bools
    prior: Floats
    centre: State
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
        first = self.base.stop + 3 * self.leds + 6 * len(self.cameras) + sum(self.lens_sizes[:position])
        return slice(first, first + self.lens_sizes[position])

    def holding(self, held: Mapping[int, str]) -> Parameters:
        """The same packing with more entries held at their value, each for a reason."""
        active = np.array(self.active)
        active[list(held)] = False
        return replace(self, active=frozen(active, bool), reasons={**self.reasons, **held})

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
            offsets[row, PARAMETERS.index(name)] += value
        leds = state.leds + full[self.base.stop : self.base.stop + 3 * self.leds].reshape(-1, 3)
        T_cam_world = np.array(state.T_cam_world)
        for position, c in enumerate(self.cameras):
            T_cam_world[c] = pin.exp6(full[self.camera(position)]).homogeneous @ T_cam_world[c]
        cameras = list(state.cameras)
        for position, c in enumerate(self.lenses):
            cameras[c] = cameras[c].with_parameters(cameras[c].parameters + full[self.lens(position)])
        return State(
            offsets=offsets,
            T_world_base=state.T_world_base @ pin.exp6(full[self.base]).homogeneous,
            leds=leds,
            cameras=tuple(cameras),
            T_cam_world=T_cam_world,
        )

    def prior_residuals(self, state: State) -> tuple[Floats, Floats]:
        """Deviation from the priors' centre in standard deviations, and its derivative.

        Returns:
            r (p,) and J (p, count), a row for every active entry with a prior.
        """
        full = np.zeros(self.size)
        for i, (row, name) in enumerate(self.rows):
            full[i] = state.offsets[row, PARAMETERS.index(name)] - self.centre.offsets[row, PARAMETERS.index(name)]
        full[self.base.stop : self.base.stop + 3 * self.leds] = (state.leds - self.centre.leds).ravel()
        blocks: list[tuple[slice, Floats]] = []
        for position, c in enumerate(self.cameras):
            difference = pin.SE3(state.T_cam_world[c]) * pin.SE3(self.centre.T_cam_world[c]).inverse()
            full[self.camera(position)] = pin.log6(difference).vector
            # exp6(step) stands to the left: log6(exp6(s) D) moves by Jlog6(D) Ad(D^-1) s.
            blocks.append((self.camera(position), pin.Jlog6(difference) @ difference.inverse().action))
        for position, c in enumerate(self.lenses):
            full[self.lens(position)] = state.cameras[c].parameters - self.centre.cameras[c].parameters
        J = np.eye(self.size)
        for where, block in blocks:
            J[where, where] = block
        used = self.active & np.isfinite(self.prior)
        J = (J / self.prior[:, None])[used][:, self.active]
        return full[used] / self.prior[used], J


def choose_parameters(
    session: Session,
    table: DHTable,
    centre: State,
    *,
    geometry: Geometry,
    extrinsics: Sequence[int] = (),
    lenses: Sequence[int] = (),
    priors: bool = True,
) -> Parameters:
    """List the parameters of an estimate, with the session's tolerances as priors.

    Args:
        session: names, LED knowledge and tolerances.
        table: the nominal rows; each row's free parameters are candidates (the last row's joint variable only).
        centre: nominal values, where the priors are centred.
        geometry: ``dh`` for the rows' free parameters, ``offsets`` for the joints' zeros, ``none`` for neither.
        extrinsics: cameras whose pose is free.
        lenses: cameras whose intrinsics are free.
        priors: whether manufacturing tolerances act as priors; how well an LED's place was measured always does.
    """
    rows: list[tuple[int, Parameter]] = []
    names: list[str] = []
    prior: list[float] = []
    held: dict[int, str] = {}
    for i, row in enumerate(table.rows):
        by_geometry: dict[Geometry, tuple[Parameter, ...]] = {
            "dh": row.free,
            "offsets": (row.variable,),
            "none": (),
        }
        for name in by_geometry[geometry]:
            if i == len(table.rows) - 1 and name != row.variable:
                continue
            tolerance = _tolerance(session.tolerances, row, name)
            if tolerance == 0.0:
                held[len(rows)] = "fixed by the session's tolerances"
            rows.append((i, name))
            names.append(f"{row.joint}.{name}")
            prior.append(tolerance if priors and tolerance > 0.0 else np.inf)
    names += [f"T_world_base.{axis}" for axis in _POSE_AXES]
    prior += [np.inf] * 6
    for led in session.leds:
        known = led.position is not None
        sigma = (LED_TOLERANCE if led.sigma is None else led.sigma) if known else np.inf
        for axis in "xyz":
            if sigma == 0.0:
                held[len(names)] = "its position is given as exact"
            names.append(f"{led.name}.{axis}")
            prior.append(sigma if sigma > 0.0 else np.inf)
    for c in extrinsics:
        names += [f"{centre.cameras[c].name}.{axis}" for axis in _POSE_AXES]
        prior += [np.inf] * 6
    for c in lenses:
        camera = centre.cameras[c]
        names += [f"{camera.name}.{name}" for name in camera.parameter_names]
        prior += [np.inf] * len(camera.parameters)
    return Parameters(
        rows=tuple(rows),
        leds=len(session.leds),
        cameras=tuple(extrinsics),
        lenses=tuple(lenses),
        lens_sizes=tuple(len(centre.cameras[c].parameters) for c in lenses),
        names=tuple(names),
        active=frozen(np.ones(len(names)), bool),
        prior=frozen(prior),
        centre=centre,
        reasons={},
    ).holding(held)


def _tolerance(tolerances: Tolerances, row: DHRow, name: Parameter) -> float:
    by_kind = tolerances.length if name in ("d", "a") else tolerances.angle
    default = tolerances.zero if name == row.variable else by_kind
    return tolerances.joints.get(row.joint, {}).get(name, default)
