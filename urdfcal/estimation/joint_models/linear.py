"""Joint models that are sums of known features of the reading, each times an unknown parameter of one joint."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import numpy as np

from urdfcal.estimation.joint_models.base import JointModel, forced_on
from urdfcal.estimation.state import Key
from urdfcal.session.knowledge import AUTO
from urdfcal.session.trajectory import Trajectory

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from typing_extensions import Self

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.joint_models.base import Readings, Term
    from urdfcal.robot.gravity import Masses
    from urdfcal.robot.mechanism import Joint, Mechanism
    from urdfcal.session.model import Positions


class Setting(NamedTuple):
    """What an arm whose joint models are known is under.

    Attributes:
        gravity: (3,) in the base link's frame. [m/s^2]
        masses: that the joints carry in each part of a session; none where torques are measured, or nobody knows.
    """

    gravity: Floats
    masses: tuple[Masses, ...]


# More joints than these are called the joints.
_NAMED = 2


class Prior(NamedTuple):
    """What is known of a parameter beforehand.

    Attributes:
        unit: of it.
        sigma: standard deviation about 0. [unit]
        scale: what moves a joint by about 1 rad or 1 m. [unit]
    """

    unit: str
    sigma: float
    scale: float = 1.0


class OneCommand(Protocol):
    """A joint model with its parameters, for one pose at a time."""

    def values(self, readings: Readings) -> Floats:
        """Return what it adds (n,) to the readings of one pose. [rad or m]."""

    def slopes(self, readings: Readings) -> Floats:
        """Return the derivative (n, n) of :meth:`values` by all joints' readings."""


@dataclass(frozen=True, eq=False)
class LinearJointModel(JointModel):
    """A joint model whose value is linear in its parameters: the same few for every joint that has a reading.

    Attributes:
        mechanism: the joints.
        joints: (k,) index of the joint that each parameter belongs to, among those that have a reading.
        words: what a joint's parameters are called beside the model's name.
        groups: what residuals are tested for of a joint, each with the places of its parameters among the joint's.
        over: what its one feature is, and its unit for a turning and a sliding joint; None where it depends on the
            reading alone.
        revolute: unit and prior of a turning joint's parameters; None where it has none.
        prismatic: the same of a sliding joint.
        together: whether the joints have it or have it not together, and not each on its own.
        certain: what the logarithm of the evidence must gain that it is chosen although left-out regions do not bear it
            out.
        at_rest: whether it concerns an arm that stands still in every pose alone.
    """

    mechanism: Mechanism = field(kw_only=True)
    joints: tuple[int, ...] = field(kw_only=True)

    words: ClassVar[tuple[str, ...]] = ("",)
    groups: ClassVar[Mapping[str, tuple[int, ...]]]
    over: ClassVar[tuple[str, str, str] | None] = None
    revolute: ClassVar[Prior | None] = None
    prismatic: ClassVar[Prior | None] = None
    together: ClassVar[bool] = False
    certain: ClassVar[float] = np.inf
    order: ClassVar[int] = -1
    at_rest: ClassVar[bool] = False

    @classmethod
    def key_of(cls) -> Key[Floats]:
        """Return the key of its parameters (k,)."""
        return Key(cls.name)

    @classmethod
    def of(cls, session: Positions) -> Self | None:
        """Take every joint that has a reading and that the model concerns."""
        more = None if cls.at_rest and isinstance(session.motion, Trajectory) else cls.depends_on(session)
        concerned = [j.name for j in session.chain.actuated_joints if cls.prior(j) and cls.concerns(session, j)]
        return None if more is None or not concerned else cls.build(session.chain, concerned, more)

    @classmethod
    def build(cls, mechanism: Mechanism, concerned: Sequence[str], more: Mapping[str, Any]) -> Self:
        """Return the model of some joints, with its further fields."""
        joints = mechanism.actuated_joints
        each = [
            (j, word, prior)
            for j, joint in enumerate(joints)
            if joint.name in concerned and (prior := cls.prior(joint)) is not None
            for word in cls.words
        ]
        return cls(
            key=cls.key_of(),
            names=tuple(".".join(filter(None, (joints[j].name, cls.name, word))) for j, word, _ in each),
            units=tuple(prior.unit for _, _, prior in each),
            nominal=np.zeros(len(each)),
            sigma=np.array([prior.sigma for _, _, prior in each]),
            phrase="",
            mechanism=mechanism,
            joints=tuple(j for j, _, _ in each),
            **more,
        )

    @classmethod
    def prior(cls, joint: Joint) -> Prior | None:
        """Return what is known of the parameters of a joint; None where it has none."""
        return cls.prismatic if joint.prismatic else cls.revolute

    @classmethod
    def concerns(cls, session: Positions, joint: Joint) -> bool:
        """Return whether a joint of a session may have it."""
        del session, joint
        return True

    @classmethod
    def depends_on(cls, session: Positions) -> dict[str, Any] | None:
        """Return further fields, from a session; None where the model does not apply to it."""
        del session
        return {}

    @classmethod
    def again(cls, setting: Setting, inputs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Return further fields of a model that was found: what :meth:`depends_on` gave when it was.

        Args:
            setting: what the arm carries, and gravity.
            inputs: of each of its joints, from :meth:`inputs`.
        """
        del setting, inputs
        return {}

    def inputs(self, columns: Bools) -> dict[str, Any]:
        """Return what is to be kept, as JSON, of the further fields of a joint's parameters (k,)."""
        del columns
        return {}

    @abstractmethod
    def features(self, readings: Readings) -> Floats:
        """Return what the parameters are multiplied with, (N, k)."""

    @abstractmethod
    def slopes(self, readings: Readings) -> Floats:
        """Return the derivative (N, k, n) of :meth:`features` by all joints' readings; it may be broadcast over N."""

    @abstractmethod
    def sentence(self, joint: Joint, group: str, p: Floats) -> str:
        """Say what a group of the parameters of a joint means."""

    def sentence_of_all(self, joints: str, most: float) -> str:
        """Say what the parameters of some joints mean together, that err by so much at most. [mrad]."""
        return f"{self.name} of {joints}, by up to {most:.2g} mrad"

    def summary(self, readings: Readings, p: Floats, sigma: Floats) -> str:
        """Say what the parameters, with their standard deviations, mean together at some readings."""
        del sigma
        on = list(dict.fromkeys(np.array(self.names_of_joints)[p != 0.0].tolist()))
        joints = " and ".join(on) if len(on) <= _NAMED else "the joints"
        return self.sentence_of_all(joints, 1e3 * float(np.abs(self.values(readings, p)).max()))

    def shows(self, joint: Joint, q: Floats) -> bool:
        """Return whether a joint's values (N,) are such that residuals can show it."""
        del joint, q
        return True

    def scale(self, value: Floats) -> Floats:
        """Return what moves a joint by about 1 rad or 1 m, (k,)."""
        del value
        priors = [self.prior(self.mechanism.actuated_joints[j]) for j in self.joints]
        return np.array([prior.scale for prior in priors if prior is not None])

    def values(self, readings: Readings, p: Floats) -> Floats:
        """Return the sum of the features; mimic joints follow their master."""
        result: Floats = (self.known_features(readings) * p) @ self._carry.T
        return result

    def jacobian(self, readings: Readings, p: Floats) -> Floats:
        """Return the features in the rows of the joints that they move."""
        del p
        result: Floats = self._carry * self.known_features(readings)[:, None, :]
        return result

    def derivative(self, readings: Readings, p: Floats) -> Floats:
        """Return the derivative (N, n, n) of :meth:`values` by all joints' readings; it may be broadcast over N."""
        result: Floats = self._carry @ (p[:, None] * self.slopes(readings))
        return result

    def of_one(self, p: Floats) -> OneCommand:
        """Return the model with its parameters, for one pose at a time."""
        return _OfOne(self, p)

    def known_features(self, readings: Readings) -> Floats:
        """Return :meth:`features`, computed once."""
        return readings.once(self.name, self.features)

    @cached_property
    def _carry(self) -> Floats:
        """(n, k) derivative of all joints' values by the readings that the parameters add to."""
        return self.mechanism.reading_jacobian[:, self.joints]

    @cached_property
    def selection(self) -> Floats:
        """(k, n) derivative of :meth:`read`."""
        selected: Floats = self.read(np.eye(len(self.mechanism.joints))).T
        return selected

    @cached_property
    def names_of_joints(self) -> tuple[str, ...]:
        """(k,) name of the joint that each parameter belongs to."""
        return tuple(self.mechanism.actuated[j] for j in self.joints)

    @cached_property
    def groups_of(self) -> tuple[str, ...]:
        """(k,) name of the group that each parameter belongs to."""
        each = {place: name for name, places in self.groups.items() for place in places}
        return tuple(each[k % len(self.words)] for k in range(len(self)))

    def of_joints(self, names: Sequence[str]) -> Bools:
        """Return which parameters (k,) belong to some joints."""
        return np.isin(self.names_of_joints, list(names))

    def of_term(self, term: Term) -> Bools:
        """Return which parameters (k,) a term has."""
        own = np.array([term.group in (None, group) for group in self.groups_of])
        return self.of_joints(term.joints) & own if term.model == self.name else np.zeros(len(self), dtype=bool)

    def read(self, values: Floats) -> Floats:
        """Select the values (N, k) of the parameters' joints from those of all joints (N, n)."""
        return self.mechanism.readings(values)[:, self.joints]

    def said(self, session: Positions) -> dict[str, bool]:
        """Return whether the session switches the model on, by the joint's name; none of those it is silent of."""
        said: Any = session.joint_models.get(self.name, AUTO)
        each = dict.fromkeys(self.names_of_joints, said) if isinstance(said, str | bool) else dict(said)
        return {joint: bool(on) for joint, on in each.items() if on != AUTO}

    def block(self, session: Positions, geometry: str, terms: Sequence[Term]) -> Self | None:
        """Return the block with the joints that are forced or chosen, on all but the nominal arm."""
        forced = self.of_joints([joint for joint, on in self.said(session).items() if on])
        on, scale = forced.copy(), np.ones(len(self))
        for term in terms:
            mine = self.of_term(term)
            on[mine], scale[mine] = True, term.scale
        if geometry == "none" or not on.any():
            return None
        off = dict.fromkeys(np.flatnonzero(~on).tolist(), f"without {self.name}")
        return replace(self, sigma=self.sigma * scale, fixed={**self.fixed, **off})

    @classmethod
    def estimated(cls, session: Positions, geometry: str) -> bool:
        """Return whether the session switches it on for a joint."""
        return geometry != "none" and forced_on(session.joint_models.get(cls.name, AUTO))

    def document(self, value: Floats, sigma: Floats) -> tuple[dict[str, Any], ...]:
        """Return entries of the joints that have it."""
        on = self.active
        return tuple(entry for entry, of in zip(super().document(value, sigma), on, strict=True) if of)


@dataclass(frozen=True, eq=False)
class _OfOne:
    model: LinearJointModel
    p: Floats

    def values(self, readings: Readings) -> Floats:
        result: Floats = self.model.values(readings, self.p)[0]
        return result

    def slopes(self, readings: Readings) -> Floats:
        derivative = self.model.derivative(readings, self.p)
        return derivative.reshape(derivative.shape[-2:])
