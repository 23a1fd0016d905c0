"""Check that a session is what it says: wrong units, swapped names and stuck sensors.

Every rule is one function; the numbers that decide are at the top, each with its reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.checks.content import check_images, frozen_recording, unseen
from urdfcal.io.checks.swaps import check_names_by_rays
from urdfcal.io.tables import JointTable
from urdfcal.names import listed
from urdfcal.session.attachments import WORLD

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from urdfcal.arrays import Bools, Floats
    from urdfcal.cameras.rig import Rig
    from urdfcal.estimation.measurements import Measurement
    from urdfcal.io.frame_tables import LogTable
    from urdfcal.io.tables import MeasurementTable
    from urdfcal.io.yaml_document import Document
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.knowledge import Led, Noise

# Encoders are read to 1e-4 rad or m, and controllers let joints overrun their limits by less than this.
OVERRUN = 1e-3
# A wrist that turns without limits may have been wound up twice; in degrees it goes to hundreds.
_WOUND_UP = 4.0 * np.pi
# One bad row is a typing error; a wrong unit shows in most poses.
_MOST = 0.5
# The wrist's joints alone may span next to nothing, and still carry a hand-long tool.
_SMALLEST_ARM = 0.1
# An LED held five arm lengths from the tip, or seen moving twenty, is in millimetres.
_TOO_FAR, _TOO_WIDE = 5.0, 20.0
# 5 % of the image: an LED found no better than this is not found.
_BLIND = 0.05
# Five degrees of reading noise: the unit is wrong.
_UNREAD = 0.1
# A joint that moves less than this moves the tip by less than a nominal arm is wrong.
_STILL = 1e-3


@dataclass(frozen=True, eq=False)
class Taken:
    """The moments at which something was measured: poses, or frames of a moving arm.

    Attributes:
        path: the table that lists them.
        labels: N of them.
        readings: (N, k) of the actuated joints. [rad or m]
        still: readings that differ by no more are the same place. [rad or m]
    """

    path: Path
    labels: tuple[str, ...]
    readings: Floats
    still: float


@dataclass(frozen=True, eq=False)
class Inputs:
    """All that was read, with the places it was read from.

    Attributes:
        document: session.yaml.
        chain: the robot's.
        leds: as declared.
        rig: the cameras.
        noise: as declared.
        joints: the joint readings.
        taken: when or where LEDs were looked at.
        tables: the measurements.
    """

    document: Document
    chain: Mechanism
    leds: tuple[Led, ...]
    rig: Rig
    noise: Noise
    joints: JointTable | LogTable
    taken: Taken
    tables: tuple[MeasurementTable, ...]

    @property
    def scale(self) -> float:
        """Size of the arm in m, for comparison with lengths that should be of its order."""
        return max(self.chain.reach, _SMALLEST_ARM)

    @property
    def cameras_file(self) -> str:
        """The camera file's name, as the session gives it."""
        named = self.document.data["cameras"]
        return str(named if isinstance(named, str) else named["file"])

    def find(self, kind: type[Measurement]) -> MeasurementTable | None:
        """The table of a kind of measurement, if there is one."""
        return next((table for table in self.tables if table.kind is kind), None)


def check_positions(inputs: Inputs) -> tuple[str, ...]:
    """Look for what can go wrong before anything is seen: in the readings, and in what is declared.

    Returns:
        What looks odd but may be right.

    Raises:
        SessionError: what cannot be right, with file, line and column.
    """
    _check_reading_units(inputs)
    _check_limits(inputs)
    _check_led_units(inputs)
    _check_mount_units(inputs)
    _check_noise_units(inputs)
    return (*_still_joints(inputs), *_same_readings(inputs.joints))


def check(inputs: Inputs) -> tuple[str, ...]:
    """Look for what can go wrong between the robot and the files.

    Returns:
        What looks odd but may be right.

    Raises:
        SessionError: what cannot be right, with file, line and column.
    """
    warnings = list(check_positions(inputs))
    _check_point_units(inputs)
    for table in inputs.tables:
        warnings += frozen_recording(inputs, table)
    detections = inputs.find(Detections)
    if detections is not None:
        rays, odd = check_names_by_rays(inputs.rig, detections)
        warnings += [*odd, *check_images(inputs, detections, rays)]
    elif inputs.rig.cameras:
        warnings.append(f"{inputs.document.place('cameras')}: there are no detections: the cameras are not used")
    return (*warnings, *unseen(inputs))


def _check_reading_units(inputs: Inputs) -> None:
    """Degrees and millimetres: in most poses far outside the limits, and inside once converted."""
    joints, readings = inputs.chain.actuated_joints, inputs.joints.readings
    lower, upper = inputs.chain.limits
    prismatic = np.array([j.prismatic for j in joints])
    boundless = np.where(prismatic, _TOO_WIDE * inputs.scale, _WOUND_UP)
    lower, upper = np.maximum(lower, -boundless) - OVERRUN, np.minimum(upper, boundless) + OVERRUN
    factor = np.where(prismatic, 1e-3, np.pi / 180.0)
    # No radian reading is beyond a whole turn by mistake; most readings in degrees are.
    far = prismatic | (np.abs(readings) > 2.0 * np.pi)
    outside = np.asarray((readings < lower) | (readings > upper)) & far
    fits: Bools = np.all((readings * factor >= lower) & (readings * factor <= upper), axis=0)
    for unit, meant, kind in (("degrees", "radians", ~prismatic), ("millimetres", "metres", prismatic)):
        suspects = np.flatnonzero(outside.any(axis=0) & kind)
        if not suspects.size or not fits[suspects].all():
            continue
        if outside[:, suspects].any(axis=1).mean() < _MOST:
            continue
        row, column = (int(i) for i in np.argwhere(outside & kind)[0])
        raise SessionError(
            f"the readings of {listed([joints[i].name for i in suspects])} look like {unit}: "
            f"{joints[column].name} is {readings[row, column]:g}",
            where=inputs.joints.table.place(row, joints[column].name),
            remedy=f"Write {meant}.",
        )


def _check_limits(inputs: Inputs) -> None:
    violations = inputs.chain.outside_limits(inputs.joints.readings, OVERRUN)
    if violations:
        more = f" (and {len(violations) - 1} more readings)" if len(violations) > 1 else ""
        raise SessionError(
            f"{violations[0]}{more}",
            where=inputs.joints.table.place(violations[0].pose, violations[0].joint.name),
            remedy="Correct the reading, or the limits in the URDF.",
        )


def _check_led_units(inputs: Inputs) -> None:
    for led in inputs.leds:
        # A camera, from which places in the world are counted, may stand farther away than an arm carries anything.
        farthest, origin = (_TOO_WIDE, "world's origin") if led.link == WORLD else (_TOO_FAR, led.link or "tip")
        if led.position is not None and np.linalg.norm(led.position) > farthest * inputs.scale:
            raise SessionError(
                f"{np.linalg.norm(led.position):g} m from the {origin} looks like millimetres: "
                f"the arm reaches {inputs.chain.reach:.3g} m",
                where=inputs.document.place("leds", led.name, "position"),
                remedy="Write metres.",
            )
        if led.sigma is not None and led.sigma > inputs.scale:
            raise SessionError(
                f"a sigma of {led.sigma:g} m looks like millimetres: the arm reaches {inputs.chain.reach:.3g} m",
                where=inputs.document.place("leds", led.name, "sigma"),
                remedy="Write metres.",
            )


def _check_mount_units(inputs: Inputs) -> None:
    named = inputs.document.data.get("cameras")
    for camera, keys in named.items() if isinstance(named, dict) else ():
        if not isinstance(keys, dict) or "position" not in keys:
            continue
        if np.linalg.norm(keys["position"]) > _TOO_FAR * inputs.scale:
            raise SessionError(
                f"{np.linalg.norm(keys['position']):g} m from its link looks like millimetres: "
                f"the arm reaches {inputs.chain.reach:.3g} m",
                where=inputs.document.place("cameras", camera, "position"),
                remedy="Write metres.",
            )
        if np.abs(keys["rpy"]).max() > 2.0 * np.pi:
            raise SessionError(
                f"{np.abs(keys['rpy']).max():g} rad is more than a turn: these look like degrees",
                where=inputs.document.place("cameras", camera, "rpy"),
                remedy="Write radians.",
            )


def _check_noise_units(inputs: Inputs) -> None:
    if inputs.noise.joint > _UNREAD:
        raise SessionError(
            f"a joint noise of {inputs.noise.joint:g} rad is no reading noise",
            where=inputs.document.place("noise", "joint"),
            remedy="Write radians, and metres for prismatic joints.",
        )
    for table in inputs.tables:
        if table.kind.unit == "px":
            sides = np.array([max(camera.resolution) for camera in inputs.rig.cameras])
            _check_sigma(inputs, table, _BLIND * sides[table.index["camera"]], "of the size of the image")
        elif table.kind.unit == "m":
            _check_sigma(inputs, table, np.full(len(table.sigma), inputs.scale), "of the size of the arm")


def _check_sigma(inputs: Inputs, table: MeasurementTable, largest: Floats, verdict: str) -> None:
    absurd = np.flatnonzero(table.sigma > largest)
    if not absurd.size:
        return
    first = int(absurd[np.argmin(table.rows[absurd])])
    own = "sigma" in table.table.columns
    raise SessionError(
        f"a sigma of {table.sigma[first]:g} {table.kind.unit} is {verdict}",
        where=table.place(first, "sigma") if own else inputs.document.place("noise", table.kind.noise),
        remedy=f"Write one standard deviation in {table.kind.unit}.",
    )


def _check_point_units(inputs: Inputs) -> None:
    table = inputs.find(Points)
    if table is None:
        return
    reach = f"the arm reaches {inputs.chain.reach:.3g} m"
    distance = np.linalg.norm(table.values - np.median(table.values, axis=0), axis=1)
    if np.median(distance) > _TOO_FAR * inputs.scale:
        raise SessionError(
            f"the points spread over {np.ptp(table.values, axis=0).max():.3g} m, which looks like millimetres: {reach}",
            where=str(table.table.path),
            remedy="Write metres.",
        )
    far = np.flatnonzero(distance > _TOO_WIDE * inputs.scale)
    if far.size:
        first = int(far[np.argmin(table.rows[far])])
        raise SessionError(
            f"the point lies {distance[first]:.3g} m from the others: {reach}",
            where=table.place(first, "x"),
            remedy="Correct it, or leave it out.",
        )


def _still_joints(inputs: Inputs) -> Iterator[str]:
    for joint, moved in zip(inputs.chain.actuated_joints, np.ptp(inputs.joints.readings, axis=0), strict=True):
        if moved < _STILL:
            yield (
                f"{inputs.joints.table.path}: joint {joint.name!r} "
                + (f"moves by only {moved:.2g} {joint.unit}" if moved else "never moves")
                + ": its parameters are unidentifiable"
            )


def _same_readings(joints: JointTable | LogTable) -> Iterator[str]:
    if not isinstance(joints, JointTable):  # an arm that moves may come back, or wait
        return
    # Adding zero makes -0.0 the same bytes as 0.0.
    first: dict[bytes, int] = {}
    pairs = [
        (first[key], row)
        for row, key in enumerate(reading.tobytes() for reading in joints.readings + 0.0)
        if first.setdefault(key, row) != row
    ]
    if pairs:
        a, b = (joints.poses[row] for row in pairs[0])
        more = f", as have {len(pairs) - 1} more pairs" if len(pairs) > 1 else ""
        place = joints.table.place(pairs[0][1], "pose")
        yield f"{place}: pose {b!r} has exactly the joint readings of pose {a!r}{more}"
