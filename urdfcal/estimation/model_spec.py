"""What an estimate may move, and how far: the choice among nested models is made in these words."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from urdfcal.errors import SessionError

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
    def free_lenses(self) -> int:
        """How many cameras' intrinsics as given count for nothing."""
        return self.intrinsics.count(_FREE)

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

    As given is within their standard deviations where a calibration of the cameras gave some: so the tip is 1.05 x as
    far off as with the true cameras, and 1.14 x with them fixed (tests/benchmarks/cameras.py, 20 seeds). What the
    session names is left as it says in every candidate but for the lenses: whether fixed lenses are refuted by the
    sightings must be known before an arm is bent to fit them.

    Raises:
        SessionError: a camera whose place is not given is to stay there.
    """
    base, estimate = nominal(session, state, priors=priors), session.estimate
    rig = session.rig if base.intrinsics else None
    names, sigmas = (rig.names, rig.sigmas) if rig is not None else ((), ())
    said = tuple(estimate.of("intrinsics", name) for name in names)
    lenses: tuple[Freedom, ...] = tuple("fixed" if known is None else "refine" for known in sigmas)
    extrinsics: list[Freedom] = []
    for c, (name, known, drawn) in enumerate(zip(names, sigmas, base.extrinsics, strict=True)):
        word = None if c in session.frames.standing[:1] else estimate.of("extrinsics", name)
        if session.frames.T_cam_frame[c] is None and word not in (None, "free"):
            raise SessionError(
                f"the extrinsics of {name!r} are {word}, but where it stands is not given",
                where="estimate",
                remedy="Give its T_cn_cnm1 in the camera file or its place on its link, or leave its extrinsics free.",
            )
        measured = known is not None and known.pose is not None and drawn == "fixed"
        extrinsics.append(word or ("refine" if measured else drawn))
    geometries: tuple[Geometry, ...] = (estimate.geometry,) if estimate.geometry else ("none", "offsets", "dh")
    intrinsics = (
        tuple(word or given for word, given in zip(said, lenses, strict=True)),
        tuple(word or _FREE for word in said),
        (_FREE,) * len(said),
    )
    return tuple(
        Freedoms(geometry, words, tuple(extrinsics), priors)
        for words in dict.fromkeys(intrinsics)
        for geometry in geometries
    )


def allowed(session: Session, freedoms: Freedoms) -> bool:
    """Whether a model is what the session asks for, as far as it asks for something."""
    names = session.rig.names if freedoms.intrinsics and session.rig is not None else ()
    said = (session.estimate.of("intrinsics", name) for name in names)
    return all(word is None or word == freedom for word, freedom in zip(said, freedoms.intrinsics, strict=True))
