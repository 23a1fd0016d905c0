"""The interface of a measurement: predict it from where the links are, differentiate it, start its unknowns."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from urdfcal.session.measurements import Measurements

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from typing_extensions import Self

    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.estimation.blocks.base import Block
    from urdfcal.estimation.linearize import Jacobian
    from urdfcal.estimation.links import Links
    from urdfcal.estimation.model_spec import ModelSpec
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import Key, State
    from urdfcal.estimation.target_start import TargetViews
    from urdfcal.session.attachments import Attachments
    from urdfcal.session.model import Session


@dataclass(frozen=True, eq=False)
class BlockSet:
    """The blocks that a kind of measurement needs beside the arm, the base and the LEDs.

    Attributes:
        blocks: in the order of the parameter vector.
        correlation: (K, K) of the priors' errors over all their coordinates; None where they are independent.
        measured: (K,) whose prior is a measurement made beforehand and no tolerance; None where none is.
    """

    blocks: tuple[Block[Any], ...] = ()
    correlation: Floats | None = None
    measured: Bools | None = None


@dataclass(frozen=True, eq=False)
class WorldPoints:
    """LED positions in the world that are known before anything is estimated.

    Attributes:
        pose: (S,) of each.
        led: (S,) of each.
        xyz: (S, 3) positions. [m]
        complete: whether they are all there is of their measurements, and a few of them are enough to start from.
    """

    pose: Ints
    led: Ints
    xyz: Floats
    complete: bool = field(default=True, kw_only=True)


class Measurement(Measurements):
    """A kind of measurement, as a table and as a model of what it measures (METHOD 7).

    S measurements of D = ``dimension`` numbers each are arranged by pose as (N, m) ``Observations``. Register the
    class in ``urdfcal.estimation.measurements``.

    Attributes:
        own: of the keys that name things of unknown place, the block of these unknowns, as many for each thing.
    """

    own: ClassVar[Mapping[str, Key[Any]]] = {}

    @property
    def covariances(self) -> Floats:
        """Covariance (S, D, D) of each measurement: by default independent numbers of standard deviation sigma."""
        result: Floats = self.sigma[:, None, None] ** 2 * np.eye(self.dimension)
        return result

    @abstractmethod
    def predict(self, observed: Observations, links: Links, state: State) -> Floats:
        """Return what should be measured (N, m, D); anything where a slot is padding, NaN where it is impossible."""

    @abstractmethod
    def linearise(self, observed: Observations, links: Links, state: State, J: Jacobian) -> ByFrame:
        """Differentiate the prediction, and put the derivatives by the measurement's own unknowns into ``J``.

        Args:
            observed: N poses of m slots.
            links: where the frames of LEDs and cameras are.
            state: where to linearise.
            J: takes (K, D, k) derivatives of K = N m slots by the k coordinates of a block.

        Returns:
            The prediction (N, m, D), and its derivative by a small motion of each frame.
        """

    def metres_per_unit(self, observed: Observations, links: Links, state: State) -> Floats:
        """Return what one unit of residual is worth at the LED, (N, m), in metres; 1 by default."""
        del links, state
        return np.ones(observed.row.shape)

    def points(self, observed: Observations, links: Links, state: State) -> tuple[Ints, Floats] | None:
        """Return what is measured as points in frames: the frame (N, m), and the point in it (N, m, 3), m."""
        del observed, links, state
        return None

    def defines_world(self, attachments: Attachments) -> bool:
        """Return whether the values are given in the world, so that the base's place in it can be estimated."""
        del attachments
        return False

    def by_part(self, part: Ints) -> dict[int, Self]:
        """Return the rows of each part of a session that has any; part (N,) is that of each pose."""
        of = part[self.pose]
        parts = np.unique(of).tolist()
        return {k: self if len(parts) == 1 else self.rows(of == k) for k in parts}

    def blocks(self, session: Session, spec: ModelSpec, state: State) -> BlockSet:
        """Return the blocks of the measurement's own unknowns, with their priors.

        Args:
            session: what is known beforehand.
            spec: what is to be estimated of cameras.
            state: where priors without a known value are centred.
        """
        del session, spec, state
        return BlockSet()

    def world_points(self, session: Session) -> WorldPoints | None:
        """Return LED positions in the world that the measurements give in closed form; None if they give none."""
        del session
        return None

    def target_views(self, session: Session) -> Iterator[TargetViews]:
        """Find where targets were, one pose of one target by one viewer at a time; by default nothing is said."""
        del session
        return iter(())

    def start(self, at: Start, state: State) -> State:
        """Add first values of the measurement's own unknowns, and of the base if it is not there yet.

        Args:
            at: the session, and where the links of the nominal arm are.
            state: what is known so far: arm, joint models, LEDs, and perhaps the base.

        Raises:
            CalibrationError: the measurements are too few.
        """
        del at
        return state


@dataclass(frozen=True, eq=False)
class ByFrame:
    """A prediction, and its derivatives by small motions of the frames that LEDs and cameras are fixed in.

    Attributes:
        predicted: (N, m, D).
        by_frame: for each frame of the attachments (N, m D, 6) derivative by a velocity (linear, angular) of its
            origin in axes parallel to the base link's; of frame 0, the world, of the base link's origin as part of
            it; None where the frame has no part in it.
    """

    predicted: Floats
    by_frame: tuple[Floats | None, ...]
