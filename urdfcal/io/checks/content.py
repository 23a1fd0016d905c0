"""What the measurements show: frozen recordings, pixels outside their image, and what was never seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.checks.swaps import Rays
from urdfcal.io.tables import JointTable
from urdfcal.names import listed

if TYPE_CHECKING:
    from collections.abc import Iterator

    from urdfcal.io.checks.plausibility import Inputs
    from urdfcal.io.tables import MeasurementTable

# One bad pixel in twenty is a typing error; more have a cause.
_FEW = 0.05
# Encoders repeat what hardly changes: one frame in a hundred of a slow arm at 2 kB a frame.
_REPEATED = 0.05
# An arm on its way from pose to pose passes out of view.
_MOST = 0.5


def frozen_recording(inputs: Inputs, table: MeasurementTable) -> Iterator[str]:
    """Find poses that differ although nothing that was measured does: the recording has frozen.

    A video may repeat an image, which is a warning; in a session of poses each is meant to be another.

    Raises:
        SessionError: two poses show exactly the same.
    """
    repeated = 0
    if not table.kind.columns:
        return
    pose = table.index["pose"]
    what = np.column_stack([*(table.index[key] for key in table.index if key != "pose"), table.values + 0.0])
    starts: list[int] = np.flatnonzero(np.diff(pose, prepend=-1)).tolist()
    first: dict[bytes, int] = {}
    for start, stop in zip(starts, [*starts[1:], len(pose)], strict=True):
        # A single pixel pair may repeat by chance if it is not found to a fraction of a pixel.
        if table.values[start:stop].size < 3 and not np.any(table.values[start:stop] % 0.5):
            continue
        other = first.setdefault(what[start:stop].tobytes(), start)
        readings = inputs.taken.readings[[pose[other], pose[start]]]
        if other != start and np.abs(readings[1] - readings[0]).max() > inputs.taken.still:
            if not isinstance(inputs.joints, JointTable):
                repeated += 1
                continue
            names = [inputs.taken.labels[pose[i]] for i in (other, start)]
            line = table.rows[other] + 2
            raise SessionError(
                f"pose {names[1]!r} shows exactly what pose {names[0]!r} shows (line {line}), "
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
    camera_of = table.index["camera"]
    inside, turned = np.empty(len(camera_of), bool), np.empty(len(camera_of), bool)
    for i, camera in enumerate(inputs.rig.cameras):
        seen = camera_of == i
        inside[seen] = camera.in_image(table.values[seen])
        turned[seen] = camera.in_image(table.values[seen][:, ::-1])
    outside = np.flatnonzero(~inside)
    if not outside.size:
        return
    first = int(outside[np.argmin(table.rows[outside])])
    camera = inputs.rig.cameras[camera_of[first]]
    (u, v), (width, height) = table.values[first], camera.resolution
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
        reach = table.values[camera_of == camera_of[first]].max(axis=0)
        remedy = (
            f"Were the images taken at the resolution of {inputs.cameras_file}? "
            f"They reach to ({reach[0]:g}, {reach[1]:g})."
        )
    raise SessionError(what, where=where, remedy=remedy)


def unseen(inputs: Inputs) -> Iterator[str]:
    """Name poses without measurements, LEDs that were never measured, and cameras that see nothing."""
    tables = inputs.tables
    seen = np.zeros(len(inputs.taken.labels), bool)
    for table in tables:
        seen[table.index["pose"]] = True
    blind = [pose for pose, found in zip(inputs.taken.labels, seen, strict=True) if not found]
    if len(blind) > (0 if isinstance(inputs.joints, JointTable) else _MOST * len(seen)):
        yield (
            f"{inputs.taken.path}: {len(blind)} of {len(seen)} poses have no measurement and do not count: "
            f"{listed(blind)}"
        )
    leds = set(np.concatenate([table.index["led"] for table in tables if "led" in table.index]).tolist())
    dark = [led.name for i, led in enumerate(inputs.leds) if i not in leds]
    if dark:
        yield f"{inputs.document.place('leds')}: never seen: {listed(dark)}"
    detections = inputs.find(Detections)
    if detections is not None:
        used = set(detections.index["camera"].tolist())
        idle = [name for i, name in enumerate(inputs.rig.names) if i not in used]
        if idle:
            yield f"{inputs.document.place('cameras')}: these cameras see nothing: {listed(idle)}"
