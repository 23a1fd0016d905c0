from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.worlds import seen
from urdfcal.cli import run
from urdfcal.io.writing import write_session

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(scope="module")
def results(simulated: Callable, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """One ur5 before, later, and after its elbow's encoder was mounted anew: other poses each time."""
    folder = tmp_path_factory.mktemp("ur5")
    data = simulated("ur5", poses=100)
    q = data.truth.q.copy()
    q[:, 2] += 0.002
    first, second = np.arange(50), np.arange(50, 100)
    sessions = {"before": data.session.at(first), "later": data.session.at(second), "slipped": seen(data, q).at(second)}
    for name, session in sessions.items():
        write_session(folder / f"session_{name}", session)
        assert run(["calibrate", str(folder / f"session_{name}"), "-o", str(folder / name), "-q"]) == 0
    return lambda name: folder / name


def compared(capsys: pytest.CaptureFixture[str], a: Path, b: Path, code: int) -> tuple[list[str], dict[str, Any]]:
    assert run(["compare", str(a), str(b)]) == code
    printed = capsys.readouterr().out.splitlines()
    assert run(["compare", str(a), str(b), "--json"]) == code
    return printed, json.loads(capsys.readouterr().out)


def test_an_arm_that_is_the_same_has_not_changed(
    results: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    printed, found = compared(capsys, results("before"), results("later"), 0)
    tip = found["tips_mm"]["tool0"]["rms"]
    sentence = f"tips {tip:.2g} mm rms apart; from {found['expected_mm']:.2g} mm on they are called changed"
    assert printed[0] == f"no change beyond chance: {sentence}"
    assert 0.01 < tip < 0.3
    assert found["changed"] is False
    assert (found["significant"], found["moves_tip_most"], found["joints_mm"]) == ([], None, {})
    assert found["compared"] == len(found["parameters"]) > 10
    assert printed[1].startswith(f"chi-square {found['chi2']:.0f} of {found['compared']} parameters; correlations are")
    assert found["remarks"] == [
        "not compared, since not estimated in both: the zero of shoulder_pan_joint, wrist_3_joint"
    ]
    assert printed[2:] == [f"- {remark}" for remark in found["remarks"]]


def test_a_result_is_its_own_equal(results: Callable[[str], Path], capsys: pytest.CaptureFixture[str]) -> None:
    printed, found = compared(capsys, results("before"), results("before") / "calibration.json", 0)
    assert printed[0].startswith("no change beyond chance: tips 0 mm rms apart; from ")
    assert found["chi2"] == 0.0


def test_an_encoder_that_slipped_is_named(results: Callable[[str], Path], capsys: pytest.CaptureFixture[str]) -> None:
    printed, found = compared(capsys, results("before"), results("slipped"), 1)
    (one,) = found["significant"]
    assert (one["joint"], one["parameter"]) == ("elbow_joint", "theta")
    assert one["change"] == pytest.approx(0.002, abs=4.0 * one["sigma"])
    assert one["sigmas"] == pytest.approx(abs(one["change"]) / one["sigma"])
    assert found["moves_tip_most"] == "elbow_joint"
    moved, tip = found["joints_mm"]["elbow_joint"], found["tips_mm"]["tool0"]["rms"]
    assert 0.5 < moved < 2.0
    assert tip > found["expected_mm"]
    assert printed[0] == (
        f"the arm changed: elbow_joint.theta by {1e3 * one['change']:.2g} mrad ({one['sigmas']:.0f} sigma); "
        f"tips {tip:.2g} mm rms apart, elbow_joint moves them most, by {moved:.2g} mm"
    )
    (row,) = [line.split() for line in printed if line.strip().startswith("elbow_joint.theta")]
    assert row[1] == "mrad"
    first, change = map(float, row[2:4])
    assert (first, change) == (
        pytest.approx(1e3 * one["offsets"][0], abs=6e-4),
        pytest.approx(1e3 * one["change"], abs=6e-4),
    )
    # Turned round, the change has the other sign.
    _, back = compared(capsys, results("slipped"), results("before"), 1)
    assert back["significant"][0]["change"] == pytest.approx(-one["change"])


def edited(path: Path, of: Path, edit: Callable[[dict[str, Any]], object]) -> Path:
    document = json.loads((of / "calibration.json").read_text())
    edit(document)
    path.write_text(json.dumps(document))
    return path


def test_tips_apart_without_a_parameter_are_a_change(
    results: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def move(document: dict[str, Any]) -> None:
        document["robot"]["joints"]["elbow_joint"]["calibrated"][0][3] += 0.01

    other = edited(tmp_path / "other.json", results("before"), move)
    printed, found = compared(capsys, results("before"), other, 1)
    assert found["significant"] == []
    assert printed[0] == (
        f"the arm changed: tips {found['tips_mm']['tool0']['rms']:.2g} mm rms apart where errors of both calibrations "
        f"let expect at most {found['expected_mm']:.2g} mm, no single parameter beyond chance"
    )


def with_models(models: dict[str, float], sought: tuple[str, ...] = (), **load: object) -> Callable:
    """What edits a result into one whose elbow has joint models, by their value, and sought others in vain."""
    losses = {"included": False, "log_evidence": -1.0, "inside_mm": 0.0, "elsewhere_mm": 0.0}

    def edit(document: dict[str, Any]) -> None:
        entries = {name: {"values": [p], "sigma": [0.05 * p], "gain_mm": 0.1} for name, p in models.items()}
        document["joint_models"] = {"elbow_joint": entries} if models else {}
        document["load"] = {"gravity": [0.0, 0.0, -9.81], **load} if models else None
        document["joint_model_trials"] = [
            {"model": name, "joints": ["elbow_joint"], **losses,
             "candidates": {f"elbow_joint.{name}": {"value": 0.0, "sigma": 5e-5}}}
            for name in sought
        ]  # fmt: skip

    return edit


def test_a_joint_model_that_has_grown_is_named(
    results: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = edited(tmp_path / "small.json", results("before"), with_models({"gain": 1e-3}))
    large = edited(tmp_path / "large.json", results("later"), with_models({"gain": 2e-3}))
    printed, found = compared(capsys, small, large, 1)
    assert printed[0].startswith("the arm changed: elbow_joint.gain by 0.001 (9 sigma); tips ")
    assert "elbow_joint moves them most" in printed[0]
    (row,) = [line.split() for line in printed if line.strip().startswith("elbow_joint.gain")]
    assert row[1:4] == ["1e-3", "1.000", "1.000"]
    assert found["moves_tip_most"] == "elbow_joint"
    slow, fast = (
        edited(tmp_path / f"{name}.json", results("before"), with_models({"lag": p}))
        for name, p in (("slow", 1e-3), ("fast", 2e-3))
    )
    printed, _ = compared(capsys, slow, fast, 1)
    assert printed[0] == "the arm changed: elbow_joint.lag by 0.001 (9 sigma); tips 0 mm rms apart"
    # Found in one alone it is a change only if the other has looked for it.
    rigid = edited(tmp_path / "rigid.json", results("before"), with_models({}, sought=("gain",)))
    printed, found = compared(capsys, rigid, small, 1)
    assert found["unfound_in_one"] == ["elbow_joint.gain"]
    said = "found in one of the two alone, and compared with what it would be in the other, which looked for it in vain"
    assert f"- {said}: elbow_joint.gain" in printed


def test_under_which_load_arms_are_compared_is_said(
    results: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joints = json.loads((results("before") / "calibration.json").read_text())["robot"]["joints"]
    masses = {"masses": {joint: {"mass": 1.0, "center": [0.1, 0.0, 0.0]} for joint in joints}}
    payload = {"link": "tool0", "mass": 1.0, "center": [0.0, 0.0, 0.0], "joint": "wrist_3_joint"}
    payload["T_joint_link"] = np.eye(4).tolist()
    loads = {"torques": {}, "light": masses, "heavy": {**masses, "payload": payload}}
    files = {
        name: edited(tmp_path / f"{name}.json", results("before"), with_models({"compliance": 1e-5}, **load))
        for name, load in loads.items()
    }
    rigid = "the tips' distance is of the rigid parts alone: one arm gives way to measured torques"
    unloaded = "the arms carried different payloads: the tips' distance is of arms that carry nothing"
    for first, second, said in (("light", "torques", rigid), ("light", "heavy", unloaded), ("light", "light", None)):
        _, found = compared(capsys, files[first], files[second], 0)
        remarks = [remark for remark in found["remarks"] if remark.startswith((rigid, unloaded))]
        assert [remark.startswith(said) for remark in remarks] == ([] if said is None else [True])


def test_many_changes_are_counted_and_all_in_the_table(
    results: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(document: dict[str, Any]) -> None:
        estimated = [entry for entry in document["dh"] if entry["status"] == "estimated"]
        for k, entry in enumerate(estimated[:5]):
            entry["offset"] += (10.0 + k) * entry["sigma"]

    other = edited(tmp_path / "other.json", results("before"), change)
    printed, found = compared(capsys, results("before"), other, 1)
    assert len(found["significant"]) == 5
    assert printed[0].count(" sigma)") == 3
    assert " and 2 more; tips " in printed[0]
    assert sum(" mm " in line or " mrad " in line for line in printed[1:]) == 5


def test_what_limits_the_comparison_is_said(
    results: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def limit(document: dict[str, Any]) -> None:
        document["verdict"] = {"level": "doubtful", "sentence": "Check it.", "reasons": ["a lamp"]}
        document["warnings"] = ["a lamp"]
        for entry in [entry for entry in document["dh"] if entry["parameter"] in "da" and "sigma" in entry]:
            del entry["sigma"]
            entry |= {"status": "fixed", "reason": "not asked for"}

    other = edited(tmp_path / "other.json", results("before"), limit)
    printed, found = compared(capsys, results("before"), other, 0)
    assert f"- {other}: doubtful: Check it." in printed
    alone = found["only_in_one"]
    assert len(alone) > 3
    assert (
        f"- {len(alone)} parameters were estimated in only one of the two and are not compared: what they hold in one, "
        f"others may hold in the other ({', '.join(alone[:3])}, ...)"
    ) in printed


def test_another_robot_is_refused(
    results: Callable[[str], Path], calibrated: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["compare", str(results("before")), str(calibrated("elbow3r") / "result")]) == 2
    assert "only the second has joint_1, joint_2, joint_3" in capsys.readouterr().err
