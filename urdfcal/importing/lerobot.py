"""A data set of LeRobot: what its arm's motors read, and the videos beside it (formats 2.0, 2.1 and 3.0)."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path  # noqa: TC003  # a field's type
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from urdfcal.errors import SessionError
from urdfcal.files import Source
from urdfcal.images.files import Video
from urdfcal.io.keys import OpenKeys, Positive
from urdfcal.io.yaml_document import Document
from urdfcal.names import suggest

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from urdfcal.arrays import Floats

INFO = "meta/info.json"
_STATE, _TIME, _EPISODE = "observation.state", "timestamp", "episode_index"
_FETCH = "Fetch the data set again, all of it."
# A field of a path: {video_key}, {episode_index:06d}.
_FIELD = re.compile(r"\{(\w+)(?::0(\d)d)?\}")


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of a data set, of K frames.

    Attributes:
        time: (K,) when each was taken, from its beginning. [s]
        state: (K, k) what the motors read then, in the data set's unit.
        videos: by camera, the images of the K frames.
    """

    time: Floats
    state: Floats
    videos: Mapping[str, Video]


@dataclass(frozen=True, eq=False)
class DataSet:
    """A data set.

    Attributes:
        path: of its folder.
        motors: names of the k motors.
        episodes: in order.
    """

    path: Path
    motors: tuple[str, ...]
    episodes: tuple[Episode, ...]


def is_data_set(path: Path) -> bool:
    """Return whether a folder is a data set of LeRobot."""
    return (path / INFO).is_file()


def read_data_set(path: Path, cameras: Mapping[str, str]) -> DataSet:
    """Read the joint states, and where the images of some cameras are.

    Args:
        path: the folder that has meta/info.json.
        cameras: by name the feature, such as ``observation.images.front``, or its last word.

    Raises:
        SessionError: it is of another format, a file or a feature is missing, or its numbers are none.
    """
    layout = _format(path)
    keys = {name: layout.video_key(word) for name, word in cameras.items()}
    motors, episodes = layout.motors(), []
    for entry in layout.entries:
        file = layout.data(entry)
        rows = _parquet(file, [_STATE, _TIME], int(entry[_EPISODE]))
        state, time = _numbers(rows[_STATE]), _numbers(rows[_TIME])
        if state.shape != (int(entry["length"]), len(motors)) or not np.isfinite(state).all():
            what = f"{_STATE} of episode {entry[_EPISODE]} is not {entry['length']} times {len(motors)} numbers"
            raise SessionError(what, where=str(file), remedy=_FETCH)
        if not (np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
            raise SessionError(
                f"the times of episode {entry[_EPISODE]} do not increase", where=str(file), remedy=_FETCH
            )
        videos = {name: layout.video(entry, key) for name, key in keys.items()}
        episodes.append(Episode(time, state, videos))
    return DataSet(path, motors, tuple(episodes))


class _Feature(OpenKeys):
    dtype: str
    names: Any = None


class _InfoFile(OpenKeys):
    codebase_version: str
    fps: Positive
    features: dict[str, _Feature]
    data_path: str
    video_path: str | None = None
    chunks_size: Annotated[int, Field(gt=0)] = 1000


@dataclass(frozen=True, eq=False)
class _Format2:
    """Formats 2.0 and 2.1: a file of rows and a video a camera for each episode."""

    path: Path
    info: _InfoFile
    entries: Sequence[Mapping[str, Any]]

    def motors(self) -> tuple[str, ...]:
        """The motors' names, without what LeRobot puts around them: main_shoulder_pan, shoulder_pan.pos."""
        feature = self.info.features.get(_STATE)
        names = feature.names if feature is not None else None
        while isinstance(names, dict) and len(names) == 1:
            (names,) = names.values()
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            what = f"it does not name the motors of {_STATE}"
            raise SessionError(what, where=str(self.path / INFO), remedy="Write their names into it, in their order.")
        return tuple(name.removeprefix("main_").removesuffix(".pos") for name in names)

    def video_key(self, word: str) -> str:
        """The video that a word means: its feature, or the last part of that."""
        keys = [key for key, feature in self.info.features.items() if feature.dtype == "video"]
        found = [key for key in keys if word in (key, key.rpartition(".")[2])]
        if len(found) != 1:
            raise SessionError(
                f"there is no video {word!r}",
                where=str(self.path / INFO),
                remedy=f"{suggest(word, keys, 'videos')} Name the cameras so, or say --camera NAME=VIDEO.",
            )
        return found[0]

    def data(self, entry: Mapping[str, Any]) -> Path:
        """The file of an episode's rows."""
        return self._file(self.info.data_path, **self._places(entry))

    def video(self, entry: Mapping[str, Any], key: str) -> Video:
        """An episode's images of one camera."""
        file = self._file(self.info.video_path or "", video_key=key, **self._places(entry))
        count = int(entry["length"])
        return Video(file, tuple(range(count)), count)

    def _places(self, entry: Mapping[str, Any]) -> dict[str, int]:
        number = int(entry[_EPISODE])
        return {"episode_chunk": number // self.info.chunks_size, _EPISODE: number}

    def _file(self, template: str, **fields: str | int) -> Path:
        def written(field: re.Match[str]) -> str:
            return str(fields.get(field[1], "")).rjust(int(field[2] or 0), "0")

        file = self.path / _FIELD.sub(written, template)
        if not file.is_file():
            raise SessionError("there is no such file", where=str(file), remedy=_FETCH)
        return file


class _Format3(_Format2):
    """Format 3.0: files of rows, and videos, that hold several episodes, one after the other."""

    def data(self, entry: Mapping[str, Any]) -> Path:
        return self._file(self.info.data_path, **self._at(entry, "data"))

    def video(self, entry: Mapping[str, Any], key: str) -> Video:
        at, first = f"videos/{key}", round(float(entry[f"videos/{key}/from_timestamp"]) * self.info.fps)
        file = self._file(self.info.video_path or "", video_key=key, **self._at(entry, at))
        together = (other for other in self.entries if self._at(other, at) == self._at(entry, at))
        rows = tuple(range(first, first + int(entry["length"])))
        return Video(file, rows, sum(int(other["length"]) for other in together))

    @staticmethod
    def _at(entry: Mapping[str, Any], what: str) -> dict[str, int]:
        return {name: int(entry[f"{what}/{name}"]) for name in ("chunk_index", "file_index")}


def _format(path: Path) -> _Format2:
    document = Document.read(path / INFO)
    info = document.validate(_InfoFile)
    if info.codebase_version in ("v2.0", "v2.1"):
        return _Format2(path, info, _lines(path / "meta/episodes.jsonl"))
    if info.codebase_version != "v3.0":
        what = f"it is of format {info.codebase_version}, not 2.0, 2.1 or 3.0"
        remedy = "LeRobot's own scripts convert data sets, in lerobot/datasets."
        raise SessionError(what, where=document.place("codebase_version"), remedy=remedy)
    videos = [f"videos/{key}" for key, feature in info.features.items() if feature.dtype == "video"]
    columns = [_EPISODE, "length"]
    columns += [f"{of}/{name}" for of in ("data", *videos) for name in ("chunk_index", "file_index")]
    columns += [f"{of}/from_timestamp" for of in videos]
    entries: list[dict[str, Any]] = []
    for file in sorted((path / "meta/episodes").rglob("*.parquet")):
        rows = _parquet(file, columns)
        for name, cells in rows.items():
            if not all(isinstance(cell, (int, float)) and math.isfinite(cell) for cell in cells):
                raise SessionError(f"{name} is not a number for every episode", where=str(file), remedy=_FETCH)
        entries += [dict(zip(columns, row, strict=True)) for row in zip(*rows.values(), strict=True)]
    if not entries:
        raise SessionError("there is no episode", where=str(path / "meta/episodes"), remedy=_FETCH)
    return _Format3(path, info, entries)


def _lines(path: Path) -> list[dict[str, int]]:
    """The episodes of meta/episodes.jsonl."""
    entries = []
    for number, line in enumerate(Source.read(path).text.splitlines(), 1):
        try:
            entry = json.loads(line)
            entries.append({key: int(entry[key]) for key in (_EPISODE, "length")})
        except (ValueError, TypeError, KeyError, OverflowError) as error:
            raise SessionError("this describes no episode", where=f"{path}:{number}", remedy=_FETCH) from error
    if not entries:
        raise SessionError("there is no episode", where=str(path), remedy=_FETCH)
    return entries


def _numbers(cells: list[Any]) -> Floats:
    """Cells as an array; not a number each where rows of it differ in length, or are none."""
    try:
        return np.array(cells, np.float64)
    except (ValueError, TypeError):
        return np.full(len(cells), np.nan)


def _parquet(path: Path, columns: Sequence[str], episode: int | None = None) -> dict[str, list[Any]]:
    """The cells of some columns of a file, or of one episode's rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(
            path, columns=list(columns), filters=None if episode is None else [(_EPISODE, "=", episode)]
        )
        missing = [name for name in columns if name not in table.column_names]
        cells: dict[str, list[Any]] = {name: table.column(name).to_pylist() for name in columns if name not in missing}
    except (OSError, pa.ArrowException) as error:
        raise SessionError(f"this cannot be read as Parquet: {str(error).splitlines()[0]}", where=str(path)) from error
    if missing:
        raise SessionError(f"there is no column {missing[0]!r}", where=str(path), remedy=_FETCH)
    return cells
