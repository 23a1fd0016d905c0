"""Model specifications: which parts of arm and cameras an estimate corrects (METHOD 13)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.cameras import camera_values

if TYPE_CHECKING:
    from urdfcal.estimation.joint_models import Term
    from urdfcal.estimation.state import State
    from urdfcal.session.knowledge import ArmGeometry, Freedom
    from urdfcal.session.model import Session

_FIXED: Freedom = "fixed"
_FREE: Freedom = "free"
_WORDS: dict[ArmGeometry, str] = {
    "none": "nominal arm",
    "offsets": "zero offsets",
    "dh": "DH rows",
    "full": "all placements",
}


@dataclass(frozen=True)
class ModelSpec:
    """One model of what differs from nominal.

    Attributes:
        geometry: of the arm.
        intrinsics: of each camera; of a lens that several have, at the first.
        extrinsics: of each camera in the frame it is fixed in; the first eye-to-hand one is the world and fixed.
        priors: whether tolerances hold the arm near nominal and the LEDs near their given positions.
        terms: joint models of some joints, beside those that the session switches on.
    """

    geometry: ArmGeometry
    intrinsics: tuple[Freedom, ...] = ()
    extrinsics: tuple[Freedom, ...] = ()
    priors: bool = True
    terms: tuple[Term, ...] = ()

    def __str__(self) -> str:
        words = [_WORDS[self.geometry]]
        for what, spec in (("intrinsics", self.intrinsics), ("camera poses", self.extrinsics)):
            words += [f"{word} {what}" for word in ("refine", "free") if word in spec]
        words += dict.fromkeys(term.model for term in self.terms)
        return ", ".join(words).replace("refine ", "refined ")

    @property
    def free_lenses(self) -> int:
        """Number of cameras whose given intrinsics count for nothing."""
        return self.intrinsics.count(_FREE)

    @property
    def nominal_arm(self) -> ModelSpec:
        """The same cameras with the nominal arm."""
        return replace(self, geometry="none", terms=())


def nominal(session: Session, state: State, *, priors: bool = True) -> ModelSpec:
    """Return the nominal arm with the lenses as given; only cameras of unknown pose are free.

    Args:
        session: what is known of the cameras.
        state: whose cameras take part: none where points are estimated from.
        priors: whether manufacturing tolerances act as priors.
    """
    attachments = session.attachments
    count = len(camera_values(attachments, state))
    refined = {mount.camera for mount in session.mounts if mount.sigma is not None}
    extrinsics: list[Freedom] = []
    for c, name in enumerate(attachments.cameras[:count]):
        if attachments.reference[c] == c and attachments.camera[c] != 0:
            extrinsics.append("refine" if name in refined else "free")
        else:
            extrinsics.append("free" if attachments.T_cam_reference[c] is None else "fixed")
    return ModelSpec("none", (_FIXED,) * count, tuple(extrinsics), priors)


def candidates(session: Session, state: State, *, priors: bool = True) -> tuple[ModelSpec, ...]:
    """The models to compare, from simple to rich: every geometry with the lenses as given, and with free ones.

    As given is within their standard deviations where a calibration of the cameras gave some: so the tip is 1.05 x as
    far off as with the true cameras, and 1.14 x with them fixed (tests/benchmarks/cameras.py, 20 seeds). What the
    session names is left as it says in every candidate but for the lenses: whether fixed lenses are refuted by the
    detections must be known before an arm is bent to fit them.

    Raises:
        SessionError: a camera whose place is not given is to stay there.
    """
    base, estimate = nominal(session, state, priors=priors), session.estimate
    count = len(base.intrinsics)
    names, sigmas = session.rig.names[:count], session.rig.sigmas[:count]
    said = tuple(
        estimate.of("intrinsics", name) if of == c else _FIXED
        for c, (name, of) in enumerate(zip(names, session.rig.lens, strict=False))
    )
    lenses: tuple[Freedom, ...] = tuple("fixed" if known is None else "refine" for known in sigmas)
    extrinsics: list[Freedom] = []
    for c, (name, known, usual) in enumerate(zip(names, sigmas, base.extrinsics, strict=True)):
        word = None if c in session.attachments.worlds else estimate.of("extrinsics", name)
        if session.attachments.T_cam_frame[c] is None and word not in (None, "free"):
            raise SessionError(
                f"the extrinsics of {name!r} are {word}, but where it stands is not given",
                where="estimate",
                remedy="Give its T_cn_cnm1 in the camera file or its place on its link, or leave its extrinsics free.",
            )
        measured = known is not None and known.pose is not None and usual == "fixed"
        extrinsics.append(word or ("refine" if measured else usual))
    geometries: tuple[ArmGeometry, ...] = (estimate.geometry,) if estimate.geometry else ("none", "offsets", "dh")
    intrinsics = (
        tuple(word or given for word, given in zip(said, lenses, strict=True)),
        tuple(word or _FREE for word in said),
        tuple(_FREE if of == c else _FIXED for c, of in enumerate(session.rig.lens[:count])),
    )
    return tuple(
        ModelSpec(geometry, words, tuple(extrinsics), priors)
        for words in dict.fromkeys(intrinsics)
        for geometry in geometries
    )


def allowed(session: Session, spec: ModelSpec) -> bool:
    """Whether a model is what the session asks for, as far as it asks for something."""
    names = session.rig.names[: len(spec.intrinsics)]
    said = (session.estimate.of("intrinsics", name) for name in names)
    own = (of == c for c, of in enumerate(session.rig.lens))
    return all(
        word is None or word == freedom or not mine
        for word, freedom, mine in zip(said, spec.intrinsics, own, strict=False)
    )
