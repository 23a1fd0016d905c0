"""The assessment: whether to trust an estimate, decided once for library, command line and report (METHOD 14)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import pinocchio as pin

from urdfcal.estimation.blocks.arm import ARM, ArmBlock
from urdfcal.estimation.blocks.cameras import camera_poses, camera_values, has_cameras
from urdfcal.estimation.blocks.leds import LEDS, led_sigma
from urdfcal.estimation.blocks.targets import TargetBlock
from urdfcal.estimation.elsewhere_doubts import elsewhere, unimproved, zeros_alone
from urdfcal.estimation.scale_doubts import doubtful, impossible, unknown_size

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from urdfcal.estimation.blocks.base import Block
    from urdfcal.estimation.diagnosis.doctor import Finding
    from urdfcal.estimation.evidence import Evidence
    from urdfcal.estimation.model_selection import Comparison
    from urdfcal.estimation.noise import FoundNoise
    from urdfcal.estimation.problem import Problem
    from urdfcal.estimation.solver import Solution
    from urdfcal.estimation.state import Key
    from urdfcal.session.knowledge import Tolerances
    from urdfcal.session.model import Session

Level: TypeAlias = Literal["good", "doubtful", "bad"]

# Residuals this many times the declared noise are no noise: wrong tip links and exchanged columns start at a hundred,
# careless declarations end at five or so.
_ABSURD_NOISE = 20.0
# Noise declared three times too small is a mistake in the session or an effect that the model does not have; either
# way the standard deviations mean nothing.
MISFIT_CHI2 = 9.0
# A reduced chi-square above this is no accident with a few dozen measurements: something is unmodelled.
DOUBTFUL_CHI2 = 2.0
MANY_OUTLIERS = 0.25
# Corrections of this many tolerances are either a wrong session or a very unusual arm; a misfit beside them means
# that the arm is bent to explain what it is not to blame for.
_FAR = 5.0
# The elbow of one of five real Universal Robots is 13.5 mrad off: unusual is what no arm is known to have.
_UNUSUAL = 8.0
IMPLAUSIBLE = 20.0
"""No arm is made this many tolerances off its nominal geometry."""
NOISE_OFF = 1.5
"""Noise declared this many times off what is found for certain distorts weights and intervals beyond rounding."""
# An LED that was measured with a ruler comes out within this many of its standard deviations, all three coordinates
# together: chance 1e-4 (chi-square, 3 degrees of freedom).
_DISPLACED = 4.6
# Twenty configurations determine an arm of six joints; below that, repeats that are half of the poses are missed.
_FEW, _REPEATED = 20, 0.5
# No lens is calibrated to a focal length so many times too long or too short.
_OTHER_LENS = 1.25
# Held-out residuals that shrink by this factor with free lenses refute the lenses as given: the arm would be bent to
# make up for them (a measured session of a Motoman arm: 3.0 against 1.0 px, and an arm ten times worse).
_REFUTED = 1.5


@dataclass(frozen=True)
class Assessment:
    """Whether to trust an estimate.

    Attributes:
        level: bad with failures, doubtful with warnings only, else good.
        sentence: one sentence that says so, without numbers and reasons.
        failures: why it should not be used, the gravest first.
        warnings: what to check before using it.
    """

    level: Level
    sentence: str
    failures: tuple[str, ...]
    warnings: tuple[str, ...]

    @classmethod
    def of(cls, failures: Sequence[str], warnings: Sequence[str]) -> Assessment:
        """Follow from what speaks against an estimate."""
        level: Level = "good"
        sentence = "Trust it: the residuals are what the declared noise explains."
        if failures:
            level, sentence = "bad", "Do not use it."
        elif warnings:
            counted = "a warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
            level, sentence = "doubtful", f"Do not trust it blindly: {counted} to check first."
        return cls(level, sentence, tuple(failures), tuple(warnings))

    @property
    def reasons(self) -> tuple[str, ...]:
        """All that speaks against it, the gravest first."""
        return (*self.failures, *self.warnings)


def assess(session: Session, problem: Problem, comparison: Comparison, evidence: Evidence) -> Assessment:
    """Assess the chosen model's estimate by its own evidence.

    Args:
        session: what was measured, its warnings and its tolerances.
        problem: of its measurements.
        comparison: the models that were tried, and the chosen one.
        evidence: on the chosen one.

    Raises:
        CalibrationError: all measurements are outliers.
    """
    fit = comparison.chosen.fit
    moved = corrections(problem, fit, session.tolerances) if comparison.chosen.spec.priors else ()
    implausible = sorted((c for c in moved if c.geometric and c.tolerances > IMPLAUSIBLE), key=lambda c: -c.tolerances)
    misfit = (*_misfit(fit.reduced_chi2, moved), *_no_noise(evidence.noise))
    failures = (
        *misfit,
        *_outliers(fit),
        *_implausible(implausible),
        *_unsettled(fit),
        *_unproven(session, comparison),
        *_refuted_lenses(comparison),
        *(() if misfit else impossible(evidence.scale)),
    )
    # An effect that is not modelled looks like noise: it is named, not the noise. But noise that is declared too large
    # bends the estimate by its weights, and leaves effects that are none.
    overdeclared = any(of.ratio >= NOISE_OFF for of in evidence.noise)
    findings = () if overdeclared or any(of.is_none for of in evidence.noise) else evidence.findings
    noise = () if findings else tuple(_declared_noise(evidence.noise))
    warnings = (
        *session.warnings,
        *(_found(finding) for finding in findings),
        *(() if misfit else doubtful(evidence.scale)),
        *unknown_size(evidence.tip, evidence.scale, max(comparison.chosen.rms("distance"), evidence.regions.rms)),
        *_bends(evidence),
        *(noise if noise or misfit or findings else _noise(fit.reduced_chi2)),
        *([evidence.undone] if evidence.undone else []),
        *_repeats(problem),
        *(str(c) for c in moved if c.tolerances > _UNUSUAL and c not in implausible),
        *_displaced_leds(session, fit),
        *_displaced_targets(fit),
        *_displaced_mounts(session, fit),
        *_other_lenses(session, fit),
        *elsewhere(comparison, evidence.regions),
        *unimproved(session, evidence),
        *zeros_alone(session),
    )
    if evidence.suspicion is not None:  # whatever else looks wrong follows from it
        return Assessment.of((str(evidence.suspicion), *failures[:1]), session.warnings)
    return Assessment.of(failures, warnings)


@dataclass(frozen=True)
class Correction:
    """How far a parameter that has a manufacturing tolerance is off its nominal value.

    Attributes:
        name: of the parameter.
        offset: from its nominal value. [unit]
        unit: m, rad, or that of a joint model.
        tolerances: size of the offset in units of the parameter's own tolerance.
        geometric: whether it is part of the arm's geometry; joints' zero offsets are anywhere on cheap arms.
    """

    name: str
    offset: float
    unit: str
    tolerances: float
    geometric: bool

    def __str__(self) -> str:
        scale, unit = {"m": (1e3, "mm"), "rad": (1e3, "mrad")}.get(self.unit, (1.0, self.unit))
        return f"{self.name} is off by {scale * self.offset:.1f} {unit}, {self.tolerances:.0f} times its tolerance"


def corrections(problem: Problem, solution: Solution, tolerances: Tolerances) -> tuple[Correction, ...]:
    """List how far a solution is from the nominal robot, each parameter by its own tolerance, prior or not.

    Args:
        problem: whose arm and joint models they are.
        solution: an estimate.
        tolerances: of the robot, per joint where given.
    """
    toleranced: dict[Key[Any], Block[Any]] = {ARM: ArmBlock.of(problem.arm, tolerances, priors=True)}
    toleranced |= {model.key: model for model in problem.joint_models}
    found = []
    for block in solution.parameters.blocks:
        if not block.toleranced:
            continue
        offsets, _ = block.local(solution.state[block.key])
        for k, (offset, tolerance) in enumerate(zip(offsets, toleranced[block.key].sigma, strict=True)):
            geometric = isinstance(block, ArmBlock) and block.rows[k] not in block.arm.zeros
            size = float(abs(offset) / tolerance)
            found.append(Correction(block.names[k], float(offset), block.units[k], size, geometric))
    return tuple(found)


def _misfit(chi2: float, moved: Sequence[Correction]) -> Iterator[str]:
    noise = float(np.sqrt(chi2))
    far = sum(c.geometric and c.tolerances > _FAR for c in moved)
    if noise > _ABSURD_NOISE:
        yield (
            f"the residuals are {noise:.0f} times the declared noise: this is not a robot like the nominal one; check "
            "the tip link, the order and the signs of the joint columns, their units, and the cameras"
        )
    elif chi2 > MISFIT_CHI2:
        yield f"the residuals are {noise:.1f} times the declared noise: the model does not explain them"
    elif chi2 > DOUBTFUL_CHI2 and far:
        counted = "a correction is" if far == 1 else f"{far} corrections are"
        yield (
            f"{counted} more than {_FAR:g} tolerances long, and still the residuals are {noise:.1f} times the "
            "declared noise: the corrections explain an effect that is not the arm's"
        )


def _no_noise(noise: Sequence[FoundNoise]) -> Iterator[str]:
    """Residuals of which no noise is declared, and that are too large for any."""
    sizes = [f"{of.name} {of.found:.2g} {of.unit}" for of in noise if of.is_none]
    if sizes:
        yield (
            f"nothing measures as badly as the residuals are, of which no noise is declared: {', '.join(sizes)}; check "
            "what was measured, its units, order and signs, the tip link and the joint columns"
        )


def _found(finding: Finding) -> str:
    also = f"; {' and '.join(finding.alike)} would look the same" if finding.alike else ""
    return f"{finding.sentence} ({finding.share:.0%} of the squared residuals{also})"


def _declared_noise(noise: Sequence[FoundNoise]) -> Iterator[str]:
    """Noise declared too large makes any estimate look good, noise declared too small a good one bad."""
    off = [of for of in noise if not 1.0 / NOISE_OFF < of.ratio < NOISE_OFF]
    if off:
        sizes = ", ".join(f"{of.name} {of.declared:.2g} {of.unit} for {of.found:.2g}" for of in off)
        line = ", ".join(f"{of.name}: {of.found:.2g}" for of in noise if of.known)
        yield f"noise is not declared as the residuals show it: {sizes}; enter noise: {{{line}}}"


def _repeats(problem: Problem) -> Iterator[str]:
    """Many poses that are few configurations."""
    unit = problem.readings.unit[problem.poses]
    distinct = len(np.unique(unit))
    if distinct < _FEW and distinct <= _REPEATED * len(unit):
        yield (
            f"{len(unit)} poses are only {distinct} distinct configurations: repeats average the noise, but do not "
            "determine the arm; measure others"
        )


def _displaced_leds(session: Session, fit: Solution) -> Iterator[str]:
    """LEDs that come out far from where the session puts them."""
    for k, led in enumerate(session.leds):
        sigma = led_sigma(led)
        if led.position is None or not 0.0 < sigma < np.inf:
            continue
        apart = float(np.linalg.norm(fit.state[LEDS][k] - led.position))
        if apart > _DISPLACED * sigma:
            link = led.link or session.chain.tip_link
            yield (
                f"LED {led.name!r} comes out {1e3 * apart:.0f} mm from where the session puts it on {link!r}, "
                f"{apart / sigma:.0f} times its sigma: check the tip link, and position"
            )


def _displaced_targets(fit: Solution) -> Iterator[str]:
    """Targets that come out far from where the session puts them."""
    for block in fit.parameters.blocks:
        if isinstance(block, TargetBlock):
            off = np.abs(block.local(fit.state[block.key])[0])
            if (sigmas := float(np.max(off / block.sigma))) > _DISPLACED:
                apart = f"{1e3 * np.linalg.norm(off[:3]):.0f} mm and {1e3 * np.linalg.norm(off[3:]):.0f} mrad"
                name = block.key.name.partition(".")[0]
                yield (
                    f"target {name!r} comes out {apart} from where the session puts it, {sigmas:.0f} times its sigma: "
                    "check its link, position and rpy, and which way its print is turned"
                )


def _other_lenses(session: Session, fit: Solution) -> Iterator[str]:
    """Lenses that were set free and come out as those of another camera, or of images of another size."""
    for given, found in zip(session.rig.cameras, camera_values(session.attachments, fit.state), strict=False):
        ratio = float(np.sqrt(np.prod(found.intrinsics[:2] / given.intrinsics[:2])))
        if not 1.0 / _OTHER_LENS < ratio < _OTHER_LENS:
            yield (
                f"camera {given.name!r} comes out with {ratio:.2g} times the focal length that is given: its images "
                f"have {ratio:.2g} times the resolution that the camera file says, or it is another camera"
            )


def _bends(evidence: Evidence) -> Iterator[str]:
    """What the joints do is estimated with the arm, and no URDF can hold it."""
    if evidence.bends:
        yield (
            f"{'; '.join(evidence.bends)}: estimated with the arm, but a URDF cannot hold it: the corrected one is the "
            f"rigid part, and its tip {1e3 * evidence.rigid_loss:.2g} mm rms off for it at the measured poses, "
            "bases aligned; urdfcal compensate and the library's joint_values use all of it (with previous=, where the "
            "arm came from, what depends on that), export --to urdf --workspace writes the "
            "rigid arm that is best in a region"
        )


def _noise(chi2: float) -> Iterator[str]:
    if chi2 > DOUBTFUL_CHI2:
        yield (
            f"the residuals are {np.sqrt(chi2):.1f} times the declared noise: the noise is larger than declared, or "
            "camera intrinsics, units or the robot's stiffness are not what the model assumes"
        )


def _outliers(fit: Solution) -> Iterator[str]:
    cut, kept = fit.counts
    if cut > MANY_OUTLIERS * (cut + kept):
        yield (
            f"{cut} of {cut + kept} measurements had to be taken out as outliers: look at how LEDs were detected or "
            "points measured"
        )


def _implausible(moved: Sequence[Correction], most: int = 3) -> Iterator[str]:
    if moved:  # a wrong column makes all of an arm implausible: the worst tell where
        named = "".join(f", {c.name} by {c.tolerances:.0f}" for c in moved[1:most])
        named += f" and {len(moved) - most} more by over {IMPLAUSIBLE:g}" * (len(moved) > most)
        yield (
            f"{moved[0].name} would be off by {moved[0].tolerances:.0f} tolerances{named}: no arm is made so far from "
            "its nominal geometry; check the tip link and the joint columns, or name larger tolerances"
        )


def _unsettled(fit: Solution) -> Iterator[str]:
    if not fit.converged:
        yield (
            f"the estimate did not settle in {len(fit.history)} steps: check the joint readings' columns and units, "
            "the tip link and the cameras"
        )


def _unproven(session: Session, comparison: Comparison) -> Iterator[str]:
    """On held-out poses no better than the nominal arm; where that was asked for, there is nothing to prove."""
    if session.estimate.geometry == "none":
        return
    chosen, nominal = comparison.chosen, comparison.nominal_arm
    before, after = (1e3 * trial.rms("distance") for trial in (nominal, chosen))
    if chosen.loss >= nominal.loss:
        yield (
            "the calibrated arm does not predict held-out poses better than the nominal one: more poses or less noise "
            "are needed, or there is nothing to correct"
        )
    elif after >= before:
        yield (
            f"the calibrated arm is no better than the nominal one: {before:.3g} -> {after:.3g} mm rms error on "
            "held-out poses"
        )


def _refuted_lenses(comparison: Comparison) -> Iterator[str]:
    if not comparison.chosen.spec.intrinsics:
        return
    given, free = (trial.rms("residual") for trial in (comparison.chosen, comparison.best))
    if given > _REFUTED * free:
        yield (
            f"the cameras' intrinsics as given are refuted by the detections: held-out poses are predicted to "
            f"{given:.2f} px with them and to {free:.2f} px with free ones, so the arm would be bent to make up for "
            "the lenses; set estimate: {intrinsics: free}, or calibrate the cameras"
        )


def _displaced_mounts(session: Session, fit: Solution) -> Iterator[str]:
    """Cameras that come out far from where the session puts them on their links."""
    for mount in session.mounts:
        if mount.T_link_camera is None or mount.sigma is None or not has_cameras(fit.state):
            continue
        T = camera_poses(session.attachments, fit.state)[session.rig.index(mount.camera)] @ mount.T_link_camera
        motion = pin.log6(T).vector
        sigmas = float(np.abs(motion / mount.sigma).max())
        if sigmas > _FAR:
            yield (
                f"camera {mount.camera!r} comes out {1e3 * np.linalg.norm(motion[:3]):.0f} mm and "
                f"{1e3 * np.linalg.norm(motion[3:]):.0f} mrad from where the session puts it on {mount.link!r}, "
                f"{sigmas:.0f} times its sigma: check position, rpy (rad) and link"
            )
