"""What the measurements show: exchanged names, frozen recordings, pixels outside their image, and what is unseen."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements.pixels import side_by_side
from urdfcal.names import is_passed, listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from urdfcal.arrays import Bools, Floats
    from urdfcal.estimation.measurements import Measurement
    from urdfcal.io.checks.plausibility import Inputs
    from urdfcal.io.tables import MeasurementTable
    from urdfcal.session.measurements import Measurements

# One bad pixel, or one in twenty, is an error of its own, and the others are worth having; more have a cause.
_FEW = 0.05
# A place has three coordinates, a plane two tilts and an offset.
_UNKNOWNS = 3
# A grabber that hands out a picture twice now and then; one that does more often is not to be trusted.
_FROZEN = 0.01
# Encoders repeat what hardly changes: one frame in a hundred of a slow arm at 2 kB a frame.
_REPEATED = 0.05
# An arm whose joints move by less between two frames may look the same in both. [rad or m]
_STILL = 1e-3
# An arm on its way from pose to pose passes out of view, and cameras named as they should see rays that meet.
_MOST = 0.5
# An LED is hidden now and then, and where the arm was before a pose need not be seen; more is worth a word.
_UNSEEN = 0.2
# Two hundred points decide as well as a hundred thousand.
_SAMPLE = 200
_FEWEST = 3
# True sigmas give a whitened rms of about 0.5; cameras that are a little off give a few units.
_GOOD_RMS = 3.0
# Exchanging something explains the detections if it makes the residual this many times smaller.
_BETTER = 10.0


@dataclass(frozen=True)
class _Score:
    """How well the rays meet: share of points found, and their median whitened residual."""

    found: float
    rms: float

    @property
    def good(self) -> bool:
        return self.found >= _MOST and self.rms <= _GOOD_RMS

    def beats(self, other: _Score) -> bool:
        if self.found < _MOST:
            return False
        # Where nothing was found to compare with, garbage must not win.
        reference = other.rms if other.found >= _MOST else _BETTER**2 * _GOOD_RMS
        return _BETTER * self.rms < reference

    def __str__(self) -> str:
        if self.found < _MOST:
            return f"{self.found:.0%} of the rays meet"
        return f"the rays miss each other by {self.rms:.3g} sigma"


def check_names_by_rays(rig: Rig, table: MeasurementTable, rows: Bools) -> tuple[bool | None, list[str]]:
    """Triangulate the detections as named, and with cameras or u and v exchanged.

    Args:
        rig: the cameras.
        table: the detections.
        rows: (S,) which of them count.

    Returns:
        Whether the rays meet (if they miss, then whatever is exchanged), None where fewer than two cameras of known
        place saw the same; and warnings.

    Raises:
        SessionError: an exchange makes the rays meet.
    """
    placed = [i for i, T in enumerate(rig.T_cam_world) if T is not None]
    seen = table.measurements.rows(rows)
    _, _, uv, sigma = side_by_side(seen.index, seen.values, seen.sigma, len(rig.cameras))
    uv, sigma = uv[:, placed], sigma[:, placed]
    several = np.flatnonzero(np.isfinite(uv[:, :, 0]).sum(axis=1) > 1)
    if len(several) < _FEWEST:
        return None, []
    sample = several[np.linspace(0, len(several) - 1, min(_SAMPLE, len(several))).astype(int)]
    uv, sigma = uv[sample], sigma[sample]
    rig = Rig(tuple(rig.cameras[i] for i in placed), tuple(rig.T_cam_world[i] for i in placed))
    named = _score(rig, uv, sigma)
    scores = [(_score(rig, *changed), what) for what, *changed in _exchanges(rig, uv, sigma)]
    best, what = min(scores, key=lambda pair: (-(pair[0].found >= _MOST), pair[0].rms))
    if best.beats(named):
        what += f" look exchanged: as they are, {named}; with them exchanged, {best}"
        remedy = "Check the table's columns and the names in the camera file."
        raise SessionError(what, where=str(table.table.path), remedy=remedy)
    if named.good:
        return True, []
    return False, [f"{table.table.path}: {named}: are the cameras where the camera file says?"]


def _exchanges(rig: Rig, uv: Floats, sigma: Floats) -> Iterator[tuple[str, Floats, Floats]]:
    for pair in combinations(range(len(rig.cameras)), 2):
        order = np.arange(len(rig.cameras))
        order[list(pair)] = order[list(pair[::-1])]
        yield f"cameras {rig.names[pair[0]]!r} and {rig.names[pair[1]]!r}", uv[:, order], sigma[:, order]
    yield "u and v", uv[:, :, ::-1], sigma


def _score(rig: Rig, uv: Floats, sigma: Floats) -> _Score:
    result = rig.triangulate(uv, sigma)
    found = float(result.ok.mean())
    return _Score(found, float(np.median(result.rms[result.ok])) if found else np.inf)


def frozen_recording(inputs: Inputs, table: MeasurementTable) -> tuple[MeasurementTable, list[str]]:
    """Find poses that differ although nothing that was measured does: the recording has frozen.

    A video may repeat an image, which is a warning; in a session of poses each is meant to be another.

    Returns:
        The table without what of a session of poses is repeated, and warnings.

    Raises:
        SessionError: too many poses show exactly what another one shows.
    """
    measured = table.measurements
    if measured.repeats or not measured.columns:
        return table, []
    readings, still = inputs.positions.readings, 0.0 if inputs.frames is None else _STILL
    pose, values = measured.pose, measured.values
    what = np.column_stack([*(column for key, column in measured.index.items() if key != "pose"), values + 0.0])
    starts: list[int] = np.flatnonzero(np.diff(pose, prepend=-1)).tolist()
    first: dict[bytes, int] = {}
    repeated: list[tuple[int, int]] = []
    anew = np.ones(len(pose), dtype=bool)
    for start, stop in zip(starts, [*starts[1:], len(pose)], strict=True):
        # A single pixel pair may repeat by chance if it is not found to a fraction of a pixel.
        if values[start:stop].size < 3 and not np.any(values[start:stop] % 0.5):
            continue
        other = first.setdefault(what[start:stop].tobytes(), start)
        if np.abs(readings[pose[start]] - readings[pose[other]]).max() <= still:
            continue
        repeated.append((other, start))
        anew[start:stop] = False
    if inputs.frames is not None:
        if len(repeated) <= _REPEATED * len(starts):
            return table, []
        warning = (
            f"{table.table.path}: {len(repeated)} of {len(starts)} frames show exactly what another one shows, but "
            "the joints have moved: did the recording freeze?"
        )
        return table, [warning]
    if not repeated:
        return table, []
    other, start = repeated[0]
    names = [inputs.positions.poses[pose[i]] for i in (other, start)]
    found = (
        f"pose {names[1]!r} shows exactly what pose {names[0]!r} shows (line {table.rows[other] + 2}), "
        "but the joints have moved: the recording has frozen"
    )
    where = table.place(start, "pose")
    left_out = np.count_nonzero(~anew)
    if left_out > _FROZEN * len(pose):
        remedy = "Leave out the poses whose measurements were not taken anew."
        raise SessionError(found, where=where, remedy=remedy)
    more = f", and {len(repeated) - 1} more times" if len(repeated) > 1 else ""
    return table.only(anew), [f"{where}: {found}{more}: {left_out} of {len(pose)} {measured.kind} were left out"]


def told(
    tables: Mapping[type[Measurement], MeasurementTable],
) -> tuple[dict[type[Measurement], MeasurementTable], list[str]]:
    """Leave out places and planes that are measured so seldom that nothing of the arm is told beside where they are.

    Returns:
        The tables without them, and warnings.

    Raises:
        SessionError: nothing of a table is left.
    """
    result, warnings = dict(tables), []
    for key in dict.fromkeys(key for kind in tables for key in kind.own):
        count: dict[str, int] = {}
        named = {kind: _own_names(table, key) for kind, table in tables.items() if key in kind.own}
        for kind, names in named.items():
            for name in names:
                count[name] = count.get(name, 0) + kind.dimension
        for kind, names in named.items():
            kept = np.array([count[name] > _UNKNOWNS for name in names])
            if kept.all():
                continue
            seldom = listed(sorted({name for name, keep in zip(names, kept, strict=True) if not keep}))
            what = f"measured too seldom to tell anything but where the {key} is: {seldom}"
            where = tables[kind].place(tables[kind].first(np.flatnonzero(~kept)), key)
            remedy = f"measure each {key} in {1 + _UNKNOWNS // kind.dimension} poses or more, and mind the spelling"
            if not kept.any():
                raise SessionError(what, where=where, remedy=f"{remedy[0].upper()}{remedy[1:]}.")
            result[kind] = result[kind].only(kept)
            warnings.append(f"{where}: {what}: left out; {remedy}")
    return result, warnings


def _own_names(table: MeasurementTable, key: str) -> list[str]:
    names = table.measurements.names[key]
    return [names[i] for i in table.measurements.index[key]]


def check_images(inputs: Inputs, table: MeasurementTable, rays_meet: bool | None) -> tuple[MeasurementTable, list[str]]:
    """Find pixels outside their image, and say why, where it shows.

    Returns:
        The table without such pixels where there are but a few, and warnings.

    Raises:
        SessionError: more pixels are outside, and it is not open why.
    """
    camera_of, cameras = table.measurements.index["camera"], inputs.positions.rig.cameras
    values = table.measurements.values
    inside, turned = np.empty(len(camera_of), bool), np.empty(len(camera_of), bool)
    few = True
    for i, camera in enumerate(cameras):
        seen = camera_of == i
        inside[seen] = camera.in_image(values[seen])
        turned[seen] = camera.in_image(values[seen][:, ::-1])
        count = np.count_nonzero(~inside[seen])
        few = few and bool(count <= 1 or count < _FEW * np.count_nonzero(seen))
    outside = np.flatnonzero(~inside)
    if not outside.size:
        return table, []
    first = table.first(outside)
    camera = cameras[camera_of[first]]
    (u, v), (width, height) = values[first], camera.resolution
    what = f"({u:g}, {v:g}) lies outside the {width} x {height} image of camera {camera.name!r}"
    if len(outside) > 1:
        what += f", as do {len(outside) - 1} more of {len(camera_of)} measurements"
    where = table.place(first, "u")
    if few:
        return table.only(inside), [f"{where}: {what}: left out"]
    if turned.all() and rays_meet is None:
        # Nothing here depends on the resolution, and without the cameras' places both explanations stand.
        warning = (
            f"{where}: {what}. With u and v exchanged all would fit: either they are exchanged, or in "
            f"{inputs.cameras_file} width and height are, and with them perhaps the intrinsics"
        )
        return table, [warning]
    if turned.all() and rays_meet:
        where = f"{inputs.document.source.path.parent / inputs.cameras_file}, camera {camera.name!r}"
        what += "; the rays meet, so the pixels are right"
        remedy = f"Write the resolution as [width, height]: [{height}, {width}]?"
    elif turned.all():
        remedy = "All would fit with u and v exchanged: are they?"
    elif len(outside) < _FEW * len(camera_of):
        remedy = "Correct the detection, or leave it out."
    else:
        reach = values[camera_of == camera_of[first]].max(axis=0)
        remedy = (
            f"Were the images taken at the resolution of {inputs.cameras_file}? "
            f"They reach to ({reach[0]:g}, {reach[1]:g})."
        )
    raise SessionError(what, where=where, remedy=remedy)


def unseen(inputs: Inputs) -> Iterator[str]:
    """Name poses without measurements, LEDs that were never measured, and cameras that see nothing."""
    tables, excluded = [table.measurements for table in inputs.tables.values()], inputs.excluded
    seen, labels = _named(tables, "pose"), inputs.positions.poses
    # A plan's arm only passes through some.
    spared = {*excluded.poses, *filter(is_passed, labels)}
    blind = [pose for k, pose in enumerate(labels) if k not in seen and pose not in spared]
    if len(blind) > (_UNSEEN if inputs.frames is None else _MOST) * len(labels):
        path = (inputs.frames or inputs.joints).table.path
        yield f"{path}: {len(blind)} of {len(labels)} poses have no measurement: {listed(blind)}"
    positions, names = inputs.positions, inputs.positions.led_names
    leds = {names[i] for i in _named(tables, "led")} | set(excluded.leds)
    if dark := [led.name for led in positions.leds if led.name not in leds]:
        yield f"{inputs.document.place('leds')}: never seen: {listed(dark)}"
    if dark := [of.name for of in positions.targets if of.point_names and leds.isdisjoint(of.point_names)]:
        yield f"{inputs.document.place('targets')}: never seen: {listed(dark)}"
    used = _named(tables, "camera")
    if used and (
        idle := [
            name for i, name in enumerate(inputs.positions.rig.names) if i not in used and name not in excluded.cameras
        ]
    ):
        yield f"{inputs.document.place('cameras')}: these cameras see nothing: {listed(idle)}"


def _named(tables: Iterable[Measurements], key: str) -> set[int]:
    """What tables with a key have measured."""
    return {i for table in tables if key in table.index for i in np.unique(table.index[key]).tolist()}
