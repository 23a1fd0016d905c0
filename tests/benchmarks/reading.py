"""How fast a large session is read: 100,000 detections, against the raw bytes and numpy.loadtxt.

Run by hand, from the project's folder: ``python -m tests.benchmarks.reading``. The table says how long each
step takes, the best of several runs; reading and checking the session should stay well under a second.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.io.making import write_valid
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_session
from urdfcal.io.tables import read_measurements

if TYPE_CHECKING:
    from collections.abc import Callable

POSES = 25_000
"""Two cameras see two LEDs in each: 100,000 detections."""
REPEATS = 5


def best(run: Callable[[], Any]) -> float:
    """Shortest wall time of several runs. [s]"""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        session = write_valid(Path(folder), POSES)
        path = session / "detections.csv"
        poses = [str(i) for i in range(POSES)]
        known = {"pose": poses, "camera": ("left", "right"), "led": ("red", "blue")}
        steps: dict[str, Callable[[], Any]] = {
            "raw bytes": path.read_bytes,
            "numpy.loadtxt, u and v only": lambda: np.loadtxt(path, delimiter=",", skiprows=1, usecols=(3, 4)),
            "read_measurements": lambda: read_measurements(path, Detections, known, 0.1),
            "read_session": lambda: read_session(session),
        }
        seconds = {name: best(run) for name, run in steps.items()}
    reference = seconds["numpy.loadtxt, u and v only"]
    for name, taken in seconds.items():
        sys.stdout.write(f"{name:30} {1e3 * taken:8.1f} ms {taken / reference:6.2f} x loadtxt\n")


if __name__ == "__main__":
    main()
