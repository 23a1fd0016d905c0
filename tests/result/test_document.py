from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import urdfcal
from urdfcal.errors import CalibrationError, OutputError
from urdfcal.estimation import evidence
from urdfcal.estimation.blocks.base import VectorBlock
from urdfcal.estimation.multistart import Minimum
from urdfcal.estimation.state import Key
from urdfcal.result import builder
from urdfcal.result.document import FORMAT, ResultDocument, read_document
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable

FORMAT_1 = Path(__file__).with_name("format_1.json")


@pytest.fixture(scope="module")
def refused(simulated: Callable) -> urdfcal.FittedCalibration:
    """A calibration with a failure and a warning."""
    session = replace(simulated("ur5").session, warnings=("joint E never moves",))
    noisy = replace(session, noise=replace(session.noise, pixel=0.02))
    tables = tuple(replace(table, sigma=0.2 * table.sigma) for table in session.measurements)
    return urdfcal.calibrate(replace(noisy, measurements=tables), force=True)


def test_the_document_says_what_the_assessment_says(refused: urdfcal.FittedCalibration) -> None:
    verdict, assessment = refused.document.verdict, refused.assessment
    assert verdict.level == assessment.level == "bad"
    assert verdict.sentence == assessment.sentence
    assert len(assessment.failures) == 1
    assert assessment.warnings[0] == "joint E never moves"
    assert verdict.reasons == [*assessment.failures, *assessment.warnings]
    assert refused.document.warnings == list(assessment.warnings)


def test_failures_are_read_back(refused: urdfcal.FittedCalibration, tmp_path: Path) -> None:
    refused.save(tmp_path / "calibration.json")
    loaded = urdfcal.Calibration.load(tmp_path)
    assert loaded.failures == refused.failures
    assert loaded.document == refused.document
    assert loaded.sha256 == refused.sha256


def test_keys_that_are_absent_stay_absent(refused: urdfcal.FittedCalibration) -> None:
    data = refused.to_dict()
    assert "parameters" not in data
    assert all(("sigma" in row) != ("reason" in row) for row in data["dh"])
    assert all("time_offset" not in camera for camera in data["cameras"].values())
    assert read_document(json.dumps(data), "here").to_dict() == data


def test_unknowns_without_a_section_of_their_own_are_listed(
    refused: urdfcal.FittedCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    key: Key[np.ndarray] = Key("stiffness")
    block = VectorBlock(key, ("joint_1.compliance",), ("rad/(N m)",), np.zeros(1), np.ones(1), "the joints' stiffness")
    monkeypatch.setattr(type(refused), "sigmas_of", lambda self, key: np.array([0.1]))
    fit = replace(
        refused.fit,
        parameters=replace(refused.fit.parameters, blocks=(*refused.fit.parameters.blocks, block)),
        state=refused.fit.state.replace({key: np.array([0.5])}),
    )
    chosen = replace(refused.comparison.chosen, fit=fit)
    (entry,) = builder._parameters(replace(refused, comparison=replace(refused.comparison, chosen=chosen)))
    assert entry == {
        "name": "joint_1.compliance",
        "unit": "rad/(N m)",
        "nominal": 0.0,
        "offset": 0.5,
        "sigma": 0.1,
    }


def test_a_start_that_led_nowhere_has_no_cost(refused: urdfcal.FittedCalibration) -> None:
    kept, nowhere = Minimum(refused.fit, True, "the best"), Minimum(None, False, "no start")
    first, second = replace(refused, solutions=(kept, nowhere)).document.solutions
    assert (first.cost, first.kept) == (refused.fit.cost, True)
    assert (second.cost, second.reason) == (None, "no start")


def test_where_the_nominal_arm_puts_an_led_behind_a_camera_in_a_region_the_others_are_written(
    refused: urdfcal.FittedCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = [np.nan * of for of in refused.comparison.nominal_arm.held_out.distance]
    hold_out = evidence.hold_out
    monkeypatch.setattr(
        evidence,
        "hold_out",
        lambda problem, fit, region: (
            hold_out(problem, fit, region)
            if fit.parameters is refused.fit.parameters
            else replace(hold_out(problem, fit, region), distance=tuple(lost))
        ),
    )
    found, _ = evidence._regions(refused.problem, refused.comparison)
    assert found.rms_nominal is None
    assert np.isfinite(found.rms)
    document = replace(refused, evidence=replace(refused.evidence, regions=found)).document
    assert document.regions.rms_nominal_mm is None


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_figures_that_are_no_numbers_are_refused_even_where_they_may_be_absent(
    value: float, refused: urdfcal.FittedCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(builder, "_rms", lambda _residual: value)
    with pytest.raises(CalibrationError, match=r"fit\.rms_nominal_px is no finite number"):
        _ = replace(refused).document


def test_files_of_the_first_format_are_read() -> None:
    before = json.loads(FORMAT_1.read_text())
    assert before["format"] == "urdfcal/1"
    loaded = urdfcal.Calibration.load(FORMAT_1)
    after = loaded.to_dict()
    assert after["format"] == FORMAT == "urdfcal/2"
    assert after["verdict"]["level"] == "good"
    assert loaded.failures == ()
    for name, joint in before["robot"]["joints"].items():
        nominal, calibrated = joint.pop("drawn"), joint.pop("built")
        assert after["robot"]["joints"][name] == {**joint, "nominal": nominal, "calibrated": calibrated}
    same = before.keys() - {"format", "robot"}
    assert {key: after[key] for key in same} == {key: before[key] for key in same}
    assert loaded.dh_offsets is not None
    assert loaded.placements.shape == (3, 4, 4)


def test_warnings_of_the_first_format_make_it_doubtful(tmp_path: Path) -> None:
    data = json.loads(FORMAT_1.read_text())
    data["warnings"] = ["joint E never moves"]
    (tmp_path / "calibration.json").write_text(json.dumps(data))
    document = urdfcal.Calibration.load(tmp_path).document
    assert (document.verdict.level, document.verdict.reasons) == ("doubtful", ["joint E never moves"])
    urdfcal.Calibration.load(tmp_path).save(tmp_path / "calibration.json")
    assert urdfcal.Calibration.load(tmp_path).document == document


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("robot"), "robot: field required"),
        (lambda d: d.update(robot=[]), "robot: input should be"),
        (lambda d: d["robot"].update(joints=[]), "robot.joints: input should be"),
        (lambda d: d["robot"]["joints"]["joint_1"].pop("built"), "joint_1.calibrated: field required"),
        (lambda d: d["robot"]["joints"].update(joint_1=3), "joint_1: input should be"),
        (lambda d: d.pop("warnings"), "field required|valid list"),
    ],
)
def test_what_is_malformed_in_the_first_format_is_named(edit: Callable, message: str) -> None:
    data = json.loads(FORMAT_1.read_text())
    edit(data)
    with pytest.raises(OutputError, match=message):
        read_document(json.dumps(data), "calibration.json")


def edited(edit: Callable) -> str:
    data = urdfcal.Calibration.load(FORMAT_1).to_dict()
    edit(data)
    return json.dumps(data)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d["robot"]["joints"]["joint_1"].update(parent="joint_2"), "'joint_2', which does not come before"),
        (
            lambda d: d["robot"]["joints"]["joint_1"].update(
                mimic={"joint": "nobody", "multiplier": 1.0, "offset": 0.0}
            ),
            "follows 'nobody'",
        ),
        (lambda d: d["robot"]["tips"]["tool0"].update(joint="nobody"), "'nobody', which is not there"),
        (lambda d: d["robot"].update(tip_link="flange"), "tip_link is 'flange'"),
        (lambda d: d["robot"]["joints"]["joint_2"].update(parent=None), "do not form a chain"),
        (lambda d: d["cameras"]["cam0"].pop("T_cam_world"), "one of T_cam_world and T_link_camera is needed"),
        (
            lambda d: d["cameras"]["cam0"].update(T_link_camera=d["cameras"]["cam0"]["T_cam_world"]),
            "one of T_cam_world and T_link_camera is needed",
        ),
        (lambda d: d["T_world_base"][3].__setitem__(0, 1.0), "no rigid transform"),
        (lambda d: [row.__setitem__(0, -row[0]) for row in d["T_world_base"][:3]], "no rigid transform"),
        (lambda d: d["fit"].update(mystery=1), "fit.mystery"),
        (lambda d: d["validation"].update(rms_mm="small"), "validation.rms_mm"),
        (lambda d: d["verdict"].update(level="fair"), "verdict.level"),
        (lambda d: d["validation"].update(interval_mm=[0.1]), "validation.interval_mm"),
    ],
)
def test_documents_that_make_no_sense_are_refused(edit: Callable, message: str) -> None:
    with pytest.raises(OutputError, match=message):
        read_document(edited(edit), "calibration.json")


@pytest.mark.parametrize("text", ["{", "[]", "3", '{"format": null}', '{"format": "urdfcal/0"}'])
def test_what_is_no_document_at_all_is_refused(text: str) -> None:
    with pytest.raises(OutputError, match=r"no JSON|its format is"):
        read_document(text, "calibration.json")


def test_a_result_is_shown_in_a_line(refused: urdfcal.FittedCalibration) -> None:
    for calibration in (refused, urdfcal.Calibration.load(FORMAT_1)):
        text = repr(calibration)
        assert len(text) < 160
        assert "\n" not in text
        assert calibration.chain.name in text
        assert calibration.document.verdict.level in text
    assert "Do not use it." in repr(refused)


def test_offsets_of_the_rows_cost_nothing(refused: urdfcal.FittedCalibration, monkeypatch: pytest.MonkeyPatch) -> None:
    def build(*_: object) -> ResultDocument:
        raise AssertionError("the document was built again")

    expected = {(row.joint, row.parameter): row.offset for row in refused.document.dh}
    monkeypatch.setattr(builder, "build_document", build)
    for calibration in (replace(refused), urdfcal.Calibration.load(FORMAT_1)):
        first = calibration.dh_offsets
        begun = time.perf_counter()
        assert calibration.dh_offsets is first
        assert time.perf_counter() - begun < 1e-3
    found = refused.dh_offsets
    assert found is not None
    assert not found.flags.writeable
    assert {
        (joint, name): found[i, k]
        for i, joint in enumerate(refused.geometry.labels)
        for k, name in enumerate(refused.geometry.columns)
    } == expected


def test_whole_placements_have_no_offsets_of_rows(simulated: Callable, tmp_path: Path) -> None:
    session = replace(simulated("elbow3r").session, estimate=Estimate("full", "fixed", "fixed"))
    calibration = urdfcal.calibrate(session)
    calibration.save(tmp_path / "calibration.json")
    assert calibration.dh_offsets is None
    assert urdfcal.Calibration.load(tmp_path).dh_offsets is None
