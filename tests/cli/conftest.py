from __future__ import annotations

import io
from contextlib import redirect_stdout
from functools import cache
from typing import TYPE_CHECKING

import pytest

from urdfcal.cli import run

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(scope="session")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """A folder with session/, truth included, and result/ of a rig, by the real commands; made once a rig."""

    @cache
    def make(rig: str) -> Path:
        folder = tmp_path_factory.mktemp(rig)
        with redirect_stdout(io.StringIO()):  # a test looks at what its own commands print
            assert run(["simulate", rig, "-o", str(folder / "session")]) == 0
            assert run(["calibrate", str(folder / "session"), "-o", str(folder / "result"), "-q"]) == 0
        return folder

    return make


@pytest.fixture(scope="session")
def small_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of a dozen poses, truth included, to be calibrated where it matters not how well; made once."""
    folder = tmp_path_factory.mktemp("small") / "session"
    with redirect_stdout(io.StringIO()):
        assert run(["simulate", "elbow3r", "-o", str(folder), "--poses", "12"]) == 0
    return folder
