from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.io.making import write_points, write_valid
from tests.io.test_frame_tables import write_moving

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A valid session: two cameras see two LEDs."""
    return write_valid(tmp_path / "session")


@pytest.fixture
def tracked(tmp_path: Path) -> Path:
    """The same, measured by a tracker."""
    return write_points(tmp_path / "tracked")


@pytest.fixture
def moving(tmp_path: Path) -> Path:
    """The same arm filmed in motion."""
    return write_moving(tmp_path / "moving")
