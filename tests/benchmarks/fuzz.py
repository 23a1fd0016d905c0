"""Whether bad input ends in an error that says what and where: mutated sessions, robots, cameras, bags and results.

    python tests/benchmarks/fuzz.py [--count 1000] [--seed 0] [--processes 2] [--only session] [--keep FOLDER]

Each case takes a valid file set, changes one of its files once to three times (characters, numbers, lines, columns,
YAML values, truncation), and reads it; a session that can still be read is calibrated now and then. Allowed
are a result, or an ``UrdfcalError`` with a place. Anything else is printed with its seed, and fails the run: another
exception, an error without a place, a process that dies or takes longer than ``LIMIT``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import traceback
from collections import Counter
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != Path(__file__).resolve().parent]
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from urdfcal.cameras.io.formats import format_of, read_cameras, write_cameras  # noqa: E402
from urdfcal.errors import UrdfcalError  # noqa: E402
from urdfcal.estimation.measurements import Points  # noqa: E402
from urdfcal.io.folder import read_rig, read_session  # noqa: E402
from urdfcal.io.shipped_rigs import find_rig  # noqa: E402
from urdfcal.io.writing import write_session  # noqa: E402
from urdfcal.pipeline import calibrate  # noqa: E402
from urdfcal.result.calibration import Calibration  # noqa: E402
from urdfcal.robot.chain import Chain  # noqa: E402
from urdfcal.robot.urdf.urdf import Urdf  # noqa: E402
from urdfcal.simulation.motion import MotionSettings, set_in_motion  # noqa: E402
from urdfcal.simulation.simulate import simulate  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

# A case takes a second of the processor at most; one that hangs is a finding. [s]
LIMIT = 60
# Share of the sessions that can still be read that are calibrated, which takes most of the time.
CALIBRATED = 0.15
NUMBERS = ("nan", "inf", "-inf", "1e308", "-1e-308", "0", "-1", "1e6", "", "0x10", "1,5", "true", "~", "9" * 400, "x")
TEXTS = ("", "\x00", "\u202e", "a" * 300, "../../etc/passwd", "é", "*", "&a", "- ", "{}", "[]", "null", "\t", "'")
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1e300, float("nan"), "", "x", "a" * 300, [], {}, [1, 2, 3], [[1]], {"a": 1}, "../x", 10**30,
)  # fmt: skip


# --- Mutations of one file's bytes ------------------------------------------------------------------------------------


def characters(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    changed = rng.choice([b"", bytes([rng.randrange(256)]), rng.choice(TEXTS).encode()])
    return data[:at] + changed + data[at + rng.choice([0, 1, 1, 8]) :]


def numbers(data: bytes, rng: random.Random) -> bytes:
    words = data.split(b" ") if rng.random() < 0.5 else data.split(b",")
    joint = b" " if data.count(b" ") and len(words) == data.count(b" ") + 1 else b","
    digits = [k for k, word in enumerate(words) if any(48 <= c <= 57 for c in word)]
    if digits:
        words[rng.choice(digits)] = rng.choice(NUMBERS).encode()
    return joint.join(words)


def lines(data: bytes, rng: random.Random) -> bytes:
    rows = data.split(b"\n")
    a, b = rng.randrange(len(rows)), rng.randrange(len(rows))
    how = rng.randrange(4)
    if how == 0:
        del rows[a]
    elif how == 1:
        rows[a], rows[b] = rows[b], rows[a]
    elif how == 2:
        rows.insert(b, rows[a])
    else:
        rows[a] = rng.choice(TEXTS).encode()
    return b"\n".join(rows)


def columns(data: bytes, rng: random.Random) -> bytes:
    rows = [row.split(b",") for row in data.split(b"\n")]
    count = len(rows[0])
    a, b = rng.randrange(count), rng.randrange(count)
    for row in rows:
        if len(row) == count:
            row[a], row[b] = row[b], row[a] if rng.random() < 0.99 else b"nan"
    return b"\n".join(b",".join(row) for row in rows)


def ending(data: bytes, rng: random.Random) -> bytes:
    how = rng.randrange(4)
    if how == 0:
        return data[: rng.randrange(len(data) + 1)]
    return (b"", data.replace(b"\n", b"\r\n"), b"\xef\xbb\xbf" + data)[how - 1]


def values(data: bytes, rng: random.Random) -> bytes:
    """One value of a YAML or JSON document."""
    tree = yaml.safe_load(data)
    places: list[tuple[Any, Any]] = []
    left = [tree]
    while left:
        node = left.pop()
        entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in list(entries):
            places.append((node, key))
            left.append(value)
    if not places:
        return data
    node, key = rng.choice(places)
    how = rng.random()
    if how < 0.15:
        del node[key]
    elif how < 0.25 and isinstance(node, dict):
        node[rng.choice(["x", "", "led", "sigma", "a" * 300])] = node.pop(key)
    else:
        node[key] = rng.choice(VALUES)
    return (json.dumps(tree) if data.lstrip().startswith(b"{") else yaml.safe_dump(tree)).encode()


ANY = (characters, numbers, lines, ending)
OF_KIND: dict[str, tuple[Callable[[bytes, random.Random], bytes], ...]] = {
    ".csv": (*ANY, columns, numbers, numbers),
    ".yaml": (*ANY, values, values, values),
    ".json": (*ANY, values, values, values),
    ".urdf": (*ANY, numbers),
}


# --- What is mutated, and how it is read ------------------------------------------------------------------------------


@cache
def material() -> Path:
    """A folder with a valid file set for each kind of case."""
    folder = Path(tempfile.gettempdir()) / f"urdfcal-fuzz-{os.getuid()}"
    if (folder / "done").exists():
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "session").mkdir(parents=True)
    for rig in ("ur5", "so101", "ur5_handeye", "tiago", "stanford"):
        data = simulate(read_rig(find_rig(rig)), poses=14, seed=1)
        write_session(folder / "session" / rig, data.session)
    still = simulate(read_rig(find_rig("elbow3r")), poses=6, seed=1)
    write_session(folder / "session" / "moving", set_in_motion(still, MotionSettings(frame_rate=2.0)).session)
    write_session(folder / "session" / "points", tracked(simulate(read_rig(find_rig("ur5")), poses=14, seed=2).session))
    for source in sorted((folder / "session").glob("*/*.urdf")):
        (folder / "urdf" / source.parent.name).mkdir(parents=True)
        shutil.copy(source, folder / "urdf" / source.parent.name)
    rig = read_cameras([folder / "session" / "ur5" / "cameras.yaml"])
    for format_ in ("kalibr", "ros", "opencv"):
        (folder / "cameras" / format_).mkdir(parents=True)
        write_cameras(folder / "cameras" / format_ / "cameras.yaml", rig, format_)
    (folder / "result" / "ur5").mkdir(parents=True)
    calibrate(simulate(read_rig(find_rig("ur5")), poses=25, seed=1).session).save(
        folder / "result" / "ur5" / "calibration.json"
    )
    bags(folder / "bag")
    (folder / "done").touch()
    return folder


def tracked(session: Any) -> Any:
    """A session of a tracker's points."""
    from urdfcal.estimation.measurements.pixels import triangulate

    points = triangulate(session)
    return session.measured((Points(points.pose, points.led, points.xyz, points.sigma),))


def bags(folder: Path) -> None:
    from tests.rosbag.bags import KINDS, recording

    for kind in KINDS:
        (folder / kind).mkdir(parents=True)
        recording(kind, 0.5).write(folder / kind / "bag")


def read_a_session(folder: Path, rng: random.Random) -> None:
    session = read_session(folder)
    if rng.random() < CALIBRATED:
        calibrate(session)


def read_a_urdf(folder: Path, _: random.Random) -> None:
    path = next(folder.glob("*.urdf"))
    urdf = Urdf.read(path)
    for tip in urdf.links[-3:]:
        with contextlib.suppress(UrdfcalError):
            Chain.from_urdf(urdf, tip)


def read_some_cameras(folder: Path, _: random.Random) -> None:
    paths = sorted(folder.glob("*.yaml"))
    write_cameras(folder / "written.yaml", read_cameras(paths), format_of(folder / "written.yaml"))


def read_a_result(folder: Path, _: random.Random) -> None:
    calibration = Calibration.load(folder / "calibration.json")
    calibration.apply(calibration.chain.build_model())
    calibration.to_dict()


def read_a_bag(folder: Path, _: random.Random) -> None:
    from tests.io.making import ACTUATED, URDF
    from urdfcal.rosbag.bag import open_bag
    from urdfcal.rosbag.importing import import_bag
    from urdfcal.rosbag.topics import choose_topics
    from urdfcal.session.knowledge import Led
    from urdfcal.session.model import Setup

    del ACTUATED
    (folder / "arm.urdf").write_text(URDF)
    urdf = Urdf.read(folder / "arm.urdf")
    setup = Setup(chain=Chain.from_urdf(urdf, urdf.links[-1]), leds=(Led("led"),), urdf=urdf, urdf_reference="arm.urdf")
    with open_bag(next(folder.glob("bag*"))) as bag:
        import_bag(bag, choose_topics(bag.topics), setup, folder / "out")


CASES: dict[str, Callable[[Path, random.Random], None]] = {
    "session": read_a_session,
    "urdf": read_a_urdf,
    "cameras": read_some_cameras,
    "result": read_a_result,
    "bag": read_a_bag,
}
# Most of what people write by hand are sessions.
WEIGHTS = {"session": 12, "urdf": 3, "cameras": 3, "result": 3, "bag": 1}


# --- The run ----------------------------------------------------------------------------------------------------------


def case(seed: int, only: str, keep: Path | None) -> tuple[str, str]:
    """Make and read one case; how it ended, and what is wrong with that."""
    rng = random.Random(seed)  # noqa: S311
    kinds = [only] if only else list(CASES)
    kind = rng.choices(kinds, [WEIGHTS[of] for of in kinds])[0]
    source = rng.choice(sorted((material() / kind).iterdir()))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "case"
        shutil.copytree(source, folder)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        what = []
        for _ in range(rng.choice([1, 1, 1, 2, 3])):
            path = rng.choice(files)
            mutate = rng.choice(OF_KIND.get(path.suffix, (characters, ending)))
            if path.is_file():
                with contextlib.suppress(yaml.YAMLError):
                    path.write_bytes(mutate(path.read_bytes(), rng))
            what.append(f"{path.name} {mutate.__name__}")
        name = f"{seed} {kind}/{source.name} ({', '.join(what)})"
        if keep is not None:
            shutil.copytree(folder, keep / f"{seed}")
        signal.setitimer(signal.ITIMER_PROF, LIMIT)
        try:
            CASES[kind](folder, rng)
        except UrdfcalError as error:
            return ("refused", "") if error.where else ("no place", f"{name}: {type(error).__name__}: {error}")
        except Exception:  # noqa: BLE001  # this is what is looked for
            return "other error", f"{name}\n{traceback.format_exc()}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
    return "read", ""


def quietly(task: tuple[int, str, Path | None]) -> tuple[str, str]:
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        return case(*task)


def timed_out(*_: object) -> None:
    raise TimeoutError(f"it takes longer than {LIMIT} s")


def started() -> None:
    signal.signal(signal.SIGPROF, timed_out)
    sys.stderr.flush()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what the URDF parser prints


def outcomes(seeds: range, only: str, keep: Path | None, processes: int) -> Iterator[tuple[str, str]]:
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    batch = 200
    for first in range(seeds.start, seeds.stop, batch):
        some = range(first, min(first + batch, seeds.stop))
        with ProcessPoolExecutor(processes, get_context("fork"), started) as pool:
            jobs = [pool.submit(quietly, (seed, only, keep)) for seed in some]
            for seed, job in zip(some, jobs, strict=True):
                try:
                    yield job.result()
                except BrokenProcessPool:
                    yield "died", f"{seed} or one of its neighbours: the process died"
                    break


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the first case")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", default="", choices=["", *CASES])
    parser.add_argument("--keep", type=Path, help="folder to keep the mutated files in")
    arguments = parser.parse_args()
    material()
    ended: Counter[str] = Counter()
    seeds = range(arguments.seed, arguments.seed + arguments.count)
    for how, what in outcomes(seeds, arguments.only, arguments.keep, arguments.processes):
        ended[how] += 1
        if what:
            print(f"{how}: {what}", flush=True)
    print(", ".join(f"{count} {how}" for how, count in ended.most_common()))
    return int(any(how not in ("read", "refused") for how in ended))


if __name__ == "__main__":
    sys.exit(main())
