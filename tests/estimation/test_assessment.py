from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import repeated
from urdfcal.arrays import rms
from urdfcal.errors import CalibrationError
from urdfcal.estimation.assessment import assess, corrections
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.cameras import lens_key
from urdfcal.estimation.diagnosis.doctor import Finding
from urdfcal.estimation.diagnosis.trials import Suspicion
from urdfcal.estimation.evaluation import compare
from urdfcal.estimation.evidence import Regions, TipCorrection, TipError
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.scale import LengthScale
from urdfcal.estimation.uncertainty import SizeError
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.estimation.assessment import Assessment
    from urdfcal.estimation.model_selection import Trial
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.model import Session

EVIDENCE = ("noise", "scale", "findings", "regions", "tip", "improvement", "corrections", "suspicion")
ARM_ONLY = Estimate("dh", "fixed", "fixed")

pytestmark = pytest.mark.usefixtures("no_trials")


@pytest.fixture(scope="module")
def good(fitted: Callable) -> FittedCalibration:
    """A calibration that nothing speaks against."""
    calibration = fitted("elbow3r", estimate=ARM_ONLY)
    assert calibration.assessment.level == "good"
    assert calibration.assessment.reasons == calibration.failures == calibration.warnings == ()
    return calibration


def again(of: FittedCalibration, session: Session | None = None, **changes: object) -> Assessment:
    """What the assessment says of a calibration with changes to its fit, or to the trials of its comparison."""
    comparison = of.comparison
    trials = {name: changes.pop(name) for name in ("chosen", "best", "nominal_arm") if name in changes}
    evidence = replace(of.evidence, **{name: changes.pop(name) for name in EVIDENCE if name in changes})
    if changes:
        trials["chosen"] = replace(comparison.chosen, fit=replace(of.fit, **changes))
    return assess(session or of.session, of.problem, replace(comparison, **trials), evidence)


def moved(of: FittedCalibration, tolerances: float, zero: bool = False) -> dict[str, object]:
    """The calibration's state with one parameter, a joint's zero or another, so many tolerances from nominal."""
    block = next(block for block in of.fit.parameters.blocks if block.key == ARM)
    k = next(k for k, row in enumerate(block.rows) if (row in block.arm.zeros) == zero and block.active[k])
    offsets = np.zeros_like(of.estimate.offsets)
    offsets[block.places[0][k], block.places[1][k]] = tolerances * block.sigma[k]
    return {"state": of.fit.state.replace({ARM: offsets})}


def chi2(of: FittedCalibration, reduced: float) -> dict[str, object]:
    return {"cost": reduced * of.fit.freedom}


def with_errors_of_the_nominal_arm(of: FittedCalibration) -> Trial:
    chosen, nominal = of.comparison.chosen, of.comparison.nominal_arm
    return replace(chosen, held_out=replace(chosen.held_out, distance=nominal.held_out.distance))


@pytest.mark.parametrize(
    ("reduced", "level", "words"),
    [
        (1.99, "good", ""),
        (2.01, "doubtful", "the residuals are 1.4 times the declared noise: the noise is larger than declared"),
        (8.9, "doubtful", "the residuals are 3.0 times"),
        (9.1, "bad", "the residuals are 3.0 times the declared noise: the model does not explain them"),
        (399.0, "bad", "the residuals are 20.0 times the declared noise: the model does not explain them"),
        (401.0, "bad", "the residuals are 20 times the declared noise: this is not a robot like the nominal one"),
    ],
)
def test_a_misfit_is_said_once(good: FittedCalibration, reduced: float, level: str, words: str) -> None:
    found = again(good, **chi2(good, reduced))
    assert found.level == level
    assert [reason.startswith(words) for reason in found.reasons] == [True] * (level != "good")
    assert found.failures == (found.reasons if level == "bad" else ())


@pytest.mark.parametrize(
    ("tolerances", "level", "words"),
    [
        (7.9, "good", []),
        (-8.1, "doubtful", ["is off by", "8 times its tolerance"]),
        (19.9, "doubtful", ["20 times its tolerance"]),
        (20.1, "bad", ["would be off by 20 tolerances", "name larger tolerances"]),
    ],
)
def test_parameters_far_from_nominal(good: FittedCalibration, tolerances: float, level: str, words: list[str]) -> None:
    found = again(good, **moved(good, tolerances))
    assert found.level == level
    assert len(found.reasons) == bool(words)
    for word in words:
        assert word in found.reasons[0]


def test_of_many_implausible_parameters_the_worst_three_are_named(good: FittedCalibration) -> None:
    block = next(block for block in good.fit.parameters.blocks if block.key == ARM)
    free = [k for k, row in enumerate(block.rows) if row not in block.arm.zeros and block.active[k]]
    offsets = np.zeros_like(good.estimate.offsets)
    for size, k in enumerate(free, start=21):
        offsets[block.places[0][k], block.places[1][k]] = size * block.sigma[k]
    reason = again(good, state=good.fit.state.replace({ARM: offsets})).failures[0]
    worst = 20 + len(free)
    named = [f"{block.names[k]}{by} {size}" for k, size, by in zip(
        reversed(free), range(worst, worst - 3, -1), (" would be off by", " by", " by"), strict=False
    )]  # fmt: skip
    assert reason.startswith(f"{named[0]} tolerances, {named[1]}, {named[2]} and {len(free) - 3} more by over 20: no")


def test_joint_zeros_may_be_anywhere_and_are_a_warning(good: FittedCalibration) -> None:
    found = again(good, **moved(good, 100.0, zero=True))
    assert found.level == "doubtful"
    assert "mrad, 100 times its tolerance" in found.warnings[0]
    # Nor do they bend the arm.
    assert again(good, **moved(good, 100.0, zero=True), **chi2(good, 4.0)).failures == ()


def test_far_corrections_that_leave_a_misfit_explain_something_else(good: FittedCalibration) -> None:
    found = again(good, **moved(good, 6.0), **chi2(good, 2.1))
    assert found.level == "bad"
    assert "a correction is more than 5 tolerances long" in found.failures[0]
    assert "explain an effect that is not the arm's" in found.failures[0]
    strict = {name: dict.fromkeys(("d", "a", "alpha"), 1e-9) for name in good.chain.names}
    session = replace(good.session, tolerances=replace(good.session.tolerances, joints=strict))
    assert re.match(r"\d+ corrections are more than", again(good, session, **chi2(good, 2.1)).failures[0])
    assert sum("declared noise" in reason for reason in found.reasons) == 1
    assert again(good, **moved(good, 4.0), **chi2(good, 2.1)).failures == ()
    assert again(good, **moved(good, 6.0), **chi2(good, 1.9)).failures == ()


def test_each_joint_has_its_own_tolerance(good: FittedCalibration) -> None:
    usual = again(good, **moved(good, 10.0))
    assert usual.level == "doubtful"
    tolerances = good.session.tolerances
    lax = {name: dict.fromkeys(("theta", "d", "a", "alpha", "beta"), 1.0) for name in good.chain.names}
    session = replace(good.session, tolerances=replace(tolerances, joints=lax))
    assert again(good, session, **moved(good, 10.0)).level == "good"
    offsets = corrections(good.problem, good.fit, session.tolerances)
    assert len(offsets) >= good.fit.parameters.active_columns(ARM)[1].sum()
    assert all(correction.tolerances == abs(correction.offset) for correction in offsets)


def test_plain_least_squares_has_no_tolerances_to_exceed(good: FittedCalibration) -> None:
    chosen = good.comparison.chosen
    fit = replace(good.fit, **moved(good, 30.0))
    plain = replace(chosen, spec=replace(chosen.spec, priors=False), fit=fit)
    assert again(good, chosen=plain).level == "good"


def test_many_outliers(good: FittedCalibration) -> None:
    (kept,) = good.fit.kept
    rows = np.argwhere(kept)
    for share, failures in ((0.24, 0), (0.26, 1)):
        outlier = np.zeros_like(kept)
        outlier[tuple(rows[: int(np.ceil(share * len(rows)))].T)] = True
        found = again(good, outlier=(outlier,), kept=(kept & ~outlier,))
        assert len(found.failures) == failures
        assert all(f"{outlier.sum()} of {len(rows)} measurements" in failure for failure in found.failures)


def test_nothing_but_outliers(good: FittedCalibration) -> None:
    (kept,) = good.fit.kept
    with pytest.raises(CalibrationError, match="all are outliers"):
        again(good, outlier=(kept,), kept=(np.zeros_like(kept),))


def test_a_solver_that_did_not_converge(good: FittedCalibration) -> None:
    found = again(good, converged=False)
    assert found.level == "bad"
    assert f"in {len(good.fit.history)} steps" in found.failures[0]


def test_an_arm_no_better_than_the_nominal_one(good: FittedCalibration) -> None:
    nominal = good.comparison.nominal_arm
    for loss in (nominal.loss, nominal.loss + 1.0):
        (failure,) = again(good, chosen=replace(good.comparison.chosen, loss=loss)).failures
        assert "does not predict held-out poses better" in failure
    # More poses are better than worse, but the worse ones by more.
    (failure,) = again(good, chosen=with_errors_of_the_nominal_arm(good)).failures
    assert "mm rms error on held-out poses" in failure


def test_where_the_nominal_arm_was_asked_for_there_is_nothing_to_prove(good: FittedCalibration) -> None:
    session = replace(good.session, estimate=replace(ARM_ONLY, geometry="none"))
    nominal = good.comparison.nominal_arm
    chosen = replace(with_errors_of_the_nominal_arm(good), loss=nominal.loss)
    assert again(good, session, chosen=chosen).failures == ()


def test_free_lenses_that_predict_much_better_refute_the_given_ones(good: FittedCalibration) -> None:
    chosen = good.comparison.chosen
    for factor, failures in ((1.49, 0), (1.51, 1)):
        residual = tuple(part / factor for part in chosen.held_out.residual)
        best = replace(chosen, held_out=replace(chosen.held_out, residual=residual))
        found = again(good, best=best).failures
        assert len(found) == failures
        assert all("intrinsics as given are refuted" in failure for failure in found)


def test_wrong_lenses_are_refuted(simulated: Callable) -> None:
    session = simulated("ur5").session
    cameras = tuple(replace(c, intrinsics=c.intrinsics * [1.02, 1.02, 1.0, 1.0]) for c in session.rig.cameras)
    wrong = replace(session, rig=replace(session.rig, cameras=cameras), estimate=ARM_ONLY)
    with pytest.raises(CalibrationError, match="intrinsics as given are refuted"):
        calibrate(wrong)


def test_a_warning_of_the_session_comes_first(good: FittedCalibration) -> None:
    session = replace(good.session, warnings=("joint E never moves",))
    found = again(good, session, **chi2(good, 3.0))
    assert found.level == "doubtful"
    assert "2 warnings" in found.sentence
    assert found.reasons[0] == "joint E never moves"
    assert "a warning" in again(good, session).sentence


@pytest.mark.no_cover
def test_a_camera_far_from_its_place_on_its_link(simulated: Callable) -> None:
    calibration = calibrate(replace(simulated("tiago", poses=12).session, estimate=Estimate("dh", "fixed")))
    (mount,), (camera,) = calibration.session.mounts, calibration.estimate.T_cam_frame
    assert calibration.assessment.level == "good"
    for sigmas, warnings in ((4.9, 0), (5.1, 1)):
        T = np.linalg.inv(camera)
        T[0, 3] += sigmas * mount.sigma[0]
        session = replace(calibration.session, mounts=(replace(mount, T_link_camera=T),))
        found = again(calibration, session)
        assert found.failures == ()
        assert len(found.warnings) == warnings
        assert all("camera 'head' comes out" in text and "5 times its sigma" in text for text in found.warnings)


@pytest.mark.no_cover
def test_noise_declared_too_small_is_a_failure_in_the_library_too(simulated: Callable) -> None:
    session = simulated("elbow3r", poses=15).session
    detections = session.find(Detections)
    session = replace(session, estimate=ARM_ONLY, measurements=(replace(detections, sigma=0.2 * detections.sigma),))
    with pytest.raises(CalibrationError, match="times the declared noise: the model does not explain them"):
        calibrate(session)
    forced = calibrate(session, force=True)
    assert forced.assessment.level == "bad"
    assert forced.failures == forced.assessment.failures != ()
    assert forced.document.verdict.reasons == list(forced.assessment.reasons)


def test_an_effect_in_the_residuals_is_a_warning_in_place_of_the_noise(good: FittedCalibration) -> None:
    finding = Finding(
        "joint: change", "from pose 7 on joint is 2 mrad off: the encoder jumped", 0.42, 1e-9, 7, ("base",)
    )
    noise = (replace(good.evidence.noise[0], found=0.5, chi2=99.0), *good.evidence.noise[1:])
    found = again(good, findings=(finding,), noise=noise, **chi2(good, 3.0))
    assert found.level == "doubtful"
    assert found.warnings == (f"{finding.sentence} (42% of the squared residuals; base would look the same)",)
    alone = again(good, findings=(replace(finding, alike=()),))
    assert alone.warnings == (f"{finding.sentence} (42% of the squared residuals)",)


@pytest.mark.parametrize(("sigmas", "level"), [(2.9, "good"), (-3.1, "doubtful"), (4.9, "doubtful"), (5.1, "bad")])
def test_all_lengths_too_long_by_one_factor(good: FittedCalibration, sigmas: float, level: str) -> None:
    scale = LengthScale(6e-4, 2e-3 * sigmas, 2e-3)
    found = again(good, scale=scale)
    assert found.level == level
    for reason in found.reasons:
        way = "long" if sigmas > 0 else "short"
        assert f"all lengths come out {0.2 * abs(sigmas):.2g} +- 0.2 % too {way} for the arm's tolerances" in reason
        assert "0.1 % is 0.6 mm at the tip" in reason
    assert len(found.reasons) == (level != "good")
    assert len(found.failures) == (level == "bad")


@pytest.mark.parametrize(("times", "said"), [(1.9, False), (2.1, True)])
def test_a_size_of_the_arm_that_held_out_poses_do_not_show(good: FittedCalibration, times: float, said: bool) -> None:
    shown = max(good.comparison.chosen.rms("distance"), good.evidence.regions.rms)
    hidden = SizeError(1.5e-3, times * shown, 5e-5)
    found = again(good, tip=replace(good.evidence.tip, expected=1.01 * hidden.rms, size=hidden))
    assert found.level == ("doubtful" if said else "good")
    for reason in found.warnings:
        assert reason.startswith("all lengths together are known to 0.15 % only")
        assert "or a known distance" in reason
    declared = replace(good.evidence.scale, declared=2e-3)
    assert again(good, tip=replace(good.evidence.tip, expected=hidden.rms, size=hidden), scale=declared).level == "good"
    mixed = replace(good.evidence.tip, expected=2.0 * hidden.rms, size=hidden)  # most of it is something else
    assert again(good, tip=mixed).level == "good"


def test_where_the_model_does_not_hold_a_better_known_length_takes_away_no_more_than_its_part() -> None:
    holds = TipError(1.0e-3, (0.5e-3, 1.5e-3), 5, 0.6e-3, SizeError(1e-3, 0.8e-3, 0.6e-3), 1.0e-3)
    tip = holds.at_least(Regions(4, 2.6e-3, (2e-3, 4e-3), 5e-3))  # of which 2.4 mm nothing explains
    assert (tip.rms, tip.interval) == (2.6e-3, (0.5e-3, 4e-3))
    assert tip.size.rms_without == pytest.approx(np.hypot(2.4e-3, 0.6e-3))
    assert tip.rms_with_more == pytest.approx(np.hypot(2.4e-3, 0.6e-3))
    assert tip.limited_by_size, "as far as the model explains it"
    assert holds.at_least(Regions(4, 0.2e-3, (1e-4, 3e-4), 5e-3)) == holds


@pytest.mark.parametrize(("share", "fall", "said"), [(0.1, 99.0, True), (0.65, 99.0, True), (1.4, 99.0, False),
                                                     (9.0, 15.0, False), (9.0, 15.2, True)])  # fmt: skip
def test_noise_that_is_declared_otherwise_than_it_is_found(
    good: FittedCalibration, share: float, fall: float, said: bool
) -> None:
    pixel, joint = good.evidence.noise
    wrong = replace(pixel, declared=0.1, found=0.1 / share, relative_sigma=0.05, chi2=fall)
    found = again(good, noise=(wrong, replace(joint, found=3e-4, relative_sigma=0.1)))
    assert found.level == ("doubtful" if said else "good")
    if said:
        assert f"pixel 0.1 px for {0.1 / share:.2g}" in found.warnings[0]
        assert f"enter noise: {{pixel: {0.1 / share:.2g}, joint: 0.0003}}" in found.warnings[0]
    unknown = again(good, noise=(wrong, replace(joint, relative_sigma=0.6)))
    assert not any("joint: " in warning for warning in unknown.warnings)


def test_an_led_far_from_where_it_was_said_to_be(good: FittedCalibration) -> None:
    (led,), (position,) = good.session.leds, good.estimate.leds
    for sigmas, said in ((4.5, False), (4.7, True)):
        moved_led = replace(led, position=position + np.array([0.0, 0.0, sigmas * 0.004]), sigma=0.004)
        found = again(good, replace(good.session, leds=(moved_led,)))
        assert found.level == ("doubtful" if said else "good")
        assert [text.startswith(f"LED '{led.name}' comes out 19 mm from where") for text in found.warnings] == [
            True
        ] * said
    for free in (replace(led, position=None, sigma=None), replace(led, position=position + 1.0, sigma=0.0)):
        assert again(good, replace(good.session, leds=(free,))).level == "good"


def test_regions_that_are_predicted_badly(good: FittedCalibration) -> None:
    inside = float(np.sqrt(np.mean(good.comparison.chosen.residuals("distance") ** 2)))
    for factor, low, said in (
        (1.9, 1.1, []),
        (2.1, 1.1, ["it does not hold elsewhere: "]),
        (2.1, 0.9, ["it may not hold elsewhere: "]),
    ):
        regions = replace(good.evidence.regions, rms=factor * inside, interval=(low * inside, 9.0 * inside))
        found = again(good, regions=regions)
        assert [text[: text.index(": ") + 2] for text in found.warnings] == said


def test_corrections_that_are_no_larger_than_what_a_tip_is_expected_to_be_off(good: FittedCalibration) -> None:
    large, small = TipCorrection("left", 1.01e-3, 1e-3), TipCorrection("right", 0.99e-3, 1e-3)
    assert again(good, corrections=(large,)).level == "good"
    (warning,) = again(good, corrections=(small,)).warnings
    assert warning.startswith("away from the measured poses the nominal arm may be as good")
    assert "the tip moves by 0.99 mm rms, and is expected 1 mm off" in warning
    (warning,) = again(good, corrections=(large, small)).warnings
    assert "the tip right moves by 0.99 mm" in warning
    only_cameras = replace(good.session, estimate=Estimate("none"))
    assert not any("nominal arm" in text for text in again(good, only_cameras, corrections=(small,)).warnings)


def test_the_correction_is_how_far_the_tip_moves_from_the_nominal_arm(good: FittedCalibration) -> None:
    (found,), chain = good.evidence.corrections, good.chain
    moved = compare(chain, chain.with_placements(good.placements), chain.random_values(500, np.random.default_rng(1)))
    assert found.moved == pytest.approx(rms(moved.position), rel=0.1)
    assert (found.link, found.expected) == (chain.tips[0].link, good.evidence.tip.rms)


def test_where_zeros_alone_are_estimated_they_are_what_moves_and_that_is_said(simulated: Callable) -> None:
    found = calibrate(replace(simulated("ur5").session, estimate=Estimate("offsets", "fixed")), force=True)
    (tip,), chain = found.evidence.corrections, found.chain
    moved = compare(chain, chain.with_placements(found.placements), chain.random_values(500, np.random.default_rng(1)))
    assert tip.moved == pytest.approx(rms(moved.position), rel=0.1)
    assert any(text.startswith("the joints' zeros alone are estimated") for text in found.assessment.reasons)


def test_each_of_two_arms_has_its_correction(fitted: Callable) -> None:
    found = fitted("tiago_dual", poses=40).evidence.corrections
    assert [of.link for of in found] == ["arm_left_tool_link", "arm_right_tool_link"]
    assert all(0.0 < of.expected < of.moved for of in found)


def test_an_improvement_that_is_not_shown(good: FittedCalibration) -> None:
    assert again(good, improvement=(1e-6, 1e-3)).level == "good"
    found = again(good, improvement=(-2e-5, 1e-4))
    assert found.warnings == (
        "no improvement over the nominal arm is shown: on held-out poses the difference is -0.02 to 0.1 mm (95 %)",
    )
    nominal = replace(good.session, estimate=replace(ARM_ONLY, geometry="none"))
    assert again(good, nominal, improvement=(-2e-5, 1e-4)).level == "good"


def test_the_mistake_that_a_trial_found_comes_first(good: FittedCalibration) -> None:
    suspicion = Suspicion("joint_2's sign", 240.0, 0.8, "px")
    changes = {"regions": replace(good.evidence.regions, rms=1.0, interval=(0.5, 9.0)), **chi2(good, 500.0)}
    assert any("hold elsewhere" in text for text in again(good, **dict(changes)).warnings)
    found = again(good, suspicion=suspicion, **changes)
    assert found.warnings == ()  # whatever else looks wrong follows from the mistake
    assert found.failures[0] == "joint_2's sign: with that mended the nominal arm is 0.8 px off instead of 240 px"
    assert str(replace(suspicion, before=np.inf)).endswith("0.8 px off instead of no fit at all")


def test_lenses_that_come_out_as_another_cameras(good: FittedCalibration) -> None:
    lens = good.session.rig.cameras[0]
    for ratio, said in ((0.82, False), (0.78, True), (1.2, False), (2.0, True)):
        scale = np.where(np.arange(len(lens.parameters)) < 2, ratio, 1.0)
        state = good.fit.state.replace({lens_key(lens.name): lens.with_parameters(scale * lens.parameters)})
        found = again(good, state=state)
        words = f"camera '{lens.name}' comes out with {ratio:.2g} times the focal length that is given"
        assert [text.startswith(words) for text in found.warnings] == [True] * said


def test_noise_declared_too_large_is_told_before_effects_that_come_of_it(good: FittedCalibration) -> None:
    pixel, joint = good.evidence.noise
    finding = Finding("joint: gain", "joint moves more than it reads", 0.3, 1e-9, None, ())
    too_large = replace(pixel, declared=2.0, found=0.1, chi2=500.0)
    found = again(good, noise=(too_large, joint), findings=(finding,))
    assert [text.startswith("noise is not declared") for text in found.warnings] == [True]
    too_small = replace(pixel, declared=0.01, found=0.1, chi2=500.0)
    assert again(good, noise=(too_small, joint), findings=(finding,)).warnings[0].startswith(finding.sentence)


@pytest.mark.no_cover
def test_poses_that_are_few_configurations(simulated: Callable, fitted: Callable) -> None:
    session = replace(repeated(simulated("ur5", poses=50), 0.0), estimate=ARM_ONLY)
    calibration = calibrate(session, force=True)
    words = "50 poses are only 10 distinct configurations"
    assert sum(text.startswith(words) for text in calibration.assessment.warnings) == 1
    assert not any("distinct" in text for text in fitted("ur5", poses=50).assessment.warnings)
