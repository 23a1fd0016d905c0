"""How long commands take beside the imports that they cannot do without.

    python tests/benchmarks/startup.py [--runs 7] [--rig ur5] [--cpu] [--imports]

- calibrate: `urdfcal calibrate` of a simulated session of 50 poses with all its outputs, over the bare imports of the
  libraries that it uses, in one process.
- help: `urdfcal --help` over `import numpy`.

Every run is a process of its own. The two of a pair take turns, after one run of each that does not count (files come
into memory, bytecode is written), and the medians are compared: the machine's speed cancels out. ``--cpu`` counts the
processes' own time, for a machine that is not yours alone.
``--imports`` lists what `urdfcal calibrate` and `urdfcal --help` spend on importing urdfcal's own modules and others.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.writing import write_session
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

POSES = 50
LIBRARIES = (
    "pinocchio", "scipy.optimize", "cv2", "rerun", "yourdfpy", "pydantic", "jinja2", "yaml",
    "click", "rich",
)  # fmt: skip
CALIBRATE, HELP = 2.2, 3.0
"""What issue 13 requires: times the imports of the libraries, and of numpy."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--rig", default="ur5")
    parser.add_argument("--imports", action="store_true", help="list the dearest imports")
    parser.add_argument("--cpu", action="store_true", help="count the processes' own time instead of the clock's")
    arguments = parser.parse_args()
    how = arguments.runs, children_time if arguments.cpu else time.perf_counter
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        write_session(session, simulate(read_rig(find_rig(arguments.rig)), poses=POSES, seed=0).session)
        calibrate = ["-m", "urdfcal", "calibrate", str(session), "-o", str(Path(folder) / "result"), "--quiet"]
        libraries = ["-c", f"import {', '.join(LIBRARIES)}"]
        show_help, numpy = ["-m", "urdfcal", "--help"], ["-c", "import numpy"]
        passed = [
            compare(f"urdfcal calibrate, {POSES} poses", calibrate, "bare imports", libraries, CALIBRATE, *how),
            compare("urdfcal --help", show_help, "import numpy", numpy, HELP, *how),
        ]
        if arguments.imports:
            dearest_imports("urdfcal calibrate", calibrate)
            dearest_imports("urdfcal --help", show_help)
    return int(not all(passed))


def compare(
    name: str, ours: list[str], bare_name: str, bare: list[str], limit: float, runs: int, clock: Callable[[], float]
) -> bool:
    """Print the median times of two commands, and whether their ratio is within its limit."""
    times = [(seconds(ours, clock), seconds(bare, clock)) for _ in range(runs + 1)][1:]
    mine, least = (statistics.median(column) for column in zip(*times, strict=True))
    ratio = mine / least
    low, high = (pick(a / b for a, b in times) for pick in (min, max))
    print(
        f"{name} {mine:.3f} s, {bare_name} {least:.3f} s: {ratio:.2f} times ({low:.2f} to {high:.2f} in {runs} runs), "
        f"required: at most {limit:g}: {'pass' if ratio <= limit else 'FAIL'}"
    )
    return bool(ratio <= limit)


def seconds(arguments: list[str], clock: Callable[[], float]) -> float:
    """Time of a Python process."""
    started = clock()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    return clock() - started


def children_time() -> float:
    """What all processes that have ended took of the processors. [s]"""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def dearest_imports(name: str, arguments: list[str], most: int = 15) -> None:
    """Print what importing takes, each module alone, summed over packages."""
    ended = subprocess.run([sys.executable, "-X", "importtime", *arguments], check=True, capture_output=True, text=True)
    own: Counter[str] = Counter()
    for line in ended.stderr.splitlines():
        parts = line.removeprefix("import time:").split("|")
        if len(parts) == 3 and parts[0].strip().isdigit():
            own[parts[2].strip().partition(".")[0]] += int(parts[0])
    print(f"\n{name}: {sum(own.values()) / 1e3:.0f} ms of imports, of which (ms)")
    print("  " + ", ".join(f"{package} {micro / 1e3:.0f}" for package, micro in own.most_common(most)))


if __name__ == "__main__":
    sys.exit(main())
