"""A fleet's sessions: each as `calibrate` writes it, none stopped by another, nothing lost and nothing done twice."""

from __future__ import annotations

import csv
import importlib.util
import json
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from tests.study.mortals import dying, mortal
from tests.worlds import ALONE, scaled
from urdfcal.cli import run
from urdfcal.errors import OutputError, UrdfcalError
from urdfcal.io.folder import read_session
from urdfcal.io.writing import write_session
from urdfcal.study import batch as module
from urdfcal.study.batch import JOURNAL, TABLE, batch, distinct_names
from urdfcal.study.engine import each

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

QUICK = {"report": False, "processes": 1}


@pytest.fixture(scope="module")
def fleet(simulated: Callable, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two sessions that go well and one without its detections."""
    folder = tmp_path_factory.mktemp("fleet")
    sessions = [folder / name for name in ("a", "b", "broken")]
    for seed, session in enumerate(sessions):
        write_session(session, replace(simulated("elbow3r", poses=25, seed=seed % 2).session, **ALONE))
    (sessions[2] / "detections.csv").unlink()
    return sessions


def test_results_are_as_calibrate_writes_them_and_a_failure_stops_no_other(
    fleet: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["batch", *map(str, fleet), "-o", str(tmp_path / "out"), "--processes", "2"]) == 1
    printed = capsys.readouterr().out
    assert "3 sessions: 2 good, 1 failed" in printed
    for session in fleet[:2]:
        run(["calibrate", str(session), "-o", str(tmp_path / session.name), "--quiet"])
        own, alone = (tmp_path / of / session.name for of in ("out", ""))
        assert sorted(path.name for path in own.iterdir()) == sorted(path.name for path in alone.iterdir())
        documents = [json.loads((folder / "calibration.json").read_text()) for folder in (own, alone)]
        assert documents[0] == documents[1]
    assert not (tmp_path / "out" / "broken").exists()
    with (tmp_path / "out" / TABLE).open() as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    assert rows["a"]["level"] == "good"
    upper = json.loads((tmp_path / "out" / "a" / "calibration.json").read_text())["tip"]["interval_mm"][1]
    assert float(rows["a"]["tip_rms_upper_mm"]) == pytest.approx(upper)
    assert "tip rms, at" in printed
    assert float(rows["a"]["rms_mm"]) < float(rows["a"]["rms_nominal_mm"])
    assert "there is no file 'detections.csv'" in rows["broken"]["sentence"]


def test_what_is_done_is_kept_until_an_input_or_an_option_changes(
    fleet: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sessions = [tmp_path / name for name in ("a", "b")]
    for source, session in zip(fleet, sessions, strict=False):
        shutil.copytree(source, session)
    out = tmp_path / "out"
    first = batch(sessions, out, **QUICK, seed=0)
    with (out / JOURNAL).open("a") as journal:
        journal.write('{"name": "a", "sess')  # what a run that was killed leaves
    done: list[Path] = []
    writes = module.calibrate_one.__globals__["files"].staged
    monkeypatch.setattr("urdfcal.files.staged", lambda folder, *more: done.append(folder) or writes(folder, *more))
    assert batch(sessions, out, **QUICK, seed=0) == first
    assert done == []
    with (sessions[1] / "joints.csv").open("a") as joints:
        joints.write("\n")
    again = batch(sessions, out, **QUICK, seed=0)
    assert done == [out / "b"]
    assert again[0] == first[0]
    assert [one.kept for one in again] == [True, False]
    batch(sessions, out, **QUICK, seed=1)
    assert done[1:] == [out / "a", out / "b"]
    next((out / "a").glob("*.urdf")).unlink()
    batch(sessions, out, **QUICK, seed=1)
    assert done[3:] == [out / "a"]


def test_without_a_report_there_is_none_of_an_earlier_run(
    fleet: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    batch(fleet[:1], tmp_path / "out", report=True, processes=1)
    assert (tmp_path / "out" / "a" / "report.html").exists()
    (one,) = batch(fleet[:1], tmp_path / "out", **QUICK)
    assert sorted(path.suffix for path in (tmp_path / "out" / "a").iterdir()) == [".json", ".urdf"]
    assert one.well
    again = ["batch", str(fleet[0]), "-o", str(tmp_path / "out"), "--no-report", "--processes", "1"]
    assert run([*again, "--seed", "0"]) == 0
    assert run([*again, "--seed", "0"]) == 0
    assert capsys.readouterr().out.count("1 sessions: 1 good; 1 of them kept from an earlier run") == 1


def test_a_calibration_that_is_refused_has_its_report_alone(
    simulated: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_session(tmp_path / "wrong", replace(scaled(simulated("ur5", poses=40), 0.02), **ALONE))
    assert run(["batch", str(tmp_path / "wrong"), "-o", str(tmp_path / "out"), "--json", "--processes", "1"]) == 1
    (one,) = json.loads(capsys.readouterr().out)
    assert one["level"] == "bad"
    assert "all lengths come out" in one["sentence"]
    assert [
        path.relative_to(tmp_path / "out" / "wrong").as_posix() for path in (tmp_path / "out" / "wrong").rglob("*.*")
    ] == ["refused/report.html"]


def test_sessions_of_one_name_are_told_apart_by_the_folders_above(tmp_path: Path) -> None:
    paths = [tmp_path / "monday" / "arm", tmp_path / "tuesday" / "arm", tmp_path / "other"]
    assert distinct_names(paths) == ["monday-arm", "tuesday-arm", "other"]
    with pytest.raises(OutputError, match="named twice"):
        distinct_names([paths[0], paths[0]])


def test_a_journal_that_is_none_is_not_overwritten(fleet: list[Path], tmp_path: Path) -> None:
    (tmp_path / JOURNAL).mkdir(parents=True)
    with pytest.raises(OutputError, match=r"batch\.jsonl: cannot be read"):
        batch(fleet, tmp_path, **QUICK)


def lost(task: object) -> int:
    del task
    return -1


def test_a_worker_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    tasks = [(number, str(tmp_path / "mark")) for number in range(8)]
    assert dict(each(dying, tasks, lost, processes=2)) == {number: number**2 for number in range(8)}


def test_what_kills_its_worker_each_time_stops_no_other() -> None:
    assert dict(each(mortal, list(range(6)), lost, processes=2)) == {k: -1 if k == 1 else k for k in range(6)}


def test_a_session_that_kills_its_process_is_told(fleet: list[Path], tmp_path: Path) -> None:
    job = module.Job("a", fleet[0], tmp_path, {"seed": 0}, False, None)
    assert module._killed(job).level == "failed"
    assert "its process was killed" in module._killed(job).sentence


def test_a_defect_in_one_session_stops_no_other(
    fleet: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(path: Path) -> None:
        if path.name == "a":
            raise ZeroDivisionError("0 / 0")
        return read_session(path)

    monkeypatch.setattr("urdfcal.io.folder.read_session", broken)
    a, b = batch(fleet[:2], tmp_path / "out", **QUICK)
    assert (a.level, b.level) == ("failed", "good")
    assert "ZeroDivisionError: 0 / 0" in a.sentence


@pytest.mark.parametrize("engine", ["dask", "ray"])
def test_an_engine_that_is_not_there_is_named(engine: str) -> None:
    if importlib.util.find_spec({"dask": "distributed"}.get(engine, engine)) is not None:
        pytest.skip(f"{engine} is installed")
    with pytest.raises(
        UrdfcalError, match=rf"{engine} is not installed. Install it: pip install 'urdfcal\[{engine}\]'"
    ):
        list(each(abs, [1], lost, engine))


@pytest.mark.parametrize("engine", ["dask", "ray"])
def test_every_engine_has_the_same_numbers(engine: str, fleet: list[Path], tmp_path: Path) -> None:
    pytest.importorskip({"dask": "distributed"}.get(engine, engine), reason=f"urdfcal[{engine}] is not installed")
    here = batch(fleet, tmp_path / "here", **QUICK)
    there = batch(fleet, tmp_path / "there", report=False, engine=engine)
    assert [(one.level, one.rms_mm, one.tip_rms_upper_mm) for one in here] == [
        (one.level, one.rms_mm, one.tip_rms_upper_mm) for one in there
    ]


def test_a_scheduler_that_does_not_answer_is_named() -> None:
    pytest.importorskip("distributed", reason="urdfcal[dask] is not installed")
    with pytest.raises(UrdfcalError, match=r"tcp://127\.0\.0\.1:1: no scheduler answers"):
        list(each(abs, [1], lost, "dask", scheduler="tcp://127.0.0.1:1"))
