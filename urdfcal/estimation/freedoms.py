"""What an estimate may move, and how far: the choice among nested models is made in these words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from urdfcal.estimation.state import State
    from urdfcal.session.model import Freedom, Geometry, Session

_FIXED: Freedom = "fixed"
_FREE: Freedom = "free"
_WORDS: dict[Geometry, str] = {
    "none": "arm as drawn",
    "offsets": "zero offsets",
    "dh": "DH rows",
    "full": "all placements",
}


@dataclass(frozen=True)
class Freedoms:
    """One model of what differs from the drawing.

    Attributes:
        geometry: of the arm.
        intrinsics: of each camera.
        extrinsics: of each camera in the frame it is fixed in; the first one that stands still is the world and fixed.
        priors: whether tolerances hold the arm near its drawing and the LEDs near their given places.
    """

    geometry: Geometry
    intrinsics: tuple[Freedom, ...] = ()
    extrinsics: tuple[Freedom, ...] = ()
    priors: bool = True

    def __str__(self) -> str:
        words = [_WORDS[self.geometry]]
        for what, freedoms in (("intrinsics", self.intrinsics), ("camera poses", self.extrinsics)):
            words += [f"{word} {what}" for word in ("refine", "free") if word in freedoms]
        return ", ".join(words).replace("refine ", "refined ")

    @property
    def frozen_arm(self) -> Freedoms:
        """The same cameras with the arm as drawn."""
        return replace(self, geometry="none")


def nominal(session: Session, state: State, *, priors: bool = True) -> Freedoms:
    """The arm as drawn and the lenses as given; only cameras of unknown pose are free.

    Args:
        session: what is known of the cameras.
        state: whose cameras take part: none where points are estimated from.
        priors: whether manufacturing tolerances act as priors.
    """
    frames, cameras = session.frames, state.cameras
    refined = {mount.camera for mount in session.mounts if mount.sigma is not None}
    extrinsics: list[Freedom] = []
    for c, camera in enumerate(cameras):
        leads, rides = frames.leader[c] == c, frames.camera[c] != 0
        if leads and rides:
            extrinsics.append("refine" if camera.name in refined else "free")
        else:
            extrinsics.append("free" if frames.T_cam_leader[c] is None else "fixed")
    return Freedoms("none", (_FIXED,) * len(cameras), tuple(extrinsics), priors)


def candidates(session: Session, state: State, *, priors: bool = True) -> tuple[Freedoms, ...]:
    """The models to compare, from simple to rich: every geometry with the lenses as given, and with free ones.

    What the session names is left as it says in every candidate but for the lenses: whether fixed lenses are refuted by
    the sightings must be known before an arm is bent to fit them.
    """
    base, estimate = nominal(session, state, priors=priors), session.estimate
    names = session.rig.names if base.intrinsics and session.rig is not None else ()
    extrinsics = tuple(
        drawn if c in session.frames.standing[:1] else estimate.of("extrinsics", name) or drawn
        for c, (name, drawn) in enumerate(zip(names, base.extrinsics, strict=True))
    )
    geometries: tuple[Geometry, ...] = (estimate.geometry,) if estimate.geometry else ("none", "offsets", "dh")
    said = tuple(estimate.of("intrinsics", name) for name in names)
    lenses: list[tuple[Freedom, ...]] = [tuple(word or "fixed" for word in said), (_FREE,) * len(said)]
    if any(said):
        lenses.insert(1, tuple(word or "free" for word in said))
    return tuple(
        Freedoms(geometry, intrinsics, extrinsics, priors)
        for intrinsics in dict.fromkeys(lenses)
        for geometry in geometries
    )


def allowed(session: Session, freedoms: Freedoms) -> bool:
    """Whether a model is what the session asks for, as far as it asks for something."""
    names = session.rig.names if freedoms.intrinsics and session.rig is not None else ()
    said = (session.estimate.of("intrinsics", name) for name in names)
    return all(word is None or word == freedom for word, freedom in zip(said, freedoms.intrinsics, strict=True))
