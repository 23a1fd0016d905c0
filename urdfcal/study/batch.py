"""Calibrate many sessions, each on its own, with a journal that an interrupted run goes on from."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from urdfcal import files
from urdfcal.errors import OutputError, UrdfcalError
from urdfcal.study.engine import each

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from urdfcal.study.engine import Engine

# What numbers that cannot be make libraries raise.
_DEFECTS = (ArithmeticError, AttributeError, LookupError, MemoryError, OSError, RuntimeError, TypeError, ValueError)
JOURNAL, TABLE = "batch.jsonl", "batch.csv"
"""Files, in the folder of the results: a line for each session that ended, and a table of all."""


@dataclass(frozen=True)
class Ended:
    """How the calibration of one session ended.

    Attributes:
        name: of its folder in that of the results.
        session: where it was read from.
        level: good, doubtful or bad as its assessment; failed where there is no result.
        sentence: of its assessment, or what failed.
        poses: how many it has.
        rms_nominal_mm: error on held-out poses, of the nominal arm.
        rms_mm: of the calibrated one.
        tip_rms_upper_mm: upper end of the 95 % interval of the tip's claimed rms error over the workspace.
        seconds: that it took.
        how: options of the calibration, and hash of every input file.
        kept: whether that was in an earlier run.
    """

    name: str
    session: str
    level: str
    sentence: str
    poses: int | None = None
    rms_nominal_mm: float | None = None
    rms_mm: float | None = None
    tip_rms_upper_mm: float | None = None
    seconds: float = 0.0
    how: Mapping[str, Any] = field(default_factory=dict)
    kept: bool = field(default=False, compare=False)

    @property
    def well(self) -> bool:
        """Whether there is a result that its own checks do not refuse."""
        return self.level in ("good", "doubtful")


@dataclass(frozen=True)
class Job:
    """One session to calibrate.

    Attributes:
        name: of its folder in that of the results.
        session: where it is.
        folder: of its results.
        options: of :func:`urdfcal.pipeline.calibrate`.
        report: whether report and recording are written, which take longer than the calibration.
        before: how it ended in an earlier run.
    """

    name: str
    session: Path
    folder: Path
    options: Mapping[str, Any]
    report: bool
    before: Ended | None


def batch(
    sessions: Sequence[Path],
    output: Path,
    *,
    report: bool = True,
    engine: Engine = "processes",
    processes: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], object] | None = None,
    **options: Any,
) -> tuple[Ended, ...]:
    """Calibrate sessions side by side and write each one's results to a folder of its own.

    What an earlier run ended with, of the same inputs and options, is kept.

    Args:
        sessions: their folders.
        output: folder of the results, made if need be; with a cluster one that all workers see.
        report: whether report and recording are written.
        engine: what runs them.
        processes: how many at a time, on this machine.
        scheduler: address of a Dask scheduler.
        progress: called with the number of sessions that ended since the last call.
        **options: of :func:`urdfcal.pipeline.calibrate`, and ``force``.

    Returns:
        How each ended, in their order.

    Raises:
        OutputError: the folder cannot be written.
        UrdfcalError: the engine fails.
    """
    names = distinct_names(sessions)
    with files.told(output):
        output.mkdir(parents=True, exist_ok=True)
    before = _read(output / JOURNAL)
    jobs = [
        Job(name, session.absolute(), (output / name).absolute(), options, report, before.get(name))
        for name, session in zip(names, sessions, strict=True)
    ]
    ended: dict[int, Ended] = {}
    for k, one in each(calibrate_one, jobs, _killed, engine, processes=processes, scheduler=scheduler):
        ended[k] = one
        # One line at a time: of a run that is killed all that ended is known.
        with files.told(output / JOURNAL), (output / JOURNAL).open("a", encoding="utf-8") as journal:
            journal.write(json.dumps(asdict(one)) + "\n")
        if progress is not None:
            progress(1)
    table = tuple(ended[k] for k in range(len(jobs)))
    files.write_text(output / TABLE, "".join(_csv(table)))
    return table


def calibrate_one(job: Job) -> Ended:
    """Calibrate one session and write its results; whatever is wrong with it is how it ended."""
    from urdfcal.io.folder import read_session
    from urdfcal.output.findings import Overview
    from urdfcal.output.recording import write_refused, write_results
    from urdfcal.pipeline import calibrate

    start, how = time.perf_counter(), {**job.options, "report": job.report, "urdfcal": version("urdfcal")}
    options = {name: value for name, value in job.options.items() if name != "force"}

    def end(level: str, sentence: str, **figures: Any) -> Ended:
        return Ended(
            job.name, str(job.session), level, sentence, seconds=time.perf_counter() - start, how=how, **figures
        )

    try:
        session = read_session(job.session)
        how["sha256"] = dict(session.sha256)
        if job.before is not None and job.before.how == how and (not job.before.well or _is_whole(job)):
            return replace(job.before, kept=True)
        calibration = calibrate(session, **options, force=True)
        validation, tip = calibration.document.validation, calibration.document.tip
        figures = {
            "poses": calibration.document.fit.poses,
            "rms_nominal_mm": validation.rms_nominal_mm,
            "rms_mm": validation.rms_mm,
            "tip_rms_upper_mm": None if tip is None else tip.interval_mm[1],
        }
        if calibration.failures and not job.options.get("force"):
            if job.report:
                write_refused(calibration, job.folder)
            return end("bad", "; ".join(calibration.failures), **figures)
        write_results(calibration, job.folder, Overview.of(calibration) if job.report else None)
    except UrdfcalError as error:
        return end("failed", str(error))
    except _DEFECTS as error:  # in one session of a thousand, a defect of ours must not stop the others
        what = f"{type(error).__name__}: {error}. `urdfcal calibrate {job.session}` shows where"
        return end("failed", f"{what}: please report it")
    return end(calibration.assessment.level, "; ".join(calibration.assessment.reasons), **figures)


def _is_whole(job: Job) -> bool:
    """Whether the results of an earlier run are all there."""
    files.settle(job.folder)
    there = {path.suffix for path in job.folder.iterdir()} if job.folder.is_dir() else set()
    return {".json", ".urdf", *((".html", ".rrd") if job.report else ())} <= there


def _killed(job: Job) -> Ended:
    """How a session ended whose process was killed, though it had the machine to itself."""
    what = "its process was killed, twice: it needs more memory than there is, or a library crashed"
    return Ended(job.name, str(job.session), "failed", what, how={**job.options})


def distinct_names(sessions: Sequence[Path]) -> list[str]:
    """Name sessions after their folders, and the folders above where these are alike.

    Raises:
        OutputError: one is there twice.
    """
    parts = [[part for part in path.resolve().parts if part != path.anchor] for path in sessions]
    names = ["-".join(of[-1:]) for of in parts]
    for depth in range(2, max(map(len, parts), default=0) + 1):
        twice = {name for name in names if names.count(name) > 1}
        names = ["-".join(of[-depth:]) if name in twice else name for of, name in zip(parts, names, strict=True)]
    for name, path in zip(names, sessions, strict=True):
        if names.count(name) > 1:
            raise OutputError("the session is named twice", where=str(path), remedy="Name each once.")
    return names


def _read(journal: Path) -> dict[str, Ended]:
    """How sessions ended in an earlier run; a line that was cut short counts for nothing."""
    known = {entry.name for entry in fields(Ended)}
    ended = {}
    try:
        lines = journal.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        remedy = "Remove it, or name another folder."
        raise OutputError(f"cannot be read: {error}", where=str(journal), remedy=remedy) from error
    for line in lines:
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        if isinstance(entry, dict) and set(entry) == known:
            ended[str(entry["name"])] = Ended(**entry)
    return ended


def _csv(table: Sequence[Ended]) -> Iterator[str]:
    names = [entry.name for entry in fields(Ended) if entry.name != "how"]
    yield ",".join(names) + "\n"
    for one in table:
        cells = ["" if (value := getattr(one, name)) is None else str(value) for name in names]
        yield (
            ",".join('"' + cell.replace('"', '""') + '"' if set(cell) & set('",\n') else cell for cell in cells) + "\n"
        )
