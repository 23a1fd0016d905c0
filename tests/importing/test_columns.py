"""Tables whose columns have other names and units, from the file to the calibrated arm."""

from __future__ import annotations

import csv
import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from urdfcal.cameras.io.formats import write_kalibr
from urdfcal.cli import run
from urdfcal.files import Source
from urdfcal.importing.columns import with_commas
from urdfcal.importing.decimals import with_points
from urdfcal.io.csv_table import Table
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.kinematics import tip_poses
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.simulation.truth import Simulated

LINKS = ["--tip", "tool0", "--base", "base_link"]
T_TRACKER_BASE = np.eye(4)
T_TRACKER_BASE[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
T_TRACKER_BASE[:3, 3] = [2.0, 0.5, -0.3]


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    return simulate(read_rig(find_rig("elbow3r")), poses=25, seed=4)


@pytest.fixture
def folder(tmp_path: Path, simulated: Simulated, monkeypatch: pytest.MonkeyPatch) -> Path:
    assert simulated.session.urdf is not None
    (tmp_path / "arm.urdf").write_bytes(simulated.session.urdf.data)
    (tmp_path / "truth.urdf").write_bytes(simulated.truth.urdf)
    write_kalibr(tmp_path / "cams.yaml", simulated.session.rig)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(path: Path, columns: dict[str, list], separator: str = ",") -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file, delimiter=separator)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            cells = [f"{cell:.7f}" if isinstance(cell, float) else cell for cell in row]
            writer.writerow([cell.replace(".", ",") if separator == ";" else cell for cell in cells])


def degrees(simulated: Simulated) -> dict[str, list]:
    return {f"J{k + 1}": values for k, values in enumerate(np.degrees(simulated.session.readings).T.tolist())}


def measured(simulated: Simulated) -> tuple[np.ndarray, np.ndarray]:
    """The LED (N, 3), and the tip link's pose (N, 4, 4), in the tracker."""
    rng, truth = np.random.default_rng(0), simulated.truth
    led = truth.led_positions(truth.q)[:, 0] @ T_TRACKER_BASE[:3, :3].T + T_TRACKER_BASE[:3, 3]
    T = T_TRACKER_BASE @ tip_poses(truth.chain, truth.q, truth.placements)
    return led + rng.normal(scale=5e-5, size=led.shape), T


def improved(folder: Path, capsys: pytest.CaptureFixture[str]) -> float:
    """The tip error of the calibrated arm as a share of the nominal one's."""
    assert run(["calibrate", "s", "-o", "out"]) == 0
    capsys.readouterr()
    errors = []
    for urdf in ("arm.urdf", "out/arm_calibrated.urdf"):
        assert run(["evaluate", urdf, "truth.urdf", *LINKS, "--json"]) == 0
        errors.append(json.loads(capsys.readouterr().out)["position_mm"]["rms"])
    return errors[1] / errors[0]


@pytest.mark.no_cover
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_points_in_millimetres_and_joints_in_degrees(
    folder: Path, simulated: Simulated, separator: str, capsys: pytest.CaptureFixture[str]
) -> None:
    led, _ = measured(simulated)
    xyz = dict(zip(("X [mm]", "Y [mm]", "Z"), (1e3 * led).T.tolist(), strict=True))
    written(folder / "data.csv", {"Nr": [f"p{k}" for k in range(25)], **degrees(simulated), **xyz}, separator)
    joints = simulated.session.chain.actuated
    said = [f"--column={name}=J{k + 1}:deg" for k, name in enumerate(joints)]
    said += ["--column=pose=Nr", "--column=x=X [mm]", "--column=y=Y [mm]", "--column=z=Z:mm"]
    assert run(["import", "data.csv", "-o", "s", "--urdf", "arm.urdf", *LINKS, *said]) == 0
    printed = capsys.readouterr().out
    assert "data.csv: 25 poses, 25 points" in printed
    assert f"- {joints[0]} is column 'J1' in deg" in printed
    assert "- x is column 'X [mm]' in mm" in printed
    session = read_session(folder / "s")
    assert session.poses[3] == "p3"
    np.testing.assert_allclose(session.readings, simulated.session.readings, atol=1e-8)
    np.testing.assert_allclose(session.measurements[0].values, led, atol=1e-9)
    if separator == ",":
        assert improved(folder, capsys) < 0.1


@pytest.mark.parametrize("turn", ["quaternion", "vector", "angles"])
def test_poses_with_any_kind_of_orientation(
    folder: Path, simulated: Simulated, turn: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _, T = measured(simulated)
    R = Rotation.from_matrix(T[:, :3, :3])
    names, values = {
        "quaternion": (("qx", "qy", "qz", "qw"), R.as_quat()),
        "vector": (("rx", "ry", "rz"), R.as_rotvec()),
        "angles": (("roll", "pitch", "yaw"), np.degrees(R.as_euler("xyz"))),
    }[turn]
    table = degrees(simulated) | dict(zip("xyz", T[:, :3, 3].T.tolist(), strict=True))
    table |= dict(zip(names, values.T.tolist(), strict=True))
    table["x"][4] = table["y"][4] = table["z"][4] = ""
    for name in names:
        table[name][4] = ""  # a pose in which nothing was seen
    written(folder / "data.csv", table)
    said = {name: f"J{k + 1}:deg" for k, name in enumerate(simulated.session.chain.actuated)}
    said |= {name: f"{name}:deg" for name in names if turn == "angles"}
    (folder / "columns.yaml").write_text(yaml.safe_dump(said))
    assert run(["import", "data.csv", "-o", "s", "--urdf", "arm.urdf", *LINKS, "--columns", "columns.yaml"]) == 0
    assert "25 poses, 24 poses" in capsys.readouterr().out
    (poses,) = read_session(folder / "s").measurements
    seen = np.setdiff1d(np.arange(25), 4)
    np.testing.assert_array_equal(poses.pose, seen)
    np.testing.assert_allclose(poses.values[:, :3], T[seen, :3, 3], atol=1e-6)
    np.testing.assert_allclose((Rotation.from_quat(poses.values[:, 3:]).inv() * R[seen]).magnitude(), 0.0, atol=1e-6)


@pytest.mark.no_cover
def test_detections_of_named_cameras(folder: Path, simulated: Simulated, capsys: pytest.CaptureFixture[str]) -> None:
    table, (seen,) = degrees(simulated), simulated.session.measurements
    for c, camera in enumerate(simulated.session.rig.names):
        for k, axis in enumerate("uv"):
            cells = [""] * 25
            for row in np.flatnonzero(seen.camera == c):
                cells[seen.pose[row]] = float(seen.uv[row, k])
            table[f"{camera}.{axis}"] = cells
    written(folder / "data.csv", table)
    said = [f"--column={name}=J{k + 1}:deg" for k, name in enumerate(simulated.session.chain.actuated)]
    arguments = ["import", "data.csv", "-o", "s", "--urdf", "arm.urdf", *LINKS, *said]
    assert run(arguments) == 2
    assert "no column holds what was measured" in capsys.readouterr().err
    assert run([*arguments, "--cameras", "cams.yaml", "--led", "red"]) == 0
    assert f"{len(seen)} detections" in capsys.readouterr().out
    read = read_session(folder / "s")
    assert read.led_names == ("red",)
    np.testing.assert_allclose(read.measurements[0].values, seen.uv, atol=1e-6)
    assert improved(folder, capsys) < 0.1


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize(
    ("numbers", "options", "expected"),
    [
        (("0.5", "1,234.25", "-1,234"), [], (0.5, 1234.25, -1234)),
        (("0,5", "1.234,25", "-1,234"), [], (0.5, 1234.25, -1.234)),
        (("2", "1,234,567", "1,234"), [], (2, 1234567, 1234)),
        (("2", "1,234", "-12,345"), ["--decimal", "comma"], (2, 1.234, -12.345)),
        (("2", "1,234", "-12,345"), ["--decimal", "point"], (2, 1234, -12345)),
        (("2", "1.234", "2"), [], (2, 1.234, 2)),
        (("1,5e-1", "1.234", "2"), [], (0.15, 1234, 2)),
    ],
)
def test_commas_are_decimal_or_between_thousands(
    tmp_path: Path, separator: str, numbers: tuple[str, ...], options: list[str], expected: tuple[float, ...]
) -> None:
    with (tmp_path / "data.csv").open("w", newline="") as file:
        csv.writer(file, delimiter=separator).writerows([("x", "y", "z", "note"), (*numbers, "a, b")])
    table = Table.parse(with_commas(Source.read(tmp_path / "data.csv")), (), (), None)
    read = with_points(table, "xyz", options[1] if options else None)
    np.testing.assert_allclose(read.numbers("xyz")[0], expected, rtol=1e-15)
    assert read.columns["note"] == ["a, b"]


HEADER = "A,B,C,x,y,z"
ROWS = ["0.1,0.2,0.3,1,2,3", "0.2,0.3,0.4,1,2,3", "0.3,0.4,0.5,1,2,3"]


@pytest.mark.parametrize(
    ("header", "rows", "options", "message"),
    [
        (HEADER, ROWS, [], "data.csv:1: there is no column {0!r} for {0}. Say which it is: --column '{0}=COLUMN'."),
        (HEADER, ROWS, ["{0}=D"], "there is no column 'D' for {0}. The columns are: A, B, C, x, y, z."),
        (HEADER, ROWS, ["{0}=A", "{1}=B", "{2}=C:mm"], "column 'C': {2} cannot be in mm. It is in rad or deg"),
        (HEADER, ["0.1,0.2,x,1,2,3", *ROWS], ["{0}=A", "{1}=B", "{2}=C"], "data.csv:2:9: C: 'x' is not a number"),
        (HEADER, ["0.1,0.2,0.3,1,,3", *ROWS], ["{0}=A", "{1}=B", "{2}=C"], "data.csv:2:15: y: the cell is empty"),
        ("A,B,C,x,y", [row[:-2] for row in ROWS], ["{0}=A", "{1}=B", "{2}=C"], "there is x, y, but not z"),
        (HEADER, ROWS, ["joint9=A"], "there is nothing called 'joint9'"),
        ("A,B,C,x,y,z [cm]", ROWS, ["{0}=A", "{1}=B", "{2}=C", "z=z [cm]"], "column 'z [cm]': the unit [cm] of"),
        ("A,B,C,x,y,z", ROWS, ["{0}=A", "{1}=B", "{2}=x"], "column 'x' would be both"),
        (HEADER, ROWS[:2], ["{0}=A", "{1}=B", "{2}=C"], "2 poses are too few"),
        (
            "A,B,C,x,y,z,qx,qy,qz,qw",
            [f"{row},0,0,0,{w}" for row, w in zip(ROWS, (1, 2, 1), strict=True)],
            ["{0}=A", "{1}=B", "{2}=C"],
            "data.csv:3:19: the quaternion is of length 2, not 1",
        ),
        (
            "A,B,C,rx,ry,rz", ROWS, ["{0}=A", "{1}=B", "{2}=C"],
            "there is rx, ry, rz, but no x, y, z. Say which columns they are",
        ),
        (
            HEADER.replace(",", ";"),
            ["0;0;0;2;1,234;3", *(row.replace(",", ";").replace("0.", "") for row in ROWS)],
            ["{0}=A", "{1}=B", "{2}=C"],
            "data.csv:2:9: 1,234 may be 1.234 or 1234, and no other number tells. Say what stands before decimals",
        ),
        (
            HEADER.replace(",", ";"),
            [row.replace(",", ";") for row in ROWS] + ["0;0;0;2;1,25;3"],
            ["{0}=A", "{1}=B", "{2}=C"],
            "data.csv:2:1: 0.1 has a decimal point, where others have a decimal comma. Write all numbers alike.",
        ),
        (
            "P,A,B,C,x,y,z",
            ["a," + ROWS[0], "b," + ROWS[1], "a," + ROWS[2]],
            ["{0}=A", "{1}=B", "{2}=C", "pose=P"],
            "data.csv:4:1: the pose 'a' is in line 2 already",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(
    folder: Path,
    simulated: Simulated,
    header: str,
    rows: list[str],
    options: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = simulated.session.chain.actuated
    (folder / "data.csv").write_text("\n".join([header, *rows, ""]))
    said = [f"--column={option.format(*names)}" for option in options]
    assert run(["import", "data.csv", "-o", "s", "--urdf", "arm.urdf", *LINKS, *said]) == 2
    assert message.format(*names) in " ".join(capsys.readouterr().err.split())
    assert not (folder / "s").exists()


def test_what_is_said_of_numbers_or_of_an_led_must_be_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = read_rig(find_rig("elbow3r")).chain.actuated
    (folder / "data.csv").write_text("\n".join([HEADER + ",qx,qy,qz,qw", *(f"{row},0,0,0,1" for row in ROWS), ""]))
    said = [f"--column={name}={column}" for name, column in zip(names, "ABC", strict=True)]
    arguments = ["import", "data.csv", "-o", "s", "--urdf", "arm.urdf", *LINKS, *said]
    assert run([*arguments, "--decimal", "comma"]) == 2
    assert "0.1 has a decimal point, where others have a decimal comma. Write all numbers alike, or say" in " ".join(
        capsys.readouterr().err.split()
    )
    assert run([*arguments, "--led", "red"]) == 2
    assert "nothing of the LED 'red'. Leave --led out" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["data.csv", "-o", "s"], "--urdf is needed: a table says nothing of the robot"),
        (["data.csv", "-o", "s", "--urdf", "arm.urdf"], "--tip is needed; the links at the ends of"),
        (["data.csv", "--urdf", "arm.urdf"], "-o is needed"),
        (["data.csv", "-o", "s", "--urdf", "arm.urdf", "--column", "a"], "'a' is not NAME=COLUMN"),
        (
            ["data.csv", "-o", "s", "--urdf", "arm.urdf", "--column=a=b", "--column=a=c"],
            "two columns have the same name",
        ),
        (
            ["data.csv", "-o", "s", "--urdf", "arm.urdf", "--stills"],
            "--stills goes with a recording or a LeRobot data set: this is a table",
        ),
        (["data.csv", "--list"], "--list goes with a recording"),
        (["a.samples", "-o", "s", "--decimal", "comma"], "--decimal goes with a table: this is hand-eye samples"),
        (
            ["some.bag", "-o", "s", "--column", "a=b"],
            "--column goes with a table or a LeRobot data set: this is a recording",
        ),
        (["data.csv", "-o", "s", "--urdf", "arm.urdf", *LINKS, "--columns", "no.yaml"], "no.yaml: cannot be read"),
        (["nowhere.csv", "-o", "s", "--urdf", "arm.urdf", *LINKS], "nowhere.csv: cannot be read"),
    ],
)
def test_wrong_calls_say_what_is_wrong(
    folder: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "data.csv").write_text("a,b\n1,2\n")
    assert run(["import", *arguments]) == 2
    assert message in capsys.readouterr().err
