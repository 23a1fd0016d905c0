"""What a fleet's sessions cost, on every engine, and whether a worker that is killed loses anything.

    python -m tests.benchmarks.fleet [--sessions 1000] [--poses 50] [--engines processes dask ray] [--kills 3]

ur5, panda and so101 take turns; no reports. Seconds are those of the processors, which other programs disturb less, of
all processes of a run, its start included (Ray's workers are no children of it: theirs are not known); the efficiency
of 2 processes is that against 1 by these, and by the clock. Asked for: at most 0.8 s
of one core a session, an efficiency of 0.9, the same numbers everywhere.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.simulation.simulate import simulate, write_simulated
from urdfcal.study.batch import JOURNAL

RIGS = ("ur5", "panda", "so101")


def started(sessions: Path, out: Path, *options: str) -> subprocess.Popen[bytes]:
    """A run of the command."""
    names = sorted(map(str, sessions.iterdir()))
    command = [sys.executable, "-m", "urdfcal", "batch", *names, "-o", str(out), "--no-report", *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def results(out: Path) -> dict[str, str]:
    """Every session's calibration.json, and how those ended that have none."""
    lines = [json.loads(line) for line in (out / JOURNAL).read_text().splitlines()]
    files = {path.parent.name: path.read_text() for path in out.glob("*/calibration.json")}
    return {one["name"]: files.get(one["name"], one["level"] + one["sentence"]) for one in lines}


def timed(sessions: Path, out: Path, *options: str) -> tuple[float, float]:
    """Seconds of the processors and of the clock that a run takes."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    started(sessions, out, *options).wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, time.perf_counter() - start


def killed(sessions: Path, out: Path, kills: int) -> int:
    """Run with two processes, of which one is killed now and then; say how often."""
    run, count = started(sessions, out, "--processes", "2"), 0
    rng = np.random.default_rng(0)
    while run.poll() is None:
        time.sleep(rng.uniform(0.5, 1.5))
        ended = len((out / JOURNAL).read_text().splitlines()) if (out / JOURNAL).exists() else 0
        if count < kills and ended > (count + 1) * len(list(sessions.iterdir())) // (kills + 2):
            workers = [int(pid) for pid in _children(run.pid) if "popen_loky" in _command(pid)]
            if workers:
                os.kill(int(rng.choice(workers)), signal.SIGKILL)
                count += 1
    return count


def _children(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


def _command(pid: str) -> str:
    path = Path(f"/proc/{pid}/cmdline")
    return path.read_text() if path.exists() else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sessions", type=int, default=1000)
    parser.add_argument("--poses", type=int, default=50)
    parser.add_argument("--engines", nargs="*", default=["processes", "dask", "ray"])
    parser.add_argument("--kills", type=int, default=3)
    arguments = parser.parse_args()
    count = arguments.sessions
    with tempfile.TemporaryDirectory() as folder:
        sessions, outs = Path(folder) / "sessions", Path(folder) / "out"
        sessions.mkdir(), outs.mkdir()
        for k in range(count):
            rig = read_rig(find_rig(RIGS[k % len(RIGS)]))
            write_simulated(sessions / f"s{k:04d}", simulate(rig, seed=k, poses=arguments.poses))
        alone, clock = timed(sessions, outs / "1", "--processes", "1")
        reference = results(outs / "1")
        print(f"{'run':16}{'s a session':>12}{'by the clock':>14}{'efficiency':>12}{'by the clock':>14}{'others':>8}")
        print(f"{'1 process':16}{alone / count:12.2f}{clock / count:14.2f}{'':34}", flush=True)
        for engine in arguments.engines:
            own, its = timed(sessions, outs / engine, "--engine", engine, "--processes", "2")
            others = sum(of != reference[name] for name, of in results(outs / engine).items())
            print(
                f"{engine:16}{own / count:12.2f}{its / count:14.2f}{alone / own:12.2f}{clock / its / 2:14.2f}{others:8}"
            )
            sys.stdout.flush()
        times = killed(sessions, outs / "killed", arguments.kills)
        found = results(outs / "killed")
        others = sum(found.get(name) != of for name, of in reference.items())
        print(f"{times} workers killed: {len(found)} of {count} sessions ended, {others} otherwise")


if __name__ == "__main__":
    main()
