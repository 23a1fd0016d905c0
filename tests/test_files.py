from __future__ import annotations

import errno
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from urdfcal.errors import OutputError
from urdfcal.files import replacing, settle, staged, write_text

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
    with pytest.raises(OutputError, match="it is a folder"):
        write_text(tmp_path, "a")
    with pytest.raises(OutputError, match="cannot write here"):
        write_text(tmp_path / "nowhere" / "a.txt", "a")


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def killed(code: str, folder: Path) -> None:
    """Run Python that works on ``folder`` and kills itself."""
    text = f"import os, signal\nfrom pathlib import Path\nfrom urdfcal import files\nfolder = Path({str(folder)!r})\n"
    kill = "\ndef kill(*_): os.kill(os.getpid(), signal.SIGKILL)\n"
    assert subprocess.run([sys.executable, "-c", text + kill + code], check=False).returncode == -signal.SIGKILL


WRITE = """
with files.staged(folder, ["c"]) as stage:
    for name in "ab":
        (stage / name).write_text("new")
"""


def put(folder: Path, text: str, *of: str) -> None:
    folder.mkdir(exist_ok=True)
    for name in of:
        (folder / name).write_text(text)


@pytest.mark.parametrize("there", [True, False])
def test_what_a_killed_process_has_begun_is_cleaned_up_by_the_next(there: bool, tmp_path: Path) -> None:
    out = tmp_path / "out"
    if there:
        put(out, "old", "a", "b", "c", "mine")
    killed(WRITE + "    kill()", out)
    assert len(list(tmp_path.rglob(".*.partial"))) == 1
    if there:
        assert {path.read_text() for path in out.iterdir() if path.is_file()} == {"old"}
    with staged(out) as stage:
        (stage / "a").write_text("newest")
    assert names(tmp_path) == {"out"}
    assert names(out) == ({"a", "b", "c", "mine"} if there else {"a"})


@pytest.mark.parametrize("calls", range(7))
def test_a_process_killed_while_files_are_put_there_leaves_no_mixture(calls: int, tmp_path: Path) -> None:
    """After so many of its three removals and two renames in the folder, and of its commit before them."""
    out = tmp_path / "out"
    put(out, "old", "a", "b", "c", "mine")
    count = f"""
left = [{calls}]
for cls, method in ((Path, "unlink"), (Path, "replace"), (Path, "rename")):
    def counting(self, *args, call=getattr(cls, method), **kw):
        if not left[0]:
            kill()
        left[0] -= 1
        return call(self, *args, **kw)
    setattr(cls, method, counting)
"""
    killed(count + WRITE, out)
    shown = [path for path in out.iterdir() if path.is_file() and path.name != "mine"]
    assert len({path.read_text() for path in shown}) <= 1
    whole = len(shown) == 3 if calls == 0 else None
    settle(out)
    assert names(out) - {"mine"} == ({"a", "b", "c"} if whole else {"a", "b"}) | {
        path.name for path in out.glob(".*.partial")
    }
    assert {path.read_text() for path in out.iterdir() if path.is_file() and path.name != "mine"} == {
        "old" if whole else "new"
    }
    with staged(out) as stage:
        (stage / "d").write_text("d")
    assert not list(out.glob(".*"))
    assert (out / "mine").read_text() == "old"


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        ('["../precious.txt"]', r"'../precious.txt', which is no file's name there. Remove .urdfcal.12345678.whole"),
        ('["b", "figures/../../precious.txt"]', "no file's name there"),
        ('["PLACE/precious.txt"]', "no file's name there"),
        ('["mine/precious.txt"]', "no file's name there"),
        ('["b", 3]', "has 3, which"),
        ('[""]', "has '', which"),
        (r'["b\u0000"]', "no file's name there"),
        ('"b"', "is no list"),
        ('["b"', "is not JSON"),
        ("[" * 100_000, "is not JSON"),
    ],
)
def test_files_that_others_list_as_replaced_are_not_removed(listed: str, message: str, tmp_path: Path) -> None:
    """A folder of results may come from anybody."""
    out, whole = tmp_path / "out", tmp_path / "out/.urdfcal.12345678.whole"
    put(tmp_path, "old", "precious.txt")
    put(out, "old", "b")
    put(out / "mine", "old", "precious.txt")
    put(whole, "new", "b")
    put(whole / "figures", "new", "x.svg")
    (whole / ".replaced.json").write_text(listed.replace("PLACE", str(tmp_path)))
    with pytest.raises(OutputError, match=message):
        settle(out)
    assert {path.read_text() for path in (tmp_path / "precious.txt", out / "b", out / "mine/precious.txt")} == {"old"}


@pytest.mark.parametrize("link", ["whole", "new", "old"])
def test_links_that_others_made_are_not_followed(link: str, tmp_path: Path) -> None:
    out, whole = tmp_path / "out", tmp_path / "out/.urdfcal.12345678.whole"
    put(tmp_path / "private", "old", "x.svg")
    out.mkdir()
    places = {"whole": whole, "new": whole / "figures", "old": out / "figures"}
    if link != "whole":
        put(whole, "new", "b")
    for place in (whole / "figures", out / "figures") if link != "whole" else ():
        if place != places[link]:
            put(place, "new", "x.svg")
    places[link].symlink_to(tmp_path / "private")
    with pytest.raises(OutputError, match="is a link"):
        settle(out)
    assert (tmp_path / "private/x.svg").read_text() == "old"


def test_a_folder_in_the_way_of_a_file_is_found_before_anything_is_put_there(tmp_path: Path) -> None:
    put(tmp_path, "old", "a")
    (tmp_path / "figures/x.svg").mkdir(parents=True)

    def write(joined: str | None, replaced: tuple[str, ...] = ()) -> None:
        with staged(tmp_path, replaced, joined) as stage:
            put(stage, "new", "a")
            if joined:
                put(stage / joined, "new", "x.svg")

    with pytest.raises(OutputError, match=r"figures/x.svg is a folder"):
        write("figures")
    with pytest.raises(OutputError, match="figures is a folder"):
        write(None, ("figures",))
    assert names(tmp_path) == {"a", "figures"}
    assert (tmp_path / "a").read_text() == "old"


def test_what_a_living_process_writes_is_left_alone(tmp_path: Path) -> None:
    with staged(tmp_path / "out") as first:
        (first / "a").write_text("a")
        with staged(tmp_path / "out") as second:
            (second / "b").write_text("b")
        assert first.exists()
    assert names(tmp_path / "out") == {"a", "b"}


def test_a_file_that_a_killed_process_was_writing_goes_with_the_next(tmp_path: Path) -> None:
    killed("with files.replacing(folder / 'a.txt') as new:\n    new.write_text('half')\n    kill()", tmp_path)
    put(tmp_path, "mine", ".a.txt", ".a.txt.12345678")
    assert len(names(tmp_path)) == 3
    write_text(tmp_path / "a.txt", "whole")
    assert names(tmp_path) == {"a.txt", ".a.txt", ".a.txt.12345678"}
