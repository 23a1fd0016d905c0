"""What is known of the cameras before the detections: standard deviations, and how the errors go together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.cameras.rig import Rig
    from urdfcal.estimation.model_spec import ModelSpec
    from urdfcal.session.knowledge import Freedom
    from urdfcal.session.model import Session

FREE_LENS = (0.2, 0.3, 1.0, 0.1)
"""Standard deviations of a free lens: focal length (share of it), principal point (share of the longer image side),
radial and decentring coefficients. Next to no prior: it spans any real lens and keeps k3 from running off where
detections leave the image's corners empty; the principal points of a measured session of a Motoman arm are a quarter of
the image off."""

REFINED_LENS = (0.005, 0.005, 0.02, 0.001)
"""The same for a lens to be refined whose calibration gave no standard deviations: a careful board calibration."""

REFINED_POSE = (0.002, 0.002, 0.002, 0.002, 0.002, 0.002)
"""Standard deviations of a camera pose to be refined that was calibrated without any. [m, rad]"""


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """The prior of some cameras' poses and lenses, entry by entry.

    Attributes:
        sigma: (K,) standard deviations; 0 where a value is exactly known, inf where nothing is. [unit of the entry]
        correlation: (K, K) of the errors; the identity where sigma is 0 or inf.
        measured: (K,) which entries a calibration of the cameras gave; the others only keep lenses from running off.
    """

    sigma: Floats
    correlation: Floats
    measured: Bools

    @classmethod
    def of(cls, session: Session, spec: ModelSpec, moving: Sequence[int], lenses: Sequence[int]) -> CameraPrior:
        """What is said of the poses of the cameras ``moving``, then of the lenses of the cameras ``lenses``.

        The rig says it of cameras among each other, a mount of how the first one on a link sits there.

        What is fixed is exactly as given, so that the refined rest is what the rig's covariance leaves of it then
        (conditioned on the fixed). What is free is not known any more (marginalised).
        """
        if not spec.intrinsics:
            return cls(np.zeros(0), np.zeros((0, 0)), np.zeros(0, bool))
        mounts = {session.rig.index(mount.camera): mount for mount in session.mounts}
        by_hand = {c: mounts[c].sigma for c in mounts if session.attachments.reference[c] == c}
        entries = _Entries.of(session.rig, spec, by_hand)
        sigma, correlation = entries.conditioned()
        chosen = np.concatenate(
            [np.zeros(0, np.intp), *(entries.poses[c] for c in moving), *(entries.lenses[c] for c in lenses)]
        )
        return cls(
            frozen(sigma[chosen]),
            frozen(correlation[np.ix_(chosen, chosen)]),
            frozen(entries.refined[chosen] & ~np.isin(chosen, entries.by_hand), bool),
        )


@dataclass(frozen=True, eq=False)
class _Entries:
    """Everything there is to know of a rig, camera by camera: its lens, then its pose.

    Attributes:
        sigma: (Q,) as given or assumed.
        correlation: (Q, Q) as given, the identity elsewhere.
        fixed, refined: (Q,) what becomes of each; the others are free.
        lenses, poses: where those of each camera are.
        by_hand: (K,) those of how cameras sit on their links, which no calibration of cameras measured.
    """

    sigma: Floats
    correlation: Floats
    fixed: Bools
    refined: Bools
    lenses: tuple[Ints, ...]
    poses: tuple[Ints, ...]
    by_hand: Ints

    @classmethod
    def of(cls, rig: Rig, spec: ModelSpec, by_hand: Mapping[int, Floats | None]) -> _Entries:
        parts: list[Floats] = []
        words: list[Freedom] = []
        listed: list[bool] = []
        places: list[Ints] = []
        for c, (known, lens, pose) in enumerate(zip(rig.sigmas, spec.intrinsics, spec.extrinsics, strict=True)):
            of_pose = by_hand.get(c, known.pose if known is not None else None)
            for part, word, given in (
                (_lens_sigma(rig, c, lens), lens, known is not None),
                (_pose_sigma(of_pose, pose), pose, of_pose is not None and c not in by_hand),
            ):
                places.append(np.arange(len(words), len(words) + len(part)))
                parts.append(part)
                words += [word] * len(part)
                listed += [given] * len(part)
        correlation = np.eye(len(words))
        known_entries = np.flatnonzero(listed)
        correlation[np.ix_(known_entries, known_entries)] = rig.correlation
        return cls(
            np.concatenate(parts),
            correlation,
            np.array([word == "fixed" for word in words]),
            np.array([word == "refine" for word in words]),
            tuple(places[::2]),
            tuple(places[1::2]),
            np.concatenate([*(places[2 * c + 1] for c in by_hand), np.zeros(0, np.intp)]).astype(np.intp),
        )

    def conditioned(self) -> tuple[Floats, Floats]:
        """Standard deviations and correlations of all entries, the fixed ones exactly as they are given."""
        sigma, correlation = np.where(self.fixed, 0.0, self.sigma), np.eye(len(self.sigma))
        certain = self.sigma == 0.0
        refined = np.flatnonzero(self.refined & ~certain)
        fixed = np.flatnonzero(self.fixed & ~certain)
        across = self.correlation[np.ix_(fixed, refined)]
        left = self.correlation[np.ix_(refined, refined)]
        left = left - across.T @ np.linalg.solve(self.correlation[np.ix_(fixed, fixed)], across)
        scale = np.sqrt(np.diag(left))
        sigma[refined] *= scale
        correlation[np.ix_(refined, refined)] = left / np.outer(scale, scale)
        return sigma, correlation


def _pose_sigma(known: Floats | None, freedom: Freedom) -> Floats:
    if freedom == "free":
        return np.full(6, np.inf)
    return np.array(REFINED_POSE) if known is None else known


def _lens_sigma(rig: Rig, c: int, freedom: Freedom) -> Floats:
    known, camera = rig.sigmas[c], rig.cameras[c]
    if freedom != "free" and known is not None:
        return known.parameters
    focal, centre, bend, decentring = FREE_LENS if freedom == "free" else REFINED_LENS
    f, width = camera.intrinsics[0], max(camera.resolution)
    by_name = {"fx": focal * f, "fy": focal * f, "cx": centre * width, "cy": centre * width}
    by_name |= {"p1": decentring, "p2": decentring}
    return np.array([by_name.get(name, bend) for name in camera.parameter_names])
