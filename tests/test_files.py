from __future__ import annotations

import errno
from typing import TYPE_CHECKING

import pytest

from urdfcal.errors import OutputError
from urdfcal.files import replacing, staged, write_text

if TYPE_CHECKING:
    from pathlib import Path


def test_a_file_is_written_whole_and_readable_by_others(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "first")
    write_text(tmp_path / "a.txt", "zweite Ä")
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "zweite Ä"
    assert (tmp_path / "a.txt").stat().st_mode & 0o444 == 0o444
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_failed_block_leaves_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")

    def fail() -> None:
        with replacing(tmp_path / "a.txt") as temporary:
            temporary.write_text("new")
            raise ValueError("on purpose")

    with pytest.raises(ValueError, match="on purpose"):
        fail()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_full_disk_is_told(tmp_path: Path) -> None:
    def fill() -> None:
        with staged(tmp_path / "out") as stage:
            (stage / "a").write_text("a")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match=r"No space left on device.*Make room"):
        fill()
    assert not list(tmp_path.iterdir())


def test_a_folder_appears_only_when_all_is_done(tmp_path: Path) -> None:
    with staged(tmp_path / "out") as stage:
        (stage / "a").write_text("a")
        assert not (tmp_path / "out").exists()
    assert (tmp_path / "out" / "a").read_text() == "a"
    with staged(tmp_path / "out") as stage:
        (stage / "b").write_text("b")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"a", "b"}


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file: cannot write here: it is a file"), staged(tmp_path / "file"):
        pass
    with pytest.raises(OutputError, match="cannot write here"):
        write_text(tmp_path / "nowhere" / "a.txt", "a")
