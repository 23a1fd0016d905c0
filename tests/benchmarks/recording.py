"""How long the recording of 1,000 poses and two cameras takes, and how large it is.

    python tests/benchmarks/recording.py

Limits: three times the time of writing the same arrays with one send_columns per entity; 5 MB without meshes.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import rerun as rr
from rerun.chunk import RrdReader

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.findings import Overview
from urdfcal.output.recording import write_recording
from urdfcal.pipeline import calibrate
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

    from rerun.chunk import Chunk

Plain: TypeAlias = "tuple[str, dict[str, Any], dict[str, dict[str, Any]], dict[str, Any]]"

_POSES, _REPEATS = 1000, 5
_SLOWER, _MEGABYTES = 3.0, 5.0


def main() -> int:
    calibration = calibrate(simulate(read_rig(find_rig("elbow3r")), poses=_POSES, seed=0).session)
    overview = Overview.of(calibration)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "calibration.rrd"
        write_recording(path, overview)
        size = path.stat().st_size / 1e6
        plain = [_plain(chunk) for chunk in RrdReader(path).stream() if not chunk.entity_path.startswith("/__")]
        ours, bare = [], []
        for _ in range(_REPEATS):  # in turn, as the machine's load varies
            ours.append(_timed(lambda: write_recording(path, overview)))
            bare.append(_timed(lambda: _write(Path(folder) / "bare.rrd", plain)))
        ratio = float(np.median(ours) / np.median(bare))
        bare_size = (Path(folder) / "bare.rrd").stat().st_size / 1e6
    print(f"{_POSES} poses, {len(plain)} entities with data: {size:.2f} MB (the bare arrays {bare_size:.2f} MB)")
    print(f"logging {np.median(ours):.3f} s, the same arrays one by one {np.median(bare):.3f} s: {ratio:.2f} times")
    print(f"working out what to show (for the report, too): {_timed(lambda: Overview.of(calibration)):.3f} s")
    return int(ratio > _SLOWER or size > _MEGABYTES)


def _timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _plain(chunk: Chunk) -> Plain:
    """A chunk's arrays as a user would hold them: (entity, time columns, {archetype: {component: values}}, lengths)."""
    batch = chunk.to_record_batch()
    times = {name: batch.column(name).to_numpy() for name in chunk.timeline_names if not name.startswith("log_")}
    archetypes: dict[str, dict[str, Any]] = {}
    lengths: dict[str, Any] = {}
    for name in batch.schema.names:
        archetype, _, component = name.partition(":")
        if archetype not in _KNOWN or component in _ENUMERATIONS:
            continue
        rows = batch.column(name).to_pylist()
        counts = [len(row or []) for row in rows]
        values = [value for row in rows for value in row or []]
        if not values:
            continue
        if not isinstance(values[0], str) and len({np.shape(value) for value in values}) == 1:
            values = np.array(values)
        elif not isinstance(values[0], str):
            values = [np.array(value) for value in values]
        archetypes.setdefault(archetype, {})[component] = values
        lengths.setdefault(archetype, {})[component] = counts
    return chunk.entity_path, times if not chunk.is_static else {}, archetypes, lengths


_ENUMERATIONS = ("fill_mode",)  # read back as numbers, written as names
_KNOWN = (
    "Points3D", "Points2D", "LineStrips3D", "LineStrips2D", "Arrows3D", "Arrows2D", "Ellipsoids3D", "Transform3D",
    "Scalars", "TextDocument",
)  # fmt: skip


def _write(path: Path, plain: list[Plain]) -> None:
    """Every entity's arrays, with one call each."""
    stream = rr.RecordingStream("bare")
    stream.save(path)
    for entity, times, archetypes, lengths in plain:
        columns: list[Any] = []
        for archetype, values in archetypes.items():
            for component, column in values.items():
                columns += (
                    getattr(rr, archetype).columns(**{component: column}).partition(lengths[archetype][component])
                )
        index = [rr.TimeColumn(name, sequence=value) for name, value in times.items()]
        if columns:
            rr.send_columns(entity, index, columns, recording=stream)
    stream.disconnect()


if __name__ == "__main__":
    sys.exit(main())
