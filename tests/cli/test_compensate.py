from __future__ import annotations

import csv
import json
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

import urdfcal
from tests.worlds import backlash
from urdfcal.cli import run
from urdfcal.cli.results import _errors, _thousandths
from urdfcal.errors import OutputError
from urdfcal.robot.chain import Tree
from urdfcal.robot.kinematics import link_poses, tip_poses
from urdfcal.robot.urdf.packages import package_roots
from urdfcal.session.knowledge import Payload

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.robot.chain import Chain

POSES = 1000


def write(path: Path, chain: Chain, q: np.ndarray) -> Path:
    """A trajectory with a time, the joints from the last to the first, and a column that needs quotes."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", *reversed(chain.actuated), "remark"])
        for k, row in enumerate(q.tolist()):
            writer.writerow([f"{0.01 * k:.2f}", *reversed(row), "to, from"])
    return path


def positions(chain: Chain, q: np.ndarray) -> np.ndarray:
    return tip_poses(chain, q)[:, :3, 3]


@pytest.mark.parametrize("rig", ["ur5", "panda", "elbow3r"])
def test_the_true_tip_goes_where_the_nominal_one_would_as_well_as_the_arm_is_known(
    rig: str, calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = calibrated(rig)
    loaded = urdfcal.Calibration.load(folder / "result")
    nominal = loaded.chain
    true = urdfcal.Chain.from_urdf(folder / "session" / "truth.urdf", nominal.tip_link, nominal.base_link)
    q = nominal.random_values(POSES, np.random.default_rng(11))
    given, written = write(tmp_path / "given.csv", nominal, q), tmp_path / "compensated.csv"
    assert run(["compensate", str(folder / "result"), str(given), "-o", str(written)]) == 0
    assert "worst residual" in capsys.readouterr().out

    rows, before = ([*csv.reader(path.open(newline=""))] for path in (written, given))
    assert rows[0] == before[0]
    assert [(row[0], row[-1]) for row in rows] == [(row[0], row[-1]) for row in before]
    commands = np.array([row[1:-1][::-1] for row in rows[1:]], dtype=float)
    np.testing.assert_array_equal(commands, loaded.compensate(q).q)

    expected = positions(nominal, q)
    uncompensated = np.linalg.norm(positions(true, q) - expected, axis=1)
    model = np.linalg.norm(positions(true, q) - positions(loaded.calibrated, q), axis=1)
    compensated = np.linalg.norm(positions(true, commands) - expected, axis=1)
    for statistic in (np.mean, np.median, lambda error: np.quantile(error, 0.95)):
        assert statistic(compensated) < 1.2 * statistic(model) < 0.25 * statistic(uncompensated)
    # A few poses in a hundred are stretched out or beside a singularity: joints near their command cannot take the
    # other arm there, which is said. All others are reached.
    reached = loaded.compensate(q).position < 1e-5
    assert reached.mean() > 0.95
    assert np.sqrt(np.mean(compensated[reached] ** 2)) < 1.2 * np.sqrt(np.mean(model[reached] ** 2))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda text: text.replace("\n0.01,", "\n0.01,9"), ":3:6: wrist_3_joint = 9"),
        (lambda text: text.replace("\n0.01,", "\n0.01,x"), ":3:6: wrist_3_joint: 'x"),
        (lambda text: text.replace("elbow_joint", "elbow"), ":1: the column is missing: 'elbow_joint'"),
        (lambda text: text.replace("\n0.02,", "\n0.02,0.0,"), ":4: 9 cells where the header names 8"),
        (lambda text: text.splitlines()[0], "no rows"),
    ],
)
def test_a_trajectory_that_is_none_is_refused_with_its_place(
    edit: Callable[[str], str],
    message: str,
    calibrated: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    result = calibrated("ur5") / "result"
    chain = urdfcal.Calibration.load(result).chain
    path = write(tmp_path / "given.csv", chain, chain.random_values(4, np.random.default_rng(1)))
    path.write_text(edit(path.read_text()))
    assert run(["compensate", str(result), str(path), "-o", str(tmp_path / "out.csv")]) == 2
    captured = capsys.readouterr()
    assert f"urdfcal: {path}" in captured.err
    assert message in captured.err
    assert captured.out == ""
    assert [entry.name for entry in tmp_path.iterdir()] == ["given.csv"]


def test_a_trajectory_is_not_compensated_over_itself(
    calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = calibrated("ur5") / "result"
    chain = urdfcal.Calibration.load(result).chain
    path = write(tmp_path / "given.csv", chain, chain.random_values(4, np.random.default_rng(1)))
    before = path.read_bytes()
    assert run(["compensate", str(result), str(path), "-o", str(path)]) == 2
    assert "the trajectory itself" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_the_other_arm_is_said_not_to_be_compensated(
    fitted: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = tmp_path / "calibration.json"
    fitted("tiago_dual", poses=40).save(result)
    loaded = urdfcal.Calibration.load(result)
    chain = loaded.chain
    q = chain.readings(chain.random_values(50, np.random.default_rng(2)))
    path = write(tmp_path / "given.csv", chain, q)
    assert run(["compensate", str(result), str(path), "-o", str(tmp_path / "out.csv")]) == 0
    (said,) = [line for line in capsys.readouterr().out.splitlines() if "is not compensated" in line]
    assert said.startswith("arm_right_tool_link ")
    expected = link_poses(chain, chain.joint_values(q), chain.tips)[1]
    for commands, end in (
        (q, " mm rms with the nominal commands"),
        (loaded.compensate(q).q, " mm with the corrected ones"),
    ):
        real = link_poses(loaded.calibrated, chain.joint_values(commands), chain.tips)[1]
        miss = np.sqrt(np.mean(np.sum((real - expected)[:, :3, 3] ** 2, axis=1)))
        assert f"{1e3 * miss:.3g}{end}" in said


def test_links_fixed_to_the_base_link_have_no_error_to_report() -> None:
    ur5 = package_roots()[-1] / "example-robot-data" / "robots" / "ur_description" / "urdf" / "ur5_robot.urdf"
    tree = Tree.from_urdf(ur5, ["tool0", "base"], "base_link")
    q = tree.random_values(3, np.random.default_rng(3))
    arm = SimpleNamespace(chain=tree, mechanism=tree, joint_values=tree.joint_values)
    assert _errors(arm, q, q, {}) == {"tool0": 0.0}


def test_commands_outside_what_was_measured_are_counted(
    calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = json.loads((calibrated("elbow3r") / "result" / "calibration.json").read_text())
    document["domain"]["joints"] |= {"joint_2": [-0.3, 0.4]}
    narrow = tmp_path / "calibration.json"
    narrow.write_text(json.dumps(document))
    loaded = urdfcal.Calibration.load(narrow)
    low, high = np.array(list(loaded.document.domain.joints.values())).T
    q = np.linspace(low, high, 5)
    q[:2, 1] = [-0.1, -0.5]
    np.testing.assert_array_equal(loaded.in_domain(q), [True, False, True, True, True])
    assert loaded.in_domain(q[0]).item() is True

    given = write(tmp_path / "given.csv", loaded.chain, q)
    assert run(["compensate", str(narrow), str(given), "-o", str(tmp_path / "out.csv")]) == 0
    said = capsys.readouterr().out
    assert "1 of 5 poses lie outside the measured domain" in said
    assert "joint_2 was calibrated from -0.30 to 0.40 rad: a pose is outside" in said
    assert run(["compensate", str(narrow), str(write(given, loaded.chain, q[2:])), "-o", str(tmp_path / "o.csv")]) == 0
    assert "lie outside" not in capsys.readouterr().out

    del document["domain"]  # as files of earlier versions
    narrow.write_text(json.dumps(document))
    with pytest.raises(OutputError, match="does not hold the measured domain"):
        urdfcal.Calibration.load(narrow).in_domain(q)


@pytest.fixture(scope="module")
def bending(simulated: Callable, tmp_path_factory: pytest.TempPathFactory) -> urdfcal.Calibration:
    """An arm that sags and has play, calibrated with both."""
    session = backlash(simulated("ur5", poses=40), 2e-3, share=0.4)
    session = replace(session, joint_models={"compliance": True, "backlash": {"elbow_joint": True}})
    folder = tmp_path_factory.mktemp("bending")
    urdfcal.calibrate(session, force=True).save(folder / "calibration.json")
    return urdfcal.Calibration.load(folder)


def test_what_is_printed_of_an_arm_that_bends_is_of_its_full_model(
    bending: urdfcal.Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chain = bending.chain
    q = chain.random_values(40, np.random.default_rng(5))
    q = np.clip(q, -2.0, 2.0)
    bending.save(tmp_path / "calibration.json")
    given, written = write(tmp_path / "given.csv", chain, q), tmp_path / "out.csv"
    assert run(["compensate", str(tmp_path / "calibration.json"), str(given), "-o", str(written)]) == 0
    said = capsys.readouterr().out
    came = np.concatenate([q[:1], q[:-1]])
    commands = bending.compensate(q, previous=came)
    np.testing.assert_array_equal(
        np.array([row[1:-1][::-1] for row in [*csv.reader(written.open())][1:]], float), commands.q
    )
    miss = bending.forward(q, previous=came)[:, :3, 3] - positions(chain, q)
    rigid = positions(bending.calibrated, q) - positions(chain, q)
    of_model, of_rigid = (1e3 * np.sqrt(np.mean(np.sum(of**2, axis=1))) for of in (miss, rigid))
    assert f"{of_model:.3g} mm rms with the nominal commands" in said
    assert f"{of_model:.3g}" != f"{of_rigid:.3g}"
    assert not np.array_equal(commands.q, bending.compensate(q).q)  # the play's side is that of the row before


def test_what_the_arm_carries_is_an_argument(
    bending: urdfcal.Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bending.save(tmp_path / "calibration.json")
    chain = bending.chain
    q = np.clip(chain.random_values(20, np.random.default_rng(6)), -2.0, 2.0)
    given, written = write(tmp_path / "given.csv", chain, q), tmp_path / "out.csv"
    call = ["compensate", str(tmp_path / "calibration.json"), str(given), "-o", str(written)]
    came = np.concatenate([q[:1], q[:-1]])
    found = []
    for text, payload in (
        ("nothing", "nothing"),
        ("tool0:5", Payload("tool0", 5.0, np.zeros(3))),
        ("tool0:5:0,0.1,-0.2", Payload("tool0", 5.0, np.array([0.0, 0.1, -0.2]))),
    ):
        assert run([*call, "--payload", text]) == 0
        found.append(np.array([row[1:-1][::-1] for row in [*csv.reader(written.open())][1:]], float))
        np.testing.assert_array_equal(found[-1], bending.compensate(q, previous=came, payload=payload).q)
        miss = bending.forward(q, previous=came, payload=payload)[:, :3, 3] - positions(chain, q)
        said = f"{1e3 * np.sqrt(np.mean(np.sum(miss**2, axis=1))):.3g} mm rms with the nominal commands"
        assert said in capsys.readouterr().out
    assert np.abs(found[1] - found[0]).max() > 1e-5
    assert np.abs(found[2] - found[1]).max() > 1e-6
    written.unlink()
    for wrong, message in (
        ("tool0", "is no payload: write tool0:1.2"),
        ("tool0:heavy", "is no payload"),
        ("tool0:1:0,0", "payload"),
        ("tool0:1200", "looks like grams"),
        ("tool0:1.2:0,0,50", "look like millimetres"),
        ("hand:1", "'hand' is none of the tip links"),
    ):
        assert run([*call, "--payload", wrong]) == 2
        assert message in capsys.readouterr().err
        assert not written.exists()


def test_a_compliance_under_measured_torques_takes_those_of_the_trajectory(
    simulated: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = simulated("ur5", poses=30).session
    tau = 20.0 * np.random.default_rng(0).normal(size=session.q.shape)
    session = replace(session, torques=tau, joint_models={"compliance": True})
    calibration = urdfcal.calibrate(session, force=True)
    calibration.save(tmp_path / "calibration.json")
    chain, q = calibration.chain, session.readings[:5]
    given = write(tmp_path / "given.csv", chain, q)
    call = ["compensate", str(tmp_path / "calibration.json"), str(given), "-o", str(tmp_path / "out.csv")]
    assert run(call) == 2
    assert "--torques FILE.csv" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
    torques = write(tmp_path / "torques.csv", chain, tau[:5])
    assert run([*call, "--torques", str(torques)]) == 0
    commands = np.array([row[1:-1][::-1] for row in [*csv.reader((tmp_path / "out.csv").open())][1:]], float)
    came = np.concatenate([q[:1], q[:-1]])
    np.testing.assert_array_equal(commands, calibration.compensate(q, torques=tau[:5], previous=came).q)
    assert run([*call, "--torques", str(write(torques, chain, tau[:3]))]) == 2
    assert "torques.csv: it has 3 rows, the trajectory 5" in capsys.readouterr().err


def test_that_a_urdf_holds_the_rigid_part_alone_is_said_where_it_is_written(
    bending: urdfcal.Calibration, calibrated: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bending.save(tmp_path / "calibration.json")
    urdf = package_roots()[-1] / "example-robot-data" / "robots" / "ur_description" / "urdf" / "ur5_robot.urdf"
    for result, bends in ((tmp_path / "calibration.json", True), (calibrated("ur5") / "result", False)):
        assert run(["apply", str(result), str(urdf), "-o", str(tmp_path / f"{bends}.urdf")]) == 0
        said = capsys.readouterr().out
        assert ("no such file can hold compliance, backlash; compensate and the library do" in said) is bends
        assert run(["export", str(result), "--to", "xacro-patch", "-o", str(tmp_path / "patch")]) == 0
        said = capsys.readouterr().out
        assert ("no such file can hold compliance, backlash; compensate and the library do" in said) is bends
        q = write(tmp_path / "q.csv", bending.chain, np.zeros((2, 6)))
        call = ["compensate", str(result), str(q), "-o", str(tmp_path / f"{bends}.csv"), "--payload", "nothing"]
        assert run(call) == 0
        assert ("what it carries makes no difference" in capsys.readouterr().out) is not bends


def test_what_is_left_below_a_nanometre_is_rounding() -> None:
    assert [_thousandths(of) for of in (1.234e-4, 2e-9, 9e-10)] == ["0.123", "2e-06", "less than 1e-6"]
