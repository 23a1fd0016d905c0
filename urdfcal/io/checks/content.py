"""What the measurements show: frozen recordings, pixels outside their image, and what was never seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.io.checks.swaps import Rays
from urdfcal.names import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from urdfcal.io.checks.plausibility import Inputs
    from urdfcal.io.tables import MeasurementTable
    from urdfcal.session.measurement import Measurements

# One bad pixel in twenty is a typing error; more have a cause.
_FEW = 0.05
# Encoders repeat what hardly changes: one frame in a hundred of a slow arm at 2 kB a frame.
_REPEATED = 0.05
# An arm whose joints move by less between two frames may look the same in both. [rad or m]
_STILL = 1e-3
# An arm on its way from pose to pose passes out of view.
_MOST = 0.5


def frozen_recording(inputs: Inputs, table: MeasurementTable) -> Iterator[str]:
    """Find poses that differ although nothing that was measured does: the recording has frozen.

    A video may repeat an image, which is a warning; in a session of poses each is meant to be another.

    Raises:
        SessionError: two poses show exactly the same.
    """
    measured, repeated = table.measurements, 0
    if not measured.columns:
        return
    readings, still = inputs.positions.readings, 0.0 if inputs.frames is None else _STILL
    pose, values = measured.pose, measured.values
    what = np.column_stack([*(column for key, column in measured.index.items() if key != "pose"), values + 0.0])
    starts: list[int] = np.flatnonzero(np.diff(pose, prepend=-1)).tolist()
    first: dict[bytes, int] = {}
    for start, stop in zip(starts, [*starts[1:], len(pose)], strict=True):
        # A single pixel pair may repeat by chance if it is not found to a fraction of a pixel.
        if values[start:stop].size < 3 and not np.any(values[start:stop] % 0.5):
            continue
        other = first.setdefault(what[start:stop].tobytes(), start)
        if np.abs(readings[pose[start]] - readings[pose[other]]).max() <= still:
            continue
        repeated += 1
        if inputs.frames is None:
            names = [inputs.positions.poses[pose[i]] for i in (other, start)]
            raise SessionError(
                f"pose {names[1]!r} shows exactly what pose {names[0]!r} shows (line {table.rows[other] + 2}), "
                "but the joints have moved: the recording has frozen",
                where=table.place(start, "pose"),
                remedy="Leave out the poses whose measurements were not taken anew.",
            )
    if repeated > _REPEATED * len(starts):
        yield (
            f"{table.table.path}: {repeated} of {len(starts)} frames show exactly what another one shows, but the "
            "joints have moved: did the recording freeze?"
        )


def check_images(inputs: Inputs, table: MeasurementTable, rays: Rays) -> Iterator[str]:
    """Find pixels outside their image, and say why, where it shows.

    Raises:
        SessionError: a pixel is outside, and it is not open why.
    """
    camera_of, values, cameras = (
        table.measurements.index["camera"],
        table.measurements.values,
        inputs.positions.rig.cameras,
    )
    inside, turned = np.empty(len(camera_of), bool), np.empty(len(camera_of), bool)
    for i, camera in enumerate(cameras):
        seen = camera_of == i
        inside[seen] = camera.in_image(values[seen])
        turned[seen] = camera.in_image(values[seen][:, ::-1])
    outside = np.flatnonzero(~inside)
    if not outside.size:
        return
    first = table.first(outside)
    camera = cameras[camera_of[first]]
    (u, v), (width, height) = values[first], camera.resolution
    what = f"({u:g}, {v:g}) lies outside the {width} x {height} image of camera {camera.name!r}"
    if len(outside) > 1:
        what += f", as do {len(outside) - 1} more of {len(camera_of)} measurements"
    where = table.place(first, "u")
    if turned.all() and rays is Rays.UNKNOWN:
        # Nothing here depends on the resolution, and without the cameras' places both explanations stand.
        yield (
            f"{where}: {what}. With u and v exchanged all would fit: either they are exchanged, or in "
            f"{inputs.cameras_file} width and height are, and with them perhaps the intrinsics"
        )
        return
    if turned.all() and rays is Rays.MEET:
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
    tables, labels, rig = [table.measurements for table in inputs.tables], inputs.positions.poses, inputs.positions.rig
    seen = _named(tables, "pose")
    blind = [pose for k, pose in enumerate(labels) if k not in seen]
    if len(blind) > (0 if inputs.frames is None else _MOST * len(labels)):
        path = (inputs.frames or inputs.joints).table.path
        yield f"{path}: {len(blind)} of {len(labels)} poses have no measurement and do not count: {listed(blind)}"
    leds = _named(tables, "led")
    if dark := [name for i, name in enumerate(inputs.positions.led_names) if i not in leds]:
        yield f"{inputs.document.place('leds')}: never seen: {listed(dark)}"
    used = _named(tables, "camera")
    if used and (idle := [name for i, name in enumerate(rig.names) if i not in used]):
        yield f"{inputs.document.place('cameras')}: these cameras see nothing: {listed(idle)}"


def _named(tables: Iterable[Measurements], key: str) -> set[int]:
    """What tables with a key have measured."""
    return {i for table in tables if key in table.index for i in np.unique(table.index[key]).tolist()}
