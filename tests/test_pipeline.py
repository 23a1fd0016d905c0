from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import RIGID
from urdfcal.errors import CalibrationError, OutputError, SessionError
from urdfcal.estimation.evaluation import compare, explain
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.estimation.measurements.points import CorrelatedPoints
from urdfcal.estimation.multistart import Minimum
from urdfcal.io.folder import read_points, read_session
from urdfcal.pipeline import calibrate
from urdfcal.robot.chain import Chain
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.session.knowledge import Estimate, Led, Noise

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import urdfcal
    from urdfcal.estimation.problem import Problem

RIGS = ["elbow3r", "ur5", "panda", "so101", "stanford"]


def error(calibration: urdfcal.Calibration, simulated: object, placements: np.ndarray) -> float:
    """Rms distance of a robot's tip from the true one's over the workspace. [m]"""
    chain = calibration.chain
    q = chain.random_values(300, np.random.default_rng(0))
    true, other = (replace(chain, placements=p) for p in (simulated.truth.placements, placements))
    return float(np.sqrt(np.mean(compare(true, other, q).position ** 2)))


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", RIGS)
def test_the_calibrated_arm_is_far_nearer_to_the_true_one(rig: str, simulated: Callable, fitted: Callable) -> None:
    data, calibration = simulated(rig), fitted(rig)
    assert error(calibration, data, calibration.placements) < 0.25 * error(
        calibration, data, calibration.chain.placements
    )


@pytest.mark.parametrize("rig", RIGS)
def test_the_corrected_urdf_is_the_drawn_one_but_for_origins(rig: str, fitted: Callable) -> None:
    calibration = fitted(rig)
    drawn, built = calibration.session.urdf.data, calibration.calibrated_urdf()
    masked = [re.sub(rb"<origin[^>]*>", lambda tag: re.sub(rb'"[^"]*"', b"", tag[0]), text) for text in (drawn, built)]
    assert masked[0] == masked[1]
    chain = Chain.from_urdf(Urdf.parse(built), calibration.chain.tip_link, calibration.chain.base_link)
    q = chain.random_values(50, np.random.default_rng(1))
    expected = tip_poses(calibration.chain, q, calibration.placements)
    np.testing.assert_allclose(tip_poses(chain, q), expected, atol=1e-12)


def test_a_session_without_urdf_still_has_a_model(simulated: Callable) -> None:
    session = simulated("elbow3r").session
    calibration = calibrate(replace(session, urdf=None))
    with pytest.raises(OutputError, match="without a URDF"):
        calibration.calibrated_urdf()
    assert calibration.apply(calibration.chain.build_model()).njoints == 4


def test_the_result_does_not_depend_on_where_the_base_link_is(simulated: Callable, fitted: Callable) -> None:
    # The same measurements with the chain rooted at UR's own `base` frame, half a turn from base_link.
    session = simulated("ur5").session
    other = replace(session, chain=Chain.from_urdf(session.urdf, "tool0", "base"))
    a, b = fitted("ur5"), calibrate(other)
    np.testing.assert_allclose(a.placements[1:], b.placements[1:], atol=1e-9)


def test_json_says_what_was_estimated_and_why_not(simulated: Callable) -> None:
    data = simulated("ur5")
    calibration = calibrate(data.session, seed=7)
    result = json.loads(json.dumps(calibration.to_dict(), allow_nan=False))
    assert result["format"] == "urdfcal/2"
    assert result["provenance"]["seed"] == 7
    assert set(result["placements"]) == set(calibration.chain.names)
    assert len(result["dh"]) == 5 * 6
    for row in result["dh"]:
        assert row["unit"] == ("m" if row["parameter"] in ("d", "a") else "rad")
        if row["status"] == "estimated":
            assert row["sigma"] > 0.0
        else:
            assert row["status"] == "fixed"
            assert row["reason"]
            assert row["offset"] == 0.0
    assert sum(row["status"] == "estimated" for row in result["dh"]) == 18
    assert result["fit"]["parameters"] == result["fit"]["rank"] == 27
    assert result["fit"]["rms_px"] < 0.2 < result["fit"]["rms_nominal_px"]
    assert 0.5 < result["fit"]["reduced_chi2"] < 1.6


def test_tolerances_of_zero_hold_a_parameter(simulated: Callable) -> None:
    session = simulated("ur5").session
    held = replace(session, tolerances=replace(session.tolerances, joints={"elbow_joint": {"alpha": 0.0}}))
    row = next(
        row for row in calibrate(held).to_dict()["dh"] if row["joint"] == "elbow_joint" and row["parameter"] == "alpha"
    )
    assert (row["status"], row["offset"]) == ("fixed", 0.0)
    assert "tolerances" in row["reason"]


def test_cameras_of_unknown_place_are_placed(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    rig = data.session.rig
    unknown = replace(data.session, rig=replace(rig, T_cam_world=(rig.T_cam_world[0], None)))
    calibration = calibrate(unknown)
    np.testing.assert_allclose(calibration.estimate.T_cam_frame[1], rig.T_cam_world[1], atol=5e-3)
    # Without a baseline nothing but the links' lengths tells the scale: no rank for it, and it is said.
    assert calibration.identifiability.rank == 27 + 6 - 1
    assert any("tolerances decide" in lost for lost in calibration.identifiability.unidentifiable)
    assert error(calibration, data, calibration.placements) < 0.6 * error(
        calibration, data, calibration.chain.placements
    )


@pytest.mark.no_cover
def test_the_measured_irb120_comes_out_as_published(shared: Path) -> None:
    fit = calibrate(read_session(shared / "irb120_liaowu")).document.fit
    assert fit.rms_nominal_mm == pytest.approx(5.32, abs=0.02)
    assert fit.rms_mm <= 0.25  # 0.24 as a rigid arm; it bends: 0.13


@pytest.mark.no_cover
def test_triangulated_points_do_nearly_as_well_as_pixels(simulated: Callable) -> None:
    data = simulated("ur5", poses=50)
    session = replace(data.session, estimate=Estimate("dh", "fixed", "fixed"), joint_models=RIGID)
    pixels, points = (calibrate(session, method=method) for method in ("pixels", "points"))
    assert points.estimate.cameras == ()
    assert points.document.fit.rms_mm < 2.0
    assert error(points, data, points.placements) < 1.5 * error(pixels, data, pixels.placements)


@pytest.mark.no_cover
@pytest.mark.usefixtures("no_trials")
def test_a_wrong_tip_link_is_refused(simulated: Callable) -> None:
    session = simulated("ur5").session
    wrong = replace(session, chain=Chain.from_urdf(session.urdf, "wrist_2_link", "base_link"), q=session.q[:, :5])
    with pytest.raises(CalibrationError, match="times the declared noise"):
        calibrate(replace(wrong, estimate=Estimate("dh", "fixed", "fixed")))


@pytest.mark.no_cover
def test_the_measured_motoman_finds_its_lenses(shared: Path) -> None:
    session = read_session(shared / "motoman_right")
    # Models of its joints would be weighed, and not chosen, for as long again.
    rigid = replace(session, joint_models=RIGID, estimate=replace(session.estimate, geometry="dh"))
    calibration = calibrate(rigid.at(np.arange(0, len(session.poses), 2)))
    assert str(calibration.comparison.chosen.spec) == "DH rows, free intrinsics, free camera poses"
    assert calibration.document.fit.rms_px <= 1.02
    points, leds = read_points(shared / "motoman_right" / "check_points.csv", session)
    tracker = replace(session, measurements=(points,), leds=leds)
    residual = explain(replace(calibration.chain, placements=calibration.placements), tracker).residuals[0]
    assert 1e3 * np.sqrt(np.mean(np.sum(residual**2, axis=1))) <= 0.17


@pytest.mark.no_cover
def test_predicted_tip_errors_are_true(simulated: Callable) -> None:
    # Squared tip error over predicted variance, averaged over the workspace and a few robots.
    ratios = []
    for seed in range(5):
        data = simulated("elbow3r", poses=20, seed=seed)
        alone = Estimate("dh", "fixed", "fixed")
        session = replace(data.session, estimate=alone, joint_models=RIGID, leds=(Led("led"),))
        calibration = calibrate(session, priors=False)
        q = session.chain.random_values(300, np.random.default_rng(0))
        predicted = np.mean(calibration.tip_sigma(q) ** 2)
        ratios.append(error(calibration, data, calibration.placements) ** 2 / predicted)
    assert 0.5 < np.mean(ratios) < 1.8


def test_a_urdf_that_moves_differently_is_never_handed_out(fitted: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    calibration = fitted("elbow3r", estimate=Estimate("dh", "fixed", "fixed"))
    monkeypatch.setattr("urdfcal.robot.apply.rewrite_origins", lambda urdf, origins: urdf.data)
    with pytest.raises(OutputError, match="moves differently when read by"):
        calibration.calibrated_urdf()


@pytest.mark.no_cover
def test_lenses_that_are_right_stay_as_given(fitted: Callable) -> None:
    for seed in (0, 1):
        chosen = fitted("ur5", seed=seed).comparison.chosen.spec
        assert chosen.intrinsics == ("fixed", "fixed")
        assert chosen.geometry == "dh"


def test_detections_and_a_trackers_points_together_are_refused(simulated: Callable) -> None:
    session = simulated("elbow3r").session
    points = Points(np.arange(30), np.zeros(30, int), np.random.default_rng(0).normal(size=(30, 3)), np.full(30, 1e-4))
    with pytest.raises(SessionError, match="detections and points are both named"):
        calibrate(replace(session, measurements=(*session.measurements, points)))


def test_another_minimum_that_is_kept_is_the_result(fitted: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = fitted("elbow3r", estimate=Estimate("dh", "fixed", "fixed"))
    session = alone.session
    other = replace(alone.fit, converged=False)
    minima = (Minimum(other, True, "nearest to nominal"), Minimum(alone.fit, False, "farther from nominal"))
    monkeypatch.setattr("urdfcal.pipeline.multistart", lambda *_: minima)
    with pytest.raises(CalibrationError, match="did not settle"):  # what is assessed is what is kept
        calibrate(session, starts=1)
    among = calibrate(session, starts=1, force=True)
    assert among.fit is among.comparison.chosen.fit
    assert (among.fit.state, among.fit.converged) == (other.state, False)
    assert among.solutions == minima
    assert [entry.kept for entry in among.document.solutions] == [True, False]
    monkeypatch.setattr("urdfcal.pipeline.multistart", lambda *_: (Minimum(None, False, "no start"),))
    assert calibrate(session, starts=1).assessment.level == "good"


def test_a_single_camera_triangulates_nothing(simulated: Callable) -> None:
    session = simulated("ur5_handeye", poses=15).session
    with pytest.raises(CalibrationError, match="no point can be triangulated from these detections"):
        calibrate(session, method="points")


def test_triangulated_points_replace_the_detections_and_nothing_else(
    simulated: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Extra(Points):
        """Another kind of measurement, in no world of its own."""

        kind = "extra"
        defines_world = classmethod(lambda _, __: False)

    session = simulated("ur5", poses=12).session
    extra = Extra(np.arange(12), np.zeros(12, int), np.random.default_rng(0).normal(size=(12, 3)), np.array(1e-3))
    seen: list[Problem] = []

    def stop(_: object, problem: Problem, *__: object, **___: object) -> None:
        seen.append(problem)
        raise CalibrationError("stopped")

    monkeypatch.setattr("urdfcal.pipeline.compare_models", stop)
    with pytest.raises(CalibrationError, match="stopped"):
        calibrate(replace(session, measurements=(*session.measurements, extra)), method="points")
    assert [type(observed.table) for observed in seen[0].observations] == [CorrelatedPoints, Extra]


def test_a_good_calibration_has_nothing_said_against_it(fitted: Callable) -> None:
    calibration = fitted("ur5", estimate=Estimate("dh", "fixed", "fixed"))
    assert calibration.failures == calibration.warnings == ()
    assert calibration.document.verdict.level == "good"


def test_zero_offsets_alone_are_an_arm_that_was_estimated(simulated: Callable) -> None:
    session = simulated("elbow3r", poses=20).session
    for geometry, claimed in (("offsets", True), ("none", False)):
        calibration = calibrate(replace(session, estimate=Estimate(geometry, "fixed", "fixed")), force=True)
        assert (calibration.document.tip is not None) == claimed


@pytest.mark.no_cover
def test_noise_of_which_nothing_is_said_is_found_and_used(simulated: Callable) -> None:
    data = simulated("so101", poses=50)
    said = replace(data.session, estimate=Estimate("dh"), joint_models=RIGID)
    silent = replace(said, noise=Noise())
    assert silent.undeclared_noise == {"pixel", "joint"}
    told, found = calibrate(said), calibrate(silent)
    assert found.assessment.level == "good"
    assert found.session.noise.joint == pytest.approx(said.noise.joint, rel=0.4)
    assert found.session.noise.pixel == pytest.approx(said.noise.pixel, rel=0.2)
    assert [noise.declared for noise in found.evidence.noise] == [None, None]
    assert error(found, data, found.placements) < 1.2 * error(told, data, told.placements)
    assert found.fit.reduced_chi2 == pytest.approx(1.0, abs=0.3)
    assert found.nominal_fit.cost != told.nominal_fit.cost  # with usual noise, not with what was found


def test_noise_that_makes_predictions_worse_is_not_used(simulated: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    rigid = replace(simulated("so101", poses=50).session, estimate=Estimate("dh"), joint_models=RIGID)
    session = replace(rigid, noise=Noise(pixel=0.1))
    monkeypatch.setattr("urdfcal.pipeline._NO_WORSE", 0.0)
    kept = calibrate(session, force=True)
    assert kept.session.noise.joint is None
    assert kept.evidence.noise[-1].declared is None
    assert kept.evidence.noise[-1].found > 1e-4


def test_a_calibration_that_finds_no_start_says_of_which_session(simulated: Callable, tmp_path: Path) -> None:
    session = simulated("ur5", poses=12).session
    detections = session.find(Detections)
    blind = replace(session, folder=tmp_path, measurements=(detections.rows(np.arange(3)),))
    with pytest.raises(CalibrationError) as caught:
        calibrate(blind)
    assert str(caught.value).startswith(f"{tmp_path}: ")
