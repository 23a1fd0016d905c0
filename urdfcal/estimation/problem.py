"""The estimation problem: an arm, joint models, and measurements that follow from them (METHOD 7)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.joint_models import Readings, joint_models_of
from urdfcal.estimation.links import Links
from urdfcal.estimation.measurements import Measurement
from urdfcal.estimation.observations import arrange
from urdfcal.robot.flexure import spread_placements, spread_twists
from urdfcal.robot.kinematics import link_poses
from urdfcal.session.bending import bent

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.estimation.joint_models import JointModel
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.state import State
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.attachments import Attachments
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class Problem:
    """What is estimated, and from which measurements; predicts them from a state.

    Attributes:
        arm: the parameters of the arm's geometry.
        mechanism: its joints, and flexures where links may bend: what joint values and measurements go by.
        joint_models: between joint readings and true joint values.
        attachments: what LEDs and cameras are attached to.
        readings: of the joints at all poses of the session.
        observations: the measurements, one for each kind.
        joint_sigma: standard deviation of the joint readings. [rad or m]
    """

    arm: ArmParameterization
    mechanism: Mechanism
    joint_models: tuple[JointModel, ...]
    attachments: Attachments
    readings: Readings
    observations: tuple[Observations, ...]
    joint_sigma: float

    @classmethod
    def of(cls, session: Session, arm: ArmParameterization, tables: Iterable[Measurement] | None = None) -> Problem:
        """Take a session's measurements, or other tables of its poses."""
        if tables is None:
            tables = (table for table in session.measurements if isinstance(table, Measurement))
        session = bent(session)
        return cls(
            arm,
            session.chain,
            joint_models_of(session),
            session.attachments,
            Readings.of(session),
            tuple(arrange(session, table) for table in tables),
            session.noise.reading,
        )

    def with_observations(self, observations: Sequence[Observations]) -> Problem:
        """Return the same with other measurements."""
        return replace(self, observations=tuple(observations))

    def spread(self, most: int) -> Problem:
        """Return the same with an even selection of poses, at most so many for each combination of LED and camera."""
        return self.with_observations([observed.at(observed.spread(most)) for observed in self.observations])

    @property
    def poses(self) -> Ints:
        """Indices of the session's poses that have measurements, in ascending order."""
        return np.unique(np.concatenate([observed.pose for observed in self.observations]))

    def offsets(self, state: State) -> Floats:
        """Return the arm's offsets (rows, columns), with what it can hold of the joint models. [rad, m]."""
        parts = [model.offsets(self.arm, state[model.key]) for model in self.joint_models if model.key in state]
        return sum(parts, start=state[ARM])

    def placements(self, state: State) -> Floats:
        """Return the placements (n, 4, 4) of the mechanism's joints, flexures included. [m]."""
        return spread_placements(self.mechanism, self.arm.placements(state[ARM]))

    def twists(self, offsets: Floats, parameters: Iterable[tuple[int, str]]) -> Floats:
        """Return the body twists (6 n, p) of these placements for parameters of the arm."""
        return spread_twists(self.mechanism, self.arm.twists(offsets, parameters))

    def told(self, q: Floats) -> Floats:
        """Return values (N, n) of the mechanism's joints, flexures at zero, from those of the arm's. [rad or m]."""
        return self.mechanism.joint_values(self.arm.chain.readings(q))

    def joint_values(self, readings: Readings, state: State) -> Floats:
        """Return the joints' true values (N, n): the readings, and what the joint models add. [rad or m]."""
        q = readings.q
        for model in self.joint_models:
            if model.key in state and np.any(state[model.key]):
                q = q + model.values(readings, state[model.key])
        return q

    def links(self, readings: Readings, state: State) -> Links:
        """Return where the frames of LEDs, targets and cameras are."""
        q, tips = self.joint_values(readings, state), self.attachments.tips
        T = link_poses(self.mechanism, q, tips, self.placements(state))
        R, p = [of[:, :3, :3] for of in T], [of[:, :3, 3] for of in T]
        return Links.of(self.attachments, state, readings.part, R, p)

    def predict(self, observed: Observations, state: State) -> Floats:
        """Return what should be measured (N, m, D); NaN where it is impossible, as behind a camera."""
        one = observed.by_slot
        predicted: Floats = one.table.predict(one, self.links(one.readings, state), state)
        return predicted.reshape(observed.value.shape)

    def residual(self, observed: Observations, state: State) -> Floats:
        """Return predicted minus measured (N, m, D), zero for padding. [unit of the table]."""
        return np.where(observed.valid[..., None], self.predict(observed, state) - observed.value, 0.0)

    def metres_per_unit(self, observed: Observations, state: State) -> Floats:
        """Return what one unit of residual is worth at the LED, (N, m). [m]."""
        one = observed.by_slot
        return one.table.metres_per_unit(one, self.links(one.readings, state), state).reshape(observed.row.shape)

    def off(self, observed: Observations, state: State, residual: Floats | None = None) -> Floats:
        """Return how far what was measured is off (N, m), for pixels across the ray; turns do not count. [m].

        Args:
            observed: what was measured.
            state: where.
            residual: (N, m, D) what :meth:`residual` gives there, where that is known already.
        """
        residual = self.residual(observed, state) if residual is None else residual
        lengths = np.linalg.norm(residual[..., observed.table.lengths], axis=-1)
        result: Floats = lengths * self.metres_per_unit(observed, state)
        return result

    def seen(self, observed: Observations, state: State) -> Floats:
        """Return what was measured as numbers (N, m, D) that residuals add to; of what was touched, where that is."""
        table, residual = observed.table, self.residual(observed, state)[..., observed.table.lengths]
        at = table.points(observed, self.links(observed.readings, state), state)
        if table.compared is table.values or at is None or residual.shape[-1] != 3:
            return observed.value[..., table.lengths]
        return at[1] - residual

    def suspect(self, observed: Observations, outlier: Sequence[Bools]) -> Bools:
        """Return which slots (N, m) concern an LED at a pose where a measurement of it is an outlier."""
        last = max(int(of.pose.max()) for of in (observed, *self.observations))
        marked = np.zeros((1 + last, len(self.attachments.led)), dtype=bool)
        for of, cut in zip(self.observations, outlier, strict=True):
            if "led" in of.index:
                marked[np.broadcast_to(of.pose[:, None], cut.shape)[cut], of.index["led"][cut]] = True
        suspect: Bools = marked[observed.pose[:, None], observed.index["led"]]
        return suspect
