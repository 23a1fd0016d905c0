from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.io.broken import BROKEN, Broken
from tests.io.making import write_points, write_valid
from urdfcal.errors import UrdfcalError
from urdfcal.io.folder import read_session

if TYPE_CHECKING:
    from pathlib import Path


def test_unbroken_they_read_without_a_warning(tmp_path: Path) -> None:
    assert read_session(write_valid(tmp_path / "cameras")).warnings == ()
    assert read_session(write_points(tmp_path / "tracker")).warnings == ()


def test_the_table_is_long_and_its_names_are_different() -> None:
    assert len({broken.name for broken in BROKEN}) == len(BROKEN) >= 40


@pytest.mark.parametrize("broken", BROKEN, ids=lambda broken: broken.name)
def test_says_what_is_wrong_and_where(broken: Broken, tmp_path: Path) -> None:
    folder = write_valid(tmp_path / "session")
    broken.edit(folder)
    before = {path: path.read_bytes() for path in folder.rglob("*")}
    with pytest.raises(UrdfcalError) as caught:
        read_session(folder)
    assert broken.expect in str(caught.value)
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)
    assert {path: path.read_bytes() for path in folder.rglob("*")} == before
