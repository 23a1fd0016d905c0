"""Kill ``urdfcal calibrate`` at random moments: the four files are of one run, and the next run leaves no litter.

    python tests/benchmarks/kills.py [kills] [seed]

Two sessions of different robots' names take turns in one folder, so that a mixture shows in every file.
"""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.simulation.simulate import simulate, write_simulated

POSES = 12
KINDS = (".html", ".json", ".rrd", ".urdf")


def calibrate(session: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "urdfcal", "calibrate", str(session), "-o", str(out), "-q", "--force"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def shown(out: Path) -> dict[str, str]:
    """Hashes of the files of a result, by name, without hidden ones."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in out.glob("[!.]*")}


def signature(out: Path) -> set[str]:
    """Which sessions the files in a folder are of: they hold the robot's name."""
    seen = set()
    for path in out.glob("[!.]*"):
        data = path.read_bytes()
        for name in ("first", "second"):
            if re.search(rb"ARM_" + name.encode(), data):
                seen.add(name)
    return seen


def main(kills: int = 60, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sessions = [folder / which for which in ("first", "second")]
        for k, session in enumerate(sessions):
            write_simulated(session, simulate(read_rig(find_rig("elbow3r")), poses=POSES, seed=k))
            urdf = session / "elbow3r.urdf"
            urdf.write_text(urdf.read_text().replace('<robot name="', f'<robot name="ARM_{session.name}_', 1))
        out, took = folder / "out", []
        for session in sessions:
            began = time.perf_counter()
            assert calibrate(session, out).wait() == 0
            took.append(time.perf_counter() - began)
            assert signature(out) == {session.name}, signature(out)
        longest, mixed, partial = max(took), 0, 0
        for k in range(kills):
            process = calibrate(sessions[k % 2], out)
            # Half of them at any time, half while results are written.
            time.sleep(float(rng.uniform(0.0 if k % 4 < 2 else 0.6, 1.0)) * longest)
            process.kill()
            process.wait()
            mixed += len(signature(out)) > 1
            partial += {Path(name).suffix for name in shown(out)} != set(KINDS)
        litter_before = len([*folder.rglob(".*")])
        assert calibrate(sessions[0], out).wait() == 0
        litter = [str(path.relative_to(folder)) for path in folder.rglob(".*")]
        whole = {Path(name).suffix for name in shown(out)} == set(KINDS) and signature(out) == {"first"}
    print(
        json.dumps(
            {
                "kills": kills, "seed": seed, "run_s": round(longest, 2), "mixed": mixed, "incomplete": partial,
                "litter_before_next_run": litter_before, "litter_after_it": litter, "whole_after_it": whole,
            }
        )
    )  # fmt: skip


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
