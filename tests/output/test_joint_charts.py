"""What each joint does, in charts of report and recording."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.worlds import sagging
from urdfcal.output.charts import all_charts
from urdfcal.output.figures import figures
from urdfcal.output.findings import Overview
from urdfcal.output.joint_charts import contribution_chart, joint_model_charts
from urdfcal.output.recording import layout
from urdfcal.output.report import write_report
from urdfcal.output.texts import tab_texts
from urdfcal.pipeline import calibrate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(scope="module")
def bent(simulated: Callable) -> Overview:
    return Overview.of(calibrate(sagging(simulated("ur5", poses=40), 5e-5)))


@pytest.fixture(scope="module")
def rigid(fitted: Callable) -> Overview:
    return Overview.of(fitted("elbow3r"))


def test_causes_are_ranked_with_their_size_and_interval(bent: Overview) -> None:
    chart = contribution_chart(bent.calibration)
    listed = bent.document["contributions"]
    names = list(chart.y.names.values())
    assert names == [f"{each['joint']} {each['what']}" for each in listed[: len(names)]]
    assert "shoulder_lift_joint compliance" in names
    geometry, models, intervals = chart.marks
    lengths = np.concatenate([np.max(mark.x, axis=1) for mark in (geometry, models)])
    np.testing.assert_allclose(sorted(lengths)[::-1], [each["tip_mm"] for each in listed[: len(names)]])
    half = (np.asarray(intervals.x)[:, 1] - np.asarray(intervals.x)[:, 0]) / 2.0
    assert np.all(half <= 1.96 * np.array([each["sigma_mm"] for each in listed[: len(names)]]) + 1e-12)
    assert chart.x.high > np.max(intervals.x)


def test_causes_that_are_too_small_to_be_seen_are_counted(bent: Overview, rigid: Overview) -> None:
    chart, every = contribution_chart(bent.calibration), bent.document["contributions"]
    shown, there = len(chart.y.names), sum(each["tip_mm"] > 0.0 for each in every)
    assert shown < there
    assert chart.title == f"Tip error by cause: {shown} largest of {there}"
    whole = contribution_chart(rigid.calibration)
    assert len(whole.y.names) == sum(each["tip_mm"] > 0.0 for each in rigid.document["contributions"])
    assert whole.title == "Tip error by cause"


def test_that_no_cause_is_sure_by_itself_is_said(rigid: Overview, tmp_path: Path) -> None:
    listed = rigid.document["contributions"]
    wider = [{**each, "sigma_mm": max(each["sigma_mm"], 0.6 * each["tip_mm"])} for each in listed]
    doubtful = replace(rigid, document={**rigid.document, "contributions": wider})
    for overview, said in ((rigid, False), (doubtful, True)):
        write_report(tmp_path / "report.html", overview)
        assert ("Every interval reaches 0" in (tmp_path / "report.html").read_text()) is said
        assert ("Every interval reaches 0" in tab_texts(overview)["joints"]) is said


def test_a_joint_model_is_shown_with_what_is_seen_of_it(bent: Overview) -> None:
    charts = {chart.name: chart for chart in joint_model_charts(bent.calibration)}
    before, after, model = charts["compliance of shoulder_lift_joint"].marks
    assert np.std(after.y) < 0.3 * np.std(before.y)
    assert np.all(np.diff(model.x) >= 0.0)
    slope, _ = np.polyfit(model.x, model.y, 1)
    assert slope == pytest.approx(5e-2, rel=0.1)  # mrad/(N m)
    # A wrist that carries next to nothing yields to next to nothing, which is not seen; the last one to nothing.
    assert "compliance of wrist_1_joint" not in charts
    assert "compliance of wrist_3_joint" not in charts


def test_report_and_recording_show_them_and_of_a_rigid_arm_what_models_would_bring(
    bent: Overview, rigid: Overview, tmp_path: Path
) -> None:
    for overview, bends in ((bent, True), (rigid, False)):
        assert ("joint_models" in figures(overview)) is bends
        assert "causes" in figures(overview)
        names = [chart.name for chart in all_charts(overview)]
        assert "contributions" in names
        assert any(name.startswith("compliance of") for name in names) is bends
        write_report(tmp_path / "report.html", overview)
        text = (tmp_path / "report.html").read_text()
        assert text.index("What was wrong with this arm") < text.index("In numbers")
        trials = overview.document["joint_model_trials"]
        assert any(trial["included"] for trial in trials) is bends
        assert text.count("<td>yes</td>") == sum(trial["included"] for trial in trials)
        for k in range(len(trials)):
            for key in ("log_evidence", "inside_mm", "elsewhere_mm"):
                assert f'data-key="joint_model_trials/{k}/{key}"' in text
        assert "Joints" in [view.name for view in layout(overview).root_container.contents]
    json.dumps(bent.document)
