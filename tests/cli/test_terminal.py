"""What commands print on a terminal of 80 columns."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import pytest

from urdfcal.cli import cli, run
from urdfcal.cli.console import progress_bar
from urdfcal.cli.summary import _in_brackets
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.simulation.simulate import simulate, write_simulated

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

WIDTH = 80


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard output is taken for a terminal of 80 columns."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", str(WIDTH))


def shown(text: str) -> list[str]:
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).splitlines()


@pytest.mark.usefixtures("terminal")
def test_a_summary_fits_and_nothing_of_it_is_cut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_simulated(tmp_path / "s", simulate(read_rig(find_rig("ur5")), poses=20, seed=1))
    described = tmp_path / "s" / "session.yaml"
    text = described.read_text()
    described.write_text(re.sub(r"pixel: [0-9.]+", "pixel: 0.06", text))  # a reason to be doubtful
    assert described.read_text() != text
    assert run(["calibrate", str(tmp_path / "s"), "-o", str(tmp_path / "o"), "--exclude-poses", "01"]) == 0
    lines = shown(capsys.readouterr().out)
    text = "\n".join(lines)
    assert "\N{HORIZONTAL ELLIPSIS}" not in text
    assert "..." not in text
    assert all(len(line) <= WIDTH for line in lines if str(tmp_path) not in line)
    document = json.loads((tmp_path / "o" / "calibration.json").read_text())
    joined = " ".join(text.split())
    for said in (
        "rms error on held-out poses, nominal -> calibrated",
        "where whole regions were held out",
        "mm at the tip",
    ):
        assert said in joined
    assert document["verdict"]["reasons"]
    for reason in document["verdict"]["reasons"]:
        assert f"! {reason}" in joined
    estimated = {entry["joint"] for entry in document["dh"]}
    rows = {line.split()[0]: line.split()[1:] for line in lines if line.split() and line.split()[0] in estimated}
    assert rows.keys() == estimated
    for joint, cells in rows.items():  # each value with its deviation, whole and in its own cell
        free = [entry for entry in document["dh"] if entry["joint"] == joint and entry["status"] == "estimated"]
        assert cells == [_in_brackets(1e3 * entry["offset"], 1e3 * entry["sigma"]) for entry in free]


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (2.5281, 0.0514, "2.528(51)"),
        (-2.8024, 0.171, "-2.80(17)"),
        (-0.00004, 0.0204, "-0.000(20)"),
        (0.5, 0.00012, "0.500(0)"),
        (63.84, 12.3, "64(12)"),
        (6384.2, 123.4, "6384(123)"),
        (1.0, 0.0999, "1.00(10)"),
        (1.0, 0.0, "1.000(0)"),
    ],
)
def test_the_deviation_is_in_units_of_the_last_digit(value: float, sigma: float, text: str) -> None:
    assert _in_brackets(value, sigma) == text


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("total", [10, None])
def test_a_bar_ends_with_all_of_it(total: int | None, capsys: pytest.CaptureFixture[str]) -> None:
    """Planning needs fewer steps than it may take, and what is told in a plan is not counted at all."""
    with progress_bar("planning", total) as advance:
        advance(3)
    bars = [line for line in re.split(r"[\r\n]", "\n".join(shown(capsys.readouterr().err))) if "planning" in line]
    assert "100%" in bars[-1]


@pytest.mark.usefixtures("terminal")
def test_help_lists_whole_sentences(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    text = capsys.readouterr().out
    joined = "".join(text.split())
    for command in cli.commands.values():
        assert "".join(command.get_short_help_str(1000).split()) in joined


@pytest.mark.usefixtures("terminal")
def test_no_digit_of_a_row_is_cut(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["dh", "package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf", "--tip", "tool0"]) == 0
    lines = shown(capsys.readouterr().out)
    assert all(len(line) <= WIDTH for line in lines)
    assert "\N{HORIZONTAL ELLIPSIS}" not in "".join(lines)
    numbers = [line.split()[2:] for line in lines if "revol" in line]
    assert len(numbers) == 6
    assert all(len(row) == 5 and all(re.fullmatch(r"-?\d+\.\d{3,4}", cell) for cell in row) for row in numbers)


def test_of_an_arm_of_many_rows_it_is_said_where_its_offsets_are(
    simulated: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_simulated(tmp_path / "s", simulated("tiago_dual", poses=40))
    assert run(["calibrate", str(tmp_path / "s"), "-o", str(tmp_path / "r"), "--force"]) == 0
    assert "16 rows of offsets: in the report and in calibration.json" in capsys.readouterr().out
