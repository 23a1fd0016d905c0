"""The how-tos: every command in them is one, and what is quick does what they say."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
import pytest

import urdfcal
from urdfcal.cli import cli, guide, run

if TYPE_CHECKING:
    from collections.abc import Callable

PATHS = sorted((Path(urdfcal.__file__).parent / "guide").glob("*.md"))


def commands(text: str) -> list[list[str]]:
    """Those in blocks, and those in tables."""
    blocks = re.findall(r"^ *```sh\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    return [shlex.split(line) for line in (*lines, *re.findall(r"\| `(urdfcal [^`]*)`", text))]


def test_every_topic_is_a_file() -> None:
    assert {path.stem for path in PATHS} == set(guide.TOPICS)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_every_command_is_one(path: Path) -> None:
    found = commands(path.read_text())
    assert len(found) >= 3
    for words in found:
        assert words[0] == "urdfcal"
        group: click.Command = cli
        rest = words[1:]
        while isinstance(group, click.Group):
            context = click.Context(group)
            name, group, rest = group.resolve_command(context, rest)  # type: ignore[assignment]
            assert group is not None, words
            if isinstance(group, click.Group) and (not rest or rest[0] not in group.commands):
                rest = ["calibrate", *rest]  # `urdfcal cameras FOLDER`
        group.make_context(name or "", rest)  # unknown options and missing arguments are errors


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_pictures_and_topics_that_are_named_are_there(path: Path) -> None:
    text = path.read_text()
    for picture in re.findall(r"!\[[^]]*\]\(([^)]*)\)", text):
        assert (path.parent / picture).is_file(), picture
    assert set(re.findall(r"urdfcal guide ([\w-]+)", text)) <= set(guide.TOPICS)
    assert max(map(len, text.splitlines())) <= 220


def test_yaml_in_them_is_what_sessions_take(tmp_path: Path) -> None:
    import yaml

    from urdfcal.io.schema import SessionFile
    from urdfcal.io.yaml_document import Document

    blocks = [
        block
        for path in PATHS
        for block in re.findall(r"^```yaml\n(.*?)```", path.read_text(), re.DOTALL | re.MULTILINE)
    ]
    assert len(blocks) >= 3
    for block in blocks:
        keys = yaml.safe_load(block)
        rest = {"robot": {"urdf": "r.urdf", "tip_link": "tool0"}, "leds": {"led": {}}, "joints": "joints.csv",
                "cameras": "cameras.yaml", "detections": "d.csv", "contacts": "c.csv"}  # fmt: skip
        missing = {key: value for key, value in rest.items() if key not in keys}
        (tmp_path / "session.yaml").write_text(yaml.safe_dump(missing) + block)
        Document.read(tmp_path / "session.yaml").validate(SessionFile)


def test_the_first_arm_works_as_written_and_comes_to_the_figures_that_are_explained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    quick = [words[1:] for words in commands(guide.read("first-arm")) if words[1] in ("simulate", "calibrate")]
    assert [words[0] for words in quick[:2]] == ["simulate", "calibrate"]
    for words in quick[:2]:
        assert run(words) == 0, words
    assert (tmp_path / "result" / "report.html").is_file()
    printed = capsys.readouterr().out
    figures = re.findall(r"^\| `([^`]*\d[^`]*)` \|", guide.read("first-arm"), re.MULTILINE)
    assert len(figures) == 5
    for figure in figures:
        words = re.escape(re.sub(r"\d+\.\d+", "#", figure)).replace("\\#", "#").replace("#", r"(\d+\.\d+)")
        found = re.search(
            words.replace(r"mm\ rms\ error", r"mm.*rms\ error").replace(r"rms\ expected", "rms.*expected"), printed
        )
        assert found, figure
        assert [float(x) for x in found.groups()] == pytest.approx(
            list(map(float, re.findall(r"\d+\.\d+", figure))), rel=0.1
        )


def test_the_program_of_my_stack_runs(
    calibrated: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("session", "result"):
        (tmp_path / name).symlink_to(calibrated("elbow3r") / name)
    monkeypatch.chdir(tmp_path)
    (program,) = re.findall(r"^```python\n(.*?)```", guide.read("my-stack"), re.DOTALL | re.MULTILINE)
    names: dict[str, Any] = {}
    exec(program, names)  # noqa: S102  # our own
    assert names["commands"].shape == names["readings"].shape
    assert np.abs(names["q"] - names["readings"]).max() < 0.1


def test_it_is_shown_on_a_terminal_and_kept_from_a_pipe(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(["guide"]) == 0
    listed = capsys.readouterr().out
    assert all(f"urdfcal guide {topic}" in listed for topic in guide.TOPICS)
    assert max(map(len, listed.splitlines())) <= 80
    assert run(["guide", "boards"]) == 0
    assert capsys.readouterr().out == guide.read("boards")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    for topic in guide.TOPICS:
        assert run(["guide", topic]) == 0
        lines = re.sub(r"\x1b[\[\]][0-9;?]*[A-Za-z]", "", capsys.readouterr().out).splitlines()
        assert max(map(len, lines)) <= 80
        assert not any("![" in line for line in lines)
    assert run(["guide", "nonsense"]) == 2
    assert "first-arm" in capsys.readouterr().err


def test_every_key_of_a_session_and_of_a_rig_is_in_its_guide() -> None:
    from urdfcal.io.schema import RigFile, SessionFile

    text = guide.read("session")
    assert not [key for model in (SessionFile, RigFile) for key in model.model_fields if key not in text]
