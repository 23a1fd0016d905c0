"""A session measured while the program runs: poses and measurements one by one, each checked when it comes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from urdfcal.arrays import finite_array
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.checks.plausibility import OVERRUN
from urdfcal.names import check_known, flaw, suggest
from urdfcal.session.model import Positions, Session, Setup

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from urdfcal.arrays import Floats
    from urdfcal.estimation.measurements import Measurement

    _Value: TypeAlias = tuple[Floats, float]

_PLURALS = {"pose": "poses", "camera": "cameras", "led": "LEDs"}


class Recorder:
    """Gathers poses and what was seen of them, and makes a session of it.

        recorder = Recorder(Setup(chain=chain, leds=(Led("led"),), rig=rig))
        for q in poses:
            ...  # move there, and wait until the arm is still
            pose = recorder.pose(q)
            recorder.sighting(pose, "left", "led", uv)
        session = recorder.session()

    A pose, detection or point that makes no sense is refused when it is added, and leaves what is there as it is. One
    thread at a time; the sessions it gives are immutable.
    """

    def __init__(self, setup: Setup) -> None:
        """Start with no pose.

        Args:
            setup: the robot, its LEDs and its cameras; a session's or a rig's, too.
        """
        self._setup = setup
        self._readings: dict[str, Floats] = {}
        self._times: list[float] = []
        self._torques: list[Floats] = []
        # By kind, and the indices of its keys: values and sigma.
        self._measured: dict[type[Measurement], dict[tuple[int, ...], tuple[Floats, float]]] = {
            Detections: {},
            Points: {},
        }

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._readings)

    def pose(
        self,
        joints: Mapping[str, float] | ArrayLike,
        *,
        label: str | None = None,
        time: float | None = None,
        torques: Mapping[str, float] | ArrayLike | None = None,
    ) -> str:
        """Add a pose in which the arm stands still; one in which nothing is measured tells where it came from.

        Args:
            joints: a reading [rad or m] of every actuated joint, by name, or (k,) in the order of ``chain.actuated``.
                Joints of the robot that are not actuated joints of the chain are left out.
            label: what to call the pose; counted from 0 by default.
            time: when it was. [s]
            torques: measured, [N m or N], of the same joints in the same way.

        Returns:
            The label, by which measurements refer to the pose.

        Raises:
            SessionError: a joint is missing or unknown, a reading is no finite number or beyond its limits, the label
                is taken, or some poses have a time or torques and others have not.
        """
        name = str(len(self)) if label is None else str(label)
        where = f"pose {name!r}"
        if problem := flaw(name):
            raise SessionError(problem, where="label")
        if name in self._readings:
            raise SessionError("there is a pose of this label", where=where, remedy="Give every pose its own.")
        by_order = self._by_order(joints, where) if isinstance(joints, Mapping) else joints
        readings = finite_array(by_order, (len(self._setup.chain.actuated),), "joints", where)
        for violation in self._setup.chain.outside_limits(readings[None], OVERRUN)[:1]:
            raise SessionError(str(violation), where=where, remedy="Readings are in radians and metres.")
        for value, others, one, what in (
            (time, self._times, "a time", "time"),
            (torques, self._torques, "torques", "torques"),
        ):
            if len(self) and (value is None) != (not others):
                said = f"no {what}, and others have" if value is None else f"{one}, and others have none"
                raise SessionError(f"it has {said}", where=where, remedy=f"Give all poses {one}, or none.")
        moment = None if time is None else float(finite_array([time], (1,), "time", where)[0])
        if torques is not None:
            by_order = self._by_order(torques, where) if isinstance(torques, Mapping) else torques
            self._torques.append(finite_array(by_order, readings.shape, "torques", where))
        if moment is not None:
            self._times.append(moment)
        self._readings[name] = readings
        return name

    def sighting(self, pose: str, camera: str, led: str, uv: ArrayLike, *, sigma: float | None = None) -> None:
        """Add where a camera saw an LED.

        Args:
            pose: as ``pose`` returned it.
            camera: its name in the rig.
            led: its name.
            uv: (2,) where. [px]
            sigma: standard deviation of u and of v; the setup's by default. [px]

        Raises:
            SessionError: a name is unknown, the place is outside the image, sigma is not positive, or it was seen
                there already.
        """
        where = f"pose {pose!r}, camera {camera!r}, LED {led!r}"
        rig = self._setup.rig
        if not rig.cameras:
            raise SessionError("the setup has no cameras", where=where, remedy="Give it a rig, or add points.")
        key, place = self._indices(pose=pose, camera=camera, led=led), finite_array(uv, (2,), "uv", where)
        if not rig.cameras[key[1]].in_image(place):
            width, height = rig.cameras[key[1]].resolution
            raise SessionError(f"({place[0]:g}, {place[1]:g}) is outside the {width} x {height} image", where=where)
        if key in self._measured[Detections]:
            raise SessionError("it was seen there already", where=where, remedy="Keep one detection.")
        self._add(Detections, key, place, sigma, where)

    def point(self, pose: str, led: str, xyz: ArrayLike, *, sigma: float | None = None) -> None:
        """Add where a tracker measured an LED.

        Args:
            pose: as ``pose`` returned it.
            led: its name.
            xyz: (3,) in the tracker's frame. [m]
            sigma: standard deviation of each coordinate; the setup's by default. [m]

        Raises:
            SessionError: a name is unknown, a number is not finite, sigma is not positive, or it was measured already.
        """
        where = f"pose {pose!r}, LED {led!r}"
        key, place = self._indices(pose=pose, led=led), finite_array(xyz, (3,), "xyz", where)
        if key in self._measured[Points]:
            raise SessionError("it was measured already", where=where, remedy="Keep one point.")
        self._add(Points, key, place, sigma, where)

    def session(self) -> Session:
        """What was recorded so far, validated; recording may go on.

        Raises:
            SessionError: there are too few poses, or nothing was seen.
        """
        # Files and images of what was measured then are not what is measured now.
        anew: dict[str, Any] = {"sha256": {}, "folder": None} if isinstance(self._setup, Positions) else {}
        measurements = []
        for kind, rows in self._measured.items():
            if rows:
                columns: dict[str, Any] = dict(zip(kind.keys, np.array(list(rows), dtype=np.intp).T, strict=True))
                columns[kind.array], columns["sigma"] = map(np.array, zip(*rows.values(), strict=True))
                measurements.append(kind(**columns))
        return Session(
            **self._setup.of_setup(**anew),
            poses=tuple(self._readings),
            q=self._setup.chain.joint_values(np.array(list(self._readings.values())).reshape(len(self), -1)),
            time=np.array(self._times) if self._times else None,
            torques=self._setup.chain.torques(np.array(self._torques)) if self._torques else None,
            measurements=tuple(measurements),
        )

    def _by_order(self, joints: Mapping[str, float], where: str) -> list[float]:
        """The chain's readings out of those of a whole robot."""
        chain, urdf = self._setup.chain, self._setup.urdf
        known = {*chain.names, *(urdf.joints if urdf else ())}
        for name in joints:
            if name not in known:
                check_known(name, chain.actuated, "joints", where)
        missing = [name for name in chain.actuated if name not in joints]
        if missing:
            raise SessionError(f"there is no reading of {', '.join(missing)}", where=where)
        return [joints[name] for name in chain.actuated]

    def _add(
        self, kind: type[Measurement], key: tuple[int, ...], values: Floats, sigma: float | None, where: str
    ) -> None:
        spread = float(finite_array([self._setup.noise.of(kind) if sigma is None else sigma], (1,), "sigma", where)[0])
        if spread <= 0.0:
            raise SessionError(f"sigma is {spread:g}; it must be positive", where=where)
        self._measured[kind][key] = values, spread

    def _indices(self, **names: str) -> tuple[int, ...]:
        """What is named by each key of a kind of measurement, by its index."""
        known = {"pose": tuple(self._readings), "camera": self._setup.rig.names, "led": self._setup.led_names}
        for key, name in names.items():
            if name not in known[key]:
                kind = _PLURALS[key]
                raise SessionError(f"{name!r} is none of the {kind}", remedy=suggest(str(name), known[key], kind))
        return tuple(known[key].index(name) for key, name in names.items())
