"""Check that a session is what it says: wrong units, swapped names and stuck sensors.

Every rule is one function; the numbers that decide are at the top, each with its reason.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.arm import parameter_tolerance
from urdfcal.estimation.measurements import Detections, Distances, Points, Poses
from urdfcal.io.checks.content import check_images, check_names_by_rays, frozen_recording, told
from urdfcal.io.csv_table import repeats
from urdfcal.names import listed
from urdfcal.session.attachments import WORLD
from urdfcal.session.knowledge import Excluded
from urdfcal.session.moves import moves_before

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from urdfcal.arrays import Bools, Ints
    from urdfcal.estimation.measurements import Measurement
    from urdfcal.io.tables import FrameTable, JointTable, MeasurementTable
    from urdfcal.io.yaml_document import Document
    from urdfcal.robot.mechanism import Joint
    from urdfcal.session.model import Positions

# Encoders are read to 1e-4 rad or m, and controllers let joints overrun their limits by less than this.
OVERRUN = 1e-3
# A wrist that turns without limits may have been wound up twice; in degrees it goes to hundreds.
_WOUND_UP = 4.0 * np.pi
# One bad row is a typing error; a wrong unit shows in most poses.
_MOST = 0.5
# The wrist's joints alone may span next to nothing, and still carry a hand-long tool.
_SMALLEST_ARM = 0.1
# The longest arms there are, of concrete pumps, reach 60 m; a hand-long one in millimetres as many as this in metres.
_LARGEST_ARM = 100.0
# An LED held five arm lengths from the tip, or seen moving twenty, is in millimetres.
_TOO_FAR, _TOO_WIDE = 5.0, 20.0
# 5 % of the image: an LED found no better than this is not found.
_BLIND = 0.05
# Five degrees of reading noise: the unit is wrong.
_UNREAD = 0.1
# Quaternions are written to three digits or more.
_UNIT = 5e-3
# A joint that moves less than this moves the tip by less than a nominal arm is wrong.
_STILL = 1e-3


@dataclass(frozen=True, eq=False)
class Inputs:
    """All that was read, with the places it was read from.

    Attributes:
        document: session.yaml.
        positions: what it declares, and where the arm was.
        joints: the joint readings.
        frames: of an arm that moved, when it was looked at.
        tables: the measurements, by kind.
        excluded: what does not count.
        ignore_limits: whether readings may be beyond the joints' limits.
    """

    document: Document
    positions: Positions
    joints: JointTable
    frames: FrameTable | None = None
    tables: Mapping[type[Measurement], MeasurementTable] = field(default_factory=dict)
    excluded: Excluded = field(default_factory=Excluded)
    ignore_limits: bool = False

    @property
    def counting(self) -> Ints:
        """The rows of the joint readings that count."""
        if not self.joints.poses:  # an arm that moves: its readings are of no pose
            return np.arange(len(self.joints.readings))
        return np.flatnonzero(~np.isin(self.joints.poses, self.excluded.poses))

    @property
    def scale(self) -> float:
        """Size of the arm in m, for comparison with lengths that should be of its order."""
        return max(self.positions.chain.reach, _SMALLEST_ARM)

    @property
    def reach(self) -> str:
        """The size of the arm in words."""
        return f"the arm reaches {self.positions.chain.reach:.3g} m"

    @property
    def cameras_file(self) -> str:
        """The camera file's name, as the session gives it."""
        named = self.document.data["cameras"]
        return str(named if isinstance(named, str) else named["file"])

    def wrong(self, what: str, remedy: str, *keys: str) -> SessionError:
        """The error to raise about what session.yaml says behind some keys."""
        return SessionError(what, where=self.document.place(*keys), remedy=remedy)


def check_positions(inputs: Inputs) -> tuple[str, ...]:
    """Look for what can go wrong before anything is seen: in the readings, and in what is declared.

    Returns:
        What looks odd but may be right.

    Raises:
        SessionError: what cannot be right, with file, line and column.
    """
    _check_arm_units(inputs)
    _check_reading_units(inputs)
    beyond = _check_limits(inputs)
    _check_led_units(inputs)
    _check_mount_units(inputs)
    _check_noise_units(inputs)
    return (*beyond, *_still_joints(inputs), *_same_readings(inputs))


def check(inputs: Inputs) -> tuple[dict[type[Measurement], MeasurementTable], tuple[str, ...]]:
    """Look for what can go wrong between the robot and the files.

    Returns:
        The measurements without the few that cannot be right, and what looks odd but may be right.

    Raises:
        SessionError: what cannot be right, with file, line and column.
    """
    warnings = list(check_positions(inputs))
    _check_point_units(inputs)
    tables = dict(inputs.tables)
    for kind, table in inputs.tables.items():
        tables[kind], odd = frozen_recording(inputs, table)
        warnings += odd
    tables, odd = told(tables)
    warnings += odd
    if Detections in tables:
        # After a camera has moved nothing is known of where it stands.
        rig, poses = inputs.positions.rig, tables[Detections].measurements.index["pose"]
        where_said = moves_before(inputs.positions, *rig.names)[poses] == 0
        rays_meet, odd = check_names_by_rays(rig, tables[Detections], where_said)
        tables[Detections], outside = check_images(inputs, tables[Detections], rays_meet)
        warnings += [*odd, *outside]
    elif inputs.positions.rig.cameras and not inputs.excluded:
        warnings.append(f"{inputs.document.place('cameras')}: there are no detections: the cameras are not used")
    return tables, tuple(warnings)


def _check_reading_units(inputs: Inputs) -> None:
    """Degrees and millimetres: in most poses far outside the limits, and inside once converted."""
    chain, table, rows = inputs.positions.chain, inputs.joints.table, inputs.counting
    readings = inputs.joints.readings[rows]
    joints, (lower, upper) = chain.actuated_joints, chain.limits
    prismatic = np.array([j.prismatic for j in joints])
    boundless = np.where(prismatic, _TOO_WIDE * inputs.scale, _WOUND_UP)
    lower, upper = np.maximum(lower, -boundless) - OVERRUN, np.minimum(upper, boundless) + OVERRUN
    factor = np.where(prismatic, 1e-3, np.pi / 180.0)
    # No radian reading is beyond a whole turn by mistake; most readings in degrees are. No slide overruns by its
    # length.
    length = np.where(np.abs(upper - lower) < boundless, upper - lower, 0.0)
    far = np.where(prismatic, np.maximum(lower - readings, readings - upper) > length, np.abs(readings) > 2.0 * np.pi)
    outside = np.asarray((readings < lower) | (readings > upper)) & far
    fits: Bools = np.all((readings * factor >= lower) & (readings * factor <= upper), axis=0)
    for unit, meant, kind in (("degrees", "radians", ~prismatic), ("millimetres", "metres", prismatic)):
        suspects = np.flatnonzero(outside.any(axis=0) & kind)
        if not suspects.size or not fits[suspects].all() or outside[:, suspects].any(axis=1).mean() < _MOST:
            continue
        row, column = (int(i) for i in np.argwhere(outside & kind)[0])
        what = (
            f"the readings of {listed([joints[i].name for i in suspects])} look like {unit}: "
            f"{joints[column].name} is {readings[row, column]:g}"
        )
        raise table.wrong(what, int(rows[row]), joints[column].name, f"Write {meant}.")


def _check_limits(inputs: Inputs) -> tuple[str, ...]:
    """Readings beyond a limit: by no more than a joint's zero may be off they are told, and refused beyond that."""
    chain, table, rows = inputs.positions.chain, inputs.joints.table, inputs.counting
    violations = chain.outside_limits(inputs.joints.readings[rows], OVERRUN)
    refused = [of for of in violations if of.beyond > _zero_tolerance(inputs, of.joint)]
    for first in [] if inputs.ignore_limits else refused[:1]:
        more = f" (and {len(refused) - 1} more readings)" if len(refused) > 1 else ""
        suspected = _misread(inputs) if len({of.pose for of in refused}) > _MOST * len(rows) else ""
        remedy = (
            f"{suspected or 'Correct the reading, or the limits in the URDF;'} `urdfcal calibrate --ignore-limits` "
            "takes it as it is."
        )
        raise table.wrong(f"{first}{more}", int(rows[first.pose]), first.joint.name, remedy)
    warnings = []
    for joint in dict.fromkeys(of.joint for of in violations):
        own = [of for of in violations if of.joint is joint]
        worst = max(own, key=lambda of: of.beyond)
        row = int(rows[worst.pose])
        pose = f"pose {inputs.joints.poses[row]!r}: " if inputs.joints.poses else ""
        more = f", and {len(own) - 1} more readings by less" if len(own) > 1 else ""
        what = f"{joint.name} is {worst.beyond:.2g} {joint.unit} beyond its limits"
        warnings.append(f"{table.place(row, joint.name)}: {pose}{what}{more}")
    return tuple(warnings)


def _misread(inputs: Inputs) -> str:
    """Ask for the sign of a column, or the exchange of two, that would bring all readings within the limits."""
    chain, readings = inputs.positions.chain, inputs.joints.readings[inputs.counting]
    names = [joint.name for joint in chain.actuated_joints]
    changes = {f"is the sign of {name} turned?": (k, k) for k, name in enumerate(names)}
    changes |= {
        f"are the columns of {names[a]} and {names[b]} exchanged?": (a, b)
        for a, b in combinations(range(len(names)), 2)
    }
    fitting = []
    for question, (a, b) in changes.items():
        changed = readings.copy()
        changed[:, [a, b]] = -readings[:, [a, b]] if a == b else readings[:, [b, a]]
        if not chain.outside_limits(changed, OVERRUN):
            fitting.append(question)
    return f"All would be within their limits otherwise: {' Or '.join(fitting[:2])} Correct it;" if fitting else ""


def _zero_tolerance(inputs: Inputs, joint: Joint) -> float:
    """How far the zero of a joint may be off. [rad or m]."""
    return parameter_tolerance(inputs.positions.tolerances, joint.name, "d" if joint.prismatic else "theta", zero=True)


def _check_arm_units(inputs: Inputs) -> None:
    if inputs.positions.chain.reach > _LARGEST_ARM:
        what = f"the URDF's lengths look like millimetres: its arm would reach {inputs.positions.chain.reach:.0f} m"
        raise inputs.wrong(what, "Export it in metres, or divide every xyz by 1000.", "robot", "urdf")


def _check_led_units(inputs: Inputs) -> None:
    for led in inputs.positions.leds:
        # A camera, from which places in the world are counted, may stand farther away than an arm carries anything.
        farthest, origin = (_TOO_WIDE, "world's origin") if led.link == WORLD else (_TOO_FAR, led.link or "tip")
        if led.position is not None and (away := np.linalg.norm(led.position)) > farthest * inputs.scale:
            what = f"{away:g} m from the {origin} looks like millimetres: {inputs.reach}"
            raise inputs.wrong(what, "Write metres.", "leds", led.name, "position")
        if led.sigma is not None and led.sigma > inputs.scale:
            what = f"a sigma of {led.sigma:g} m looks like millimetres: {inputs.reach}"
            raise inputs.wrong(what, "Write metres.", "leds", led.name, "sigma")
    for target in inputs.positions.targets:
        if target.T_link_target is None:
            continue
        farthest, origin = (_TOO_WIDE, "world's origin") if target.link == WORLD else (_TOO_FAR, target.link or "tip")
        if (away := np.linalg.norm(target.T_link_target[:3, 3])) > farthest * inputs.scale:
            what = f"{away:g} m from the {origin} looks like millimetres: {inputs.reach}"
            raise inputs.wrong(what, "Write metres.", "targets", target.name, "position")


def _check_mount_units(inputs: Inputs) -> None:
    named = inputs.document.data.get("cameras")
    for camera, keys in named.items() if isinstance(named, dict) else ():
        if not isinstance(keys, dict) or "position" not in keys:
            continue
        if (away := np.linalg.norm(keys["position"])) > _TOO_FAR * inputs.scale:
            what = f"{away:g} m from its link looks like millimetres: {inputs.reach}"
            raise inputs.wrong(what, "Write metres.", "cameras", camera, "position")
        if (turn := np.abs(keys["rpy"]).max()) > 2.0 * np.pi:
            what = f"{turn:g} rad is more than a turn: these look like degrees"
            raise inputs.wrong(what, "Write radians.", "cameras", camera, "rpy")


def _check_noise_units(inputs: Inputs) -> None:
    if (joint := inputs.positions.noise.reading) > _UNREAD:
        remedy = "Write radians, and metres for prismatic joints."
        raise inputs.wrong(f"a joint noise of {joint:g} rad is no reading noise", remedy, "noise", "joint")
    for table in inputs.tables.values():
        measured = table.measurements
        if measured.unit == "px":
            sides = np.array([max(camera.resolution) for camera in inputs.positions.rig.cameras])
            largest, size = _BLIND * sides[measured.index["camera"]], "image"
        elif measured.unit == "m":
            largest, size = np.full(len(measured), inputs.scale), "arm"
        else:
            continue
        absurd = np.flatnonzero(measured.sigma > largest)
        if absurd.size:
            first = table.first(absurd)
            own = next((name for name in ("sigma", "sxx") if name in table.table.columns), None)
            raise SessionError(
                f"a sigma of {measured.sigma[first]:g} {measured.unit} is of the size of the {size}",
                where=table.place(first, own) if own else inputs.document.place("noise", measured.noise),
                remedy=f"Write one standard deviation in {measured.unit}, or a covariance in its square.",
            )


def _check_point_units(inputs: Inputs) -> None:
    table = inputs.tables.get(Distances)
    far = np.flatnonzero(table.measurements.values[:, 0] > _TOO_WIDE * inputs.scale) if table is not None else ()
    if table is not None and len(far):
        first = table.first(np.asarray(far))
        what = f"a distance of {table.measurements.values[first, 0]:g} m looks like millimetres: {inputs.reach}"
        raise SessionError(what, where=table.place(first, "distance"), remedy="Write metres.")
    for table in (inputs.tables[kind] for kind in (Points, Poses) if kind in inputs.tables):
        _check_spread(inputs, table)
    poses = inputs.tables.get(Poses)
    lengths = np.linalg.norm(poses.measurements.values[:, 3:], axis=1) if poses is not None else np.ones(0)
    wrong = np.flatnonzero(np.abs(lengths - 1.0) > _UNIT)
    if poses is not None and wrong.size:
        first = poses.first(wrong)
        what = f"qx, qy, qz, qw have the length {lengths[first]:.3g}, not 1: this is no orientation"
        raise SessionError(what, where=poses.place(first, "qx"), remedy="Write a unit quaternion, qw last.")


def _check_spread(inputs: Inputs, table: MeasurementTable) -> None:
    values = table.measurements.values[:, :3]
    distance = np.linalg.norm(values - np.median(values, axis=0), axis=1)
    if np.median(distance) > _TOO_FAR * inputs.scale:
        spread = f"{np.ptp(values, axis=0).max():.3g} m, which looks like millimetres: {inputs.reach}"
        where = str(table.table.path)
        raise SessionError(f"the points spread over {spread}", where=where, remedy="Write metres.")
    far = np.flatnonzero(distance > _TOO_WIDE * inputs.scale)
    if far.size:
        first = table.first(far)
        what = f"the point lies {distance[first]:.3g} m from the others: {inputs.reach}"
        raise SessionError(what, where=table.place(first, "x"), remedy="Correct it, or leave it out.")


def _still_joints(inputs: Inputs) -> Iterator[str]:
    joints = inputs.positions.chain.actuated_joints
    for joint, moved in zip(joints, np.ptp(inputs.joints.readings[inputs.counting], axis=0), strict=True):
        if moved < _STILL:
            how = f"moves by only {moved:.2g} {joint.unit}" if moved else "never moves"
            yield f"{inputs.joints.table.path}: joint {joint.name!r} {how}: its parameters are unidentifiable"


def _same_readings(inputs: Inputs) -> Iterator[str]:
    joints, rows = inputs.joints, inputs.counting
    if not joints.poses:  # an arm that moves may come back, or wait
        return
    # Adding zero makes -0.0 the same bytes as 0.0.
    pairs = repeats(reading.tobytes() for reading in joints.readings[rows] + 0.0)
    for first, row in [(int(rows[a]), int(rows[b])) for a, b in pairs[:1]]:
        more = f", as have {len(pairs) - 1} more pairs" if len(pairs) > 1 else ""
        pose, other = joints.poses[row], joints.poses[first]
        yield (
            f"{joints.table.place(row, 'pose')}: pose {pose!r} has exactly the joint readings of pose {other!r}{more}"
        )
