"""What tabs and report say of how to read them follows from the calibration."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.cli.summary import print_summary
from urdfcal.estimation.solver import first_solved
from urdfcal.output.findings import Overview, meaning
from urdfcal.output.pose_texts import pose_texts
from urdfcal.output.recording import layout
from urdfcal.output.report import _not_chosen, write_report
from urdfcal.output.texts import NO_DIFFERENCE, cost_rises, noise_of, tab_texts, together, unseen
from urdfcal.pipeline import calibrate
from urdfcal.rotations import rpy_to_matrix
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(scope="module")
def overview(simulated: Callable) -> Overview:
    """Two cameras, an LED."""
    return Overview.of(calibrate(simulated("elbow3r").session))


@pytest.fixture(scope="module")
def tagged(simulated: Callable) -> Overview:
    """One camera, a tag, and no LED."""
    return Overview.of(calibrate(simulated("so101_apriltag").session, force=True))


def page(overview: Overview, folder: Path) -> str:
    write_report(folder / "report.html", overview)
    return " ".join((folder / "report.html").read_text().split())


def with_lenses(overview: Overview) -> Overview:
    """The same, as if the lenses had been found with the arm."""
    cameras = overview.document["cameras"]
    found = {name: {**camera, "sigma": {"intrinsics": [1.0] * 4}} for name, camera in cameras.items()}
    return replace(overview, document={**overview.document, "cameras": found})


def test_a_light_with_one_ray_has_its_error_across_it(overview: Overview, tagged: Overview) -> None:
    two, one = pose_texts(overview)[0], pose_texts(tagged)[0]
    assert ("depth included" in two, "across the ray" in two) == (True, False)
    assert ("depth included" in one, "mm with depth" in one) == (False, False)
    assert one.count("mm off, across the ray, nominal") == 4
    scene = tagged.scene
    ray = np.einsum("mi,mi->m", scene.leds.predicted - scene.leds.measured, scene.leds.ray)
    np.testing.assert_allclose(ray, 0.0, atol=1e-3)  # at the predicted distance
    away = replace(scene.leds, nominal=scene.leds.nominal + 0.1 * scene.leds.ray)
    further = replace(tagged, scene=replace(scene, leds=away))
    assert pose_texts(further)[0] == one, "along the ray nothing was measured"
    assert not overview.scene.leds.ray.any()


def test_curves_have_gaps_where_nothing_was_seen(overview: Overview) -> None:
    cameras = {name: {**camera, "time_offset": {}} for name, camera in overview.document["cameras"].items()}
    moving = replace(overview, document={**overview.document, "cameras": cameras})
    for of, one in ((overview, "pose"), (moving, "frame")):
        assert f"residual of each {one}, in the arms' colours, with gaps where nothing was seen" in " ".join(
            pose_texts(of)[0].split()
        )


def test_targets_are_listed_where_there_are_no_leds(overview: Overview, tagged: Overview, tmp_path: Path) -> None:
    leds, targets = page(overview, tmp_path), page(tagged, tmp_path)
    assert ("<th>LED</th><th>on link</th>" in leds, "<th>target</th>" in leds) == (True, False)
    assert ("<th>LED</th><th>on link</th>" in targets, "<th>target</th>" in targets) == (False, True)
    assert "<td>tag</td><td>gripper_frame_link</td>" in targets
    tag = tagged.document["targets"]["tag"]
    np.testing.assert_allclose(rpy_to_matrix(tag["rpy"]), np.array(tag["T_link_target"])[:3, :3], atol=1e-12)
    for key in (*(f"T_link_target/{k}/3" for k in range(3)), *(f"rpy/{k}" for k in range(3)), "sigma/0", "sigma/5"):
        assert f'data-key="targets/tag/{key}"' in targets


def test_corners_of_a_target_move_together(overview: Overview, tagged: Overview, tmp_path: Path) -> None:
    said = "The corners of one target move together"
    for of, has in ((overview, False), (tagged, True)):
        texts = tab_texts(of)
        assert [said in text for text in (texts["pixels"], texts["residuals"], page(of, tmp_path))] == [has] * 3


def test_which_nominal_arm_is_meant_is_said_where_lenses_were_found(overview: Overview, tmp_path: Path) -> None:
    found, said = with_lenses(overview), "with the lenses as given"
    for of, lenses in ((overview, False), (found, True)):
        texts, pose = tab_texts(of), pose_texts(of)[0]
        assert [said in text for text in (texts["pixels"], texts["residuals"], page(of, tmp_path))] == [lenses] * 3
        assert ("Nominal: px with the lenses as given, mm before the calibrated arm's cameras" in pose) is lenses
        assert ("each arm with lenses found for it" in meaning(of.document)) is lenses
        pixels = layout(of).root_container.contents[1].contents[0]
        names = [view.name for view in pixels.contents]
        assert all((said in name) == (lenses and "nominal" in name) for name in names)


def test_what_the_declared_noise_is_of(overview: Overview, tmp_path: Path) -> None:
    calibration = overview.calibration
    exact = replace(overview, calibration=replace(calibration, problem=replace(calibration.problem, joint_sigma=0.0)))
    assert (noise_of(overview), noise_of(exact)) == ("detections and joint readings together", "detections")
    assert f"declared noise, of {noise_of(overview)}" in " ".join(tab_texts(overview)["residuals"].split())
    assert f"in units of it, the noise of {noise_of(overview)}: green should follow" in page(overview, tmp_path)


def test_of_how_many_numbers_a_residual_is(overview: Overview, tmp_path: Path) -> None:
    table = overview.scene.tables[0]
    said = {n: together(replace(table, components=("x", "y", "z")[:n])) for n in (1, 2, 3)}
    assert said == {
        1: "",
        2: "x and y together, √2 times that of one",
        3: "x, y and z together, √3 times that of one",
    }
    assert together(table) in tab_texts(overview)["residuals"]
    assert f"that of the joint readings included, of {together(table)}" in page(overview, tmp_path)


def test_a_cost_that_rises_as_all_poses_follow_some_is_explained(
    overview: Overview, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = overview.calibration.problem
    assert first_solved(problem) is problem
    assert "solved first" not in cost_rises(overview)
    monkeypatch.setattr("urdfcal.estimation.solver._MANY", 20)
    monkeypatch.setattr("urdfcal.estimation.solver._SOME", 5)
    assert len(first_solved(problem).poses) == 5
    assert "where all 30 poses follow the 5 that are solved first" in cost_rises(overview)
    assert cost_rises(overview) in page(overview, tmp_path)
    assert cost_rises(overview) in tab_texts(overview)["convergence"]


def test_poses_that_nothing_was_measured_in_are_counted(
    overview: Overview, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = overview.calibration.session
    more = replace(session, poses=(*session.poses, "blind"), q=np.vstack([session.q, session.q[:1]]), previous=None)
    blind = replace(overview, calibration=replace(overview.calibration, session=more))
    assert (unseen(overview), unseen(blind)) == (0, 1)
    assert "without a measurement" not in page(overview, tmp_path)
    assert "parameters. Poses without a measurement: 1. The residuals are" in page(blind, tmp_path)
    for of, said in ((overview, "30 poses, "), (blind, "30 poses (1 more without a measurement), ")):
        print_summary(of, (), ())
        assert said in capsys.readouterr().out


def test_where_no_difference_is_proven_is_said(overview: Overview, tmp_path: Path) -> None:
    assert NO_DIFFERENCE in tab_texts(overview)["workspace"]
    assert NO_DIFFERENCE in page(overview, tmp_path)


def test_a_model_that_is_better_by_chance_or_not_asked_for_says_why_it_is_not_chosen(
    overview: Overview, tmp_path: Path
) -> None:
    calibration, comparison = overview.calibration, overview.calibration.comparison
    chosen = comparison.chosen
    free = replace(chosen, spec=replace(chosen.spec, intrinsics=("free", "free")), loss=0.9 * chosen.loss)
    worse = replace(free, loss=1.1 * chosen.loss)
    fixed = replace(calibration.session, estimate=Estimate(intrinsics="fixed"))
    tried = replace(calibration, comparison=replace(comparison, attempts=(chosen, free, worse)))
    assert _not_chosen(tried) == ["", "within chance", ""]
    assert _not_chosen(replace(tried, session=fixed)) == ["", "the session says otherwise", ""]
    assert "better by more than 3 standard errors, less is within chance" in page(overview, tmp_path)


def test_noise_that_differs_by_little_is_no_finding_and_that_is_said(overview: Overview, tmp_path: Path) -> None:
    said = "differ by less than 1.5 times, or by no more than chance, weights and intervals hardly change"
    assert said in page(overview, tmp_path)


def test_that_not_all_arrows_are_drawn_is_said(
    overview: Overview, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "a camera are drawn" not in page(overview, tmp_path)
    assert "residuals of all poses (at most 500 a camera)" in tab_texts(overview)["pixels"]
    monkeypatch.setattr("urdfcal.output.texts.MOST_ARROWS", 10)
    count = int(np.bincount(overview.scene.pixels.camera[overview.scene.pixels.used]).max())
    assert f"; 10 of up to {count} a camera are drawn" in page(overview, tmp_path)
