"""A rig: a robot, its LEDs, and the cameras that stand around it or the places that it touches, to be simulated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, get_args

import numpy as np

from urdfcal.arrays import Floats, ReadOnly, finite_array, keep
from urdfcal.errors import SessionError
from urdfcal.names import check_known, check_names
from urdfcal.session.knowledge import JointError
from urdfcal.session.model import Setup

if TYPE_CHECKING:
    from urdfcal.session.knowledge import ErrorSizes


@dataclass(frozen=True, eq=False)
class Stand:
    """Where a camera stands and looks.

    Attributes:
        position: (3,) in the base link's frame. [m]
        look_at: (3,) point on its optical axis, in the base link's frame. [m]
    """

    position: Floats
    look_at: Floats

    def __post_init__(self) -> None:
        places = {name: finite_array(getattr(self, name), (3,), name, "stand") for name in ("position", "look_at")}
        keep(self, **places)
        if np.array_equal(self.position, self.look_at):
            raise SessionError("the camera looks at its own place", where="stand")


@dataclass(frozen=True, eq=False, kw_only=True)
class RigDescription(Setup):
    """A rig: a setup and where it stands, enough to simulate a session.

    Attributes:
        stand: of the first camera that stands still; None where all ride on the robot.
        errors: of the joints of a robot that is simulated.
        places: (3,) of each place that is touched, in the base link's frame; none where cameras measure. [m]
    """

    stand: Stand | None = None
    places: Mapping[str, Floats] = field(default_factory=dict)
    errors: ErrorSizes = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        keep(self, errors=ReadOnly(self.errors))
        for error, said in self.errors.items():
            check_known(error, get_args(JointError), "errors", "errors")
            for joint in said if isinstance(said, Mapping) else ():
                check_known(joint, self.chain.actuated, "joints", f"errors.{error}")
        if self.errors and self.places:
            what = "joint errors are simulated before cameras alone, and the rig touches places"
            raise SessionError(what, where="errors", remedy="Leave the key out.")
        if self.stand is None and len(self.attachments.eye_to_hand):
            raise SessionError("where the first camera stands is not given", where="stand")
        if self.stand is not None and self.mounts and not len(self.attachments.eye_to_hand):
            remedy = "Leave the key 'stand' out."
            raise SessionError("no camera stands: all ride on the robot", where="stand", remedy=remedy)
        check_names("places", self.places)
        if self.places and self.rig.cameras:
            what = "there are places to touch and cameras: one of them measures"
            raise SessionError(what, where="places", remedy="Leave the other out.")
        keep(self, places=ReadOnly({name: finite_array(p, (3,), name, "places") for name, p in self.places.items()}))
        for name in (name for known in self.place_distances for name in known.places):
            check_known(name, self.places, "places", "place_distances")
