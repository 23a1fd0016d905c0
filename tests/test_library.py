"""What a program that imports the package sees: names, types, and no waiting."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import urdfcal
from urdfcal.errors import SessionError

if TYPE_CHECKING:
    from collections.abc import Callable

PROGRAM = """
import urdfcal

session = urdfcal.read_session("session")
calibration = urdfcal.calibrate(session, force=True)
urdfcal.calibrate("session")
urdfcal.write_session("elsewhere", session)
loaded = urdfcal.Calibration.load("result")
reveal_type(session)
reveal_type(calibration)
reveal_type(calibration.dh_offsets)
reveal_type(calibration.failures)
reveal_type(loaded.document.validation.rms_mm)
loaded.compensate(session.readings).nonsense
urdfcal.calibrate(3)
"""
# What no public name is made of would take half of the time, what functions do inside most of the rest.
SETTINGS = """[mypy]
[mypy-cv2.*,jinja2.*,pinocchio.*,rerun.*,rich.*,scipy.*,yaml.*]
follow_imports = skip
[mypy-urdfcal.*]
ignore_errors = True
"""


def test_a_type_checker_sees_the_types(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "mypy.ini").write_text(SETTINGS)
    mypy = [sys.executable, "-m", "mypy", "--strict", "--no-color-output", "--cache-dir", "cache", "program.py"]
    found = subprocess.run(mypy, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    lines = [line.split(": ", 1)[1] for line in found.stdout.splitlines() if line.startswith("program.py")]
    revealed = [line.split('"')[1] for line in lines if "Revealed type" in line]
    assert revealed[0] == "urdfcal.session.model.Session"
    assert revealed[1] == "urdfcal.result.fitted.FittedCalibration"
    assert revealed[2].startswith("numpy.ndarray[")
    assert revealed[2].endswith("| None")
    assert revealed[3].replace("builtins.", "") == "tuple[str, ...]"
    assert revealed[4].removeprefix("builtins.") == "float"
    errors = [line for line in lines if line.startswith("error")]
    assert len(errors) == 2, found.stdout + found.stderr
    assert "nonsense" in errors[0]
    assert "incompatible type" in errors[1]


def test_the_types_are_marked_as_there() -> None:
    assert (Path(urdfcal.__file__).parent / "py.typed").is_file()


def test_completion_shows_the_public_names_and_no_others() -> None:
    assert [name for name in dir(urdfcal) if not name.startswith("__")] == urdfcal.__all__
    for name in urdfcal.__all__:
        assert getattr(urdfcal, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        urdfcal.nonsense  # noqa: B018


def test_nothing_is_imported_before_it_is_used() -> None:
    code = "import sys, urdfcal; dir(urdfcal); print(*{'numpy', 'pinocchio', 'pydantic', 'scipy'} & sys.modules.keys())"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split() == []
    code = "import sys; from urdfcal.result.calibration import Calibration; print('pydantic' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


@pytest.mark.parametrize("kind", [str, Path])
def test_a_session_is_written_read_and_calibrated_by_its_path(
    kind: type[str] | type[Path], simulated: Callable, tmp_path: Path
) -> None:
    session, folder = simulated("elbow3r").session, kind(tmp_path / "session")
    urdfcal.write_session(folder, session)
    found = urdfcal.calibrate(folder)
    np.testing.assert_array_equal(found.placements, urdfcal.calibrate(session).placements)
    assert urdfcal.read_session(folder).poses == session.poses
    with pytest.raises(SessionError):
        urdfcal.calibrate(kind(tmp_path / "nowhere"))
