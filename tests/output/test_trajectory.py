from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.io.making import ACTUATED, write_valid
from urdfcal.errors import SessionError
from urdfcal.output.trajectory import CommandTable
from urdfcal.robot.chain import Chain

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def chain(tmp_path: Path) -> Chain:
    return Chain.from_urdf(write_valid(tmp_path / "session") / "arm.urdf", "tip", "base")


def test_what_is_no_command_stays_as_it_was(chain: Chain, tmp_path: Path) -> None:
    path = tmp_path / "given.csv"
    text = 't,roll,slide,grip,shoulder,waist\n00.10,100,0.1,7e-2,-0,0.5\n0.20,-100,0.2,,0.1,"-0.5"\n'
    path.write_text(text)
    trajectory = CommandTable.read(path, chain)
    assert trajectory.joints == ACTUATED
    np.testing.assert_array_equal(trajectory.q, [[0.5, 0.0, 0.1, 100.0], [-0.5, 0.1, 0.2, -100.0]])
    written = trajectory.with_commands(trajectory.q + 0.125)
    assert written == (
        "t,roll,slide,grip,shoulder,waist\n00.10,100.125,0.225,7e-2,0.125,0.625\n0.20,-99.875,0.325,,0.225,-0.375\n"
    )


@pytest.mark.parametrize(
    ("header", "row", "message"),
    [
        ("waist,shoulder,slide,roll,elbow", "0,0,0,0,0", r"csv:1: joint 'elbow' follows 'shoulder'"),
        ("waist,shoulder,slide,roll", "0,0,-0.1,0", r"csv:2:5: slide = -0.1 m is outside .*\[0, 0.3\]"),
        ("waist,shoulder,slide,roll", "0,0,nan,0", r"csv:2:5: slide: nan is not a finite number"),
        ("waist,shoulder,slide,waist,roll", "0,0,0,0,0", r"csv:1: the column 'waist' is named twice"),
    ],
)
def test_what_makes_no_sense_is_refused(header: str, row: str, message: str, chain: Chain, tmp_path: Path) -> None:
    path = tmp_path / "given.csv"
    path.write_text(f"{header}\n{row}\n")
    with pytest.raises(SessionError, match=message):
        CommandTable.read(path, chain)


def test_files_round_at_limits(chain: Chain, tmp_path: Path) -> None:
    path = tmp_path / "given.csv"
    path.write_text("waist,shoulder,slide,roll\n2.9000005,0,-0.0000005,0\n")
    assert CommandTable.read(path, chain).q[0, 0] > 2.9
