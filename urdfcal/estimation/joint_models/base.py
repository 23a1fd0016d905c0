"""The interface of a joint model: what stands between a joint reading and the joint's true value."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.blocks.base import VectorBlock
from urdfcal.session.bending import bent
from urdfcal.session.knowledge import AUTO

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from typing_extensions import Self

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.blocks.arm import ArmParameterization
    from urdfcal.session.knowledge import JointModelSaid
    from urdfcal.session.model import Positions
    from urdfcal.session.trajectory import Motion


@dataclass(frozen=True, eq=False)
class Readings:
    """Joint readings at the poses of some measurements, and what else a joint model may depend on.

    Attributes:
        q: (N, n) readings of all joints of the mechanism, mimic joints included. [rad or m]
        pose: (N,) index of each pose in the session.
        motion: of the arm at these poses: at rest, or moving while it is filmed.
        part: (N,) of the session that each pose belongs to.
        torques: (N, n) measured joint torques, None where there are none. [N m or N]
        previous: (N, n) readings where the arm came from, None where that is not known. [rad or m]
    """

    q: Floats
    pose: Ints
    motion: Motion
    part: Ints
    torques: Floats | None = None
    previous: Floats | None = None
    _known: dict[str, Floats] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, session: Positions) -> Readings:
        """Take all poses of a session; flexures of links that may bend are at zero."""
        session = bent(session)
        poses = np.arange(len(session.poses))
        return cls(session.q, poses, session.motion, session.part, session.torques, session.came_from)

    @cached_property
    def unit(self) -> Ints:
        """The configuration, or second of a moving arm, (N,) that each pose belongs to: errors within one are alike."""
        return self.motion.independent(self.q)

    def at(self, poses: slice | Bools | Ints) -> Readings:
        """Return the readings of some of the poses."""
        torques, previous = (None if of is None else of[poses] for of in (self.torques, self.previous))
        motion = self.motion.at(np.arange(len(self.q))[poses])
        some = Readings(self.q[poses], self.pose[poses], motion, self.part[poses], torques, previous)
        some._known.update({key: values[poses] for key, values in self._known.items()})
        return some

    def once(self, key: str, compute: Callable[[Readings], Floats]) -> Floats:
        """Return what depends on the readings alone, (N, ...), computed when it is first asked for."""
        if key not in self._known:
            self._known[key] = compute(self)
        return self._known[key]


def forced_on(said: JointModelSaid) -> bool:
    """Return whether a session switches a joint model on, for one joint at least."""
    return True in (said.values() if isinstance(said, Mapping) else [said])


@dataclass(frozen=True)
class Term:
    """A joint model of some joints, chosen because the measurements speak for it.

    Attributes:
        model: its name.
        joints: names of the joints.
        scale: of its priors' standard deviations.
        group: of each joint's parameters; None for all of them.
    """

    model: str
    joints: tuple[str, ...]
    scale: float = 1.0
    group: str | None = None


class JointModel(VectorBlock):
    """A correction of joint readings: q_true = q_read + sum of the models' values (METHOD 7).

    A model is a block: its parameters are estimated like all others. Register the class in
    ``urdfcal.estimation.joint_models``.
    """

    name: ClassVar[str]
    needs: ClassVar[str] = "joints that turn, of an arm that stood still in every pose"
    """What it takes to apply to a session, in words."""

    @classmethod
    @abstractmethod
    def of(cls, session: Positions) -> Self | None:
        """Return the model with its prior for a session; None where it does not apply."""

    @classmethod
    def enabled(cls, session: Positions, geometry: str) -> bool:
        """Return whether it is estimated where nothing is said of it, with a geometry (dh, offsets, full or none).

        By default it is not.
        """
        del session, geometry
        return False

    @classmethod
    def estimated(cls, session: Positions, geometry: str) -> bool:
        """Return whether its parameters are estimated: the session's ``joint_models`` overrule :meth:`enabled`.

        One that is switched on takes part where the arm does, which is not in the nominal one's fit.
        """
        said = session.joint_models.get(cls.name, AUTO)
        usual = cls.enabled(session, geometry)
        return usual if said == AUTO else bool(said) and (usual or geometry != "none")

    def block(self, session: Positions, geometry: str, terms: Sequence[Term]) -> Self | None:
        """Return the block as it is estimated; None where it is not.

        Args:
            session: what it says of the model.
            geometry: of the arm.
            terms: of this model, chosen beside what the session says.
        """
        del terms
        return self if self.estimated(session, geometry) else None

    @abstractmethod
    def values(self, readings: Readings, p: Floats) -> Floats:
        """Return what the model adds (N, n) to the joint readings. [rad or m].

        Args:
            readings: N of them.
            p: its parameters, of the nominal value's shape.
        """

    @abstractmethod
    def jacobian(self, readings: Readings, p: Floats) -> Floats:
        """Return the derivative (N, n, k) of :meth:`values` by the k parameters; it may be broadcast over N."""

    def offsets(self, arm: ArmParameterization, p: Floats) -> Floats:
        """Return as much of the model as offsets (rows, columns) of the arm can hold; by default nothing. [rad, m]."""
        del p
        return no_offsets(arm)
