"""Bags for tests, written by rosbags: messages of an arm and two cameras, in each of the formats."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.io.making import ACTUATED
from urdfcal.simulation.render import Light, Scenery, Sensor

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from urdfcal.simulation.truth import Simulated

KINDS = ("ros1", "sqlite3", "mcap")
# A day in 2023; nothing in it is a multiple of a power of ten.
START = 1_700_000_123_987_654_321
SIZE = (64, 48)
BASELINE = 0.25

_S = "sensor_msgs/msg/"


@dataclass
class Recording:
    """Messages by topic, and how to write them.

    Attributes:
        kind: ros1, sqlite3 or mcap.
        messages: when each was received [ns], its topic and its content.
    """

    kind: str
    messages: list[tuple[int, str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.types = get_typestore(Stores.ROS1_NOETIC if self.kind == "ros1" else Stores.LATEST)
        if self.kind == "ros1":
            definition = "geometry_msgs/TransformStamped[] transforms\n"
            self.types.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))

    def make(self, type_: str, **fields: Any) -> Any:
        """A message; fields of ROS 2 go by their names in ROS 1 where those differ."""
        known = {name for name, _ in self.types.fielddefs[type_][1]}
        return self.types.types[type_](**{k if k in known else k.upper(): v for k, v in fields.items()})

    def header(self, stamp: int, frame: str = "") -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        seq = {"seq": 0} if self.kind == "ros1" else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **seq)

    def add(self, topic: str, content: Any, stamp: int, received: int | None = None) -> None:
        self.messages.append((stamp + 1_000_000 if received is None else received, topic, content))

    def joints(
        self,
        stamp: int,
        values: Iterable[float],
        names: Iterable[str] = ACTUATED,
        topic: str = "/joint_states",
        received: int | None = None,
    ) -> None:
        nothing = np.zeros(0)
        content = self.make(
            f"{_S}JointState",
            header=self.header(stamp),
            name=list(names),
            position=np.array(list(values), float),
            velocity=nothing,
            effort=nothing,
        )
        self.add(topic, content, stamp, received)

    def image(
        self,
        topic: str,
        stamp: int,
        pixels: np.ndarray,
        encoding: str = "mono8",
        received: int | None = None,
    ) -> None:
        height, width = pixels.shape[:2]
        data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
        content = self.make(
            f"{_S}Image",
            header=self.header(stamp),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=len(data) // height,
            data=data,
        )
        self.add(topic, content, stamp, received)

    def compressed(self, topic: str, stamp: int, data: bytes, format_: str = "jpeg") -> None:
        content = self.make(
            f"{_S}CompressedImage",
            header=self.header(stamp),
            format=format_,
            data=np.frombuffer(data, np.uint8),
        )
        self.add(topic, content, stamp)

    def info(
        self,
        topic: str,
        stamp: int,
        *,
        size: tuple[int, int] = SIZE,
        focal: float = 80.0,
        K: np.ndarray | None = None,
        model: str = "plumb_bob",
        d: Iterable[float] = (-0.1, 0.02, 0.001, -0.002, 0.0),
        baseline: float = 0.0,
        frame: str = "",
        binning: tuple[int, int] = (0, 0),
        roi: tuple[int, int, int, int] = (0, 0, 0, 0),
    ) -> None:
        if K is None:
            K = np.array([[focal, 0.0, size[0] / 2 + 0.25], [0.0, focal + 1.0, size[1] / 2 - 0.5], [0.0, 0.0, 1.0]])
        P = np.column_stack([K, [-K[0, 0] * baseline, 0.0, 0.0]])
        region = dict(zip(("x_offset", "y_offset", "width", "height"), roi, strict=True))
        content = self.make(
            f"{_S}CameraInfo",
            header=self.header(stamp, frame),
            height=size[1],
            width=size[0],
            distortion_model=model,
            d=np.array(list(d), float),
            k=K.ravel(),
            r=np.eye(3).ravel(),
            p=P.ravel(),
            binning_x=binning[0],
            binning_y=binning[1],
            roi=self.make(f"{_S}RegionOfInterest", do_rectify=False, **region),
        )
        self.add(topic, content, stamp)

    def static(self, stamp: int, transforms: Iterable[tuple[str, str, Iterable[float], Iterable[float]]]) -> None:
        """Transforms: parent, child, x y z in m, quaternion x y z w."""
        g = "geometry_msgs/msg/"
        content = [
            self.make(
                f"{g}TransformStamped",
                header=self.header(stamp, parent),
                child_frame_id=child,
                transform=self.make(
                    f"{g}Transform",
                    translation=self.make(f"{g}Vector3", **dict(zip("xyz", shift, strict=True))),
                    rotation=self.make(f"{g}Quaternion", **dict(zip("xyzw", quaternion, strict=True))),
                ),
            )
            for parent, child, shift, quaternion in transforms
        ]
        self.add("/tf_static", self.make("tf2_msgs/msg/TFMessage", transforms=content), stamp)

    def text(self, topic: str, text: str) -> None:
        self.add(topic, self.make("std_msgs/msg/String", data=text), START)

    def drop(self, topic: str) -> None:
        self.messages = [message for message in self.messages if message[1] != topic]

    def write(self, path: Path) -> Path:
        """Write the messages in the order in which they were received; of ROS 2 a folder, of ROS 1 a .bag file."""
        path = path.with_suffix(".bag" if self.kind == "ros1" else "")
        plugin = rosbag2.StoragePlugin.MCAP if self.kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer: Any = (
            rosbag1.Writer(path) if self.kind == "ros1" else rosbag2.Writer(path, version=9, storage_plugin=plugin)
        )
        serialize = self.types.serialize_ros1 if self.kind == "ros1" else self.types.serialize_cdr
        connections: dict[tuple[str, str], Any] = {}
        with writer:
            for received, topic, content in sorted(self.messages, key=lambda message: message[0]):
                type_ = content.__msgtype__
                if (topic, type_) not in connections:
                    connections[topic, type_] = writer.add_connection(topic, type_, typestore=self.types)
                writer.write(connections[topic, type_], received, serialize(content, type_))
        return path


def pixels(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A image that is like no other."""
    return np.random.default_rng(number).integers(0, 256, (size[1], size[0]), np.uint8)


def recording(kind: str, seconds: float = 1.0) -> Recording:
    """An arm at 125 Hz before two cameras at 30 Hz."""
    bag = Recording(kind)
    for i in range(round(125 * seconds)):
        bag.joints(START + 8_000_000 * i + i % 7, 0.3 * np.sin(0.01 * i + np.arange(len(ACTUATED))))
    for i in range(round(30 * seconds)):
        for camera, name in enumerate(("left", "right")):
            stamp = START + 33_333_333 * i + 1_234_567 * (camera + 1)
            bag.image(f"/{name}/image_raw", stamp, pixels(2 * i + camera))
            bag.info(f"/{name}/camera_info", stamp, baseline=BASELINE * camera, frame=f"{name}_optical_frame")
    return bag


def stopping(kind: str, simulated: Simulated, *, noise: float = 2e-5, seconds: float = 1.2) -> Recording:
    """What a simulated arm looks like that stops in each pose: joints at 50 Hz, images at 5 Hz, the LED where it is.

    Args:
        kind: of the bag.
        simulated: the arm, its poses, the LED, and cameras that stand or ride.
        noise: of the joint readings. [rad or m]
        seconds: that it stops; from stop to stop it takes half a second.
    """
    session, truth, bag = simulated.session, simulated.truth, Recording(kind)
    rng, period = np.random.default_rng(0), seconds + 0.5

    def motion(time: float) -> np.ndarray:
        i = min(int(time / period), len(truth.q) - 1)
        u = max((time - i * period - seconds) / 0.5, 0.0) if i + 1 < len(truth.q) else 0.0
        return truth.q[i] + (truth.q[min(i + 1, len(truth.q) - 1)] - truth.q[i]) * u * u * (3.0 - 2.0 * u)

    end = period * len(truth.q) - 0.5
    for i in range(round(50 * end)):
        readings = session.chain.readings(motion(0.02 * i)[None])[0]
        bag.joints(START + 20_000_000 * i, readings + rng.normal(0.0, noise, readings.shape), session.chain.actuated)
    for camera, one in enumerate(session.rig.cameras):
        sensor, scenery = Sensor(one.resolution), Scenery.flat(one.resolution, 25.0)
        for i in range(round(5 * end)):
            stamp = 200_000_000 * i + 3_000_000
            uv = truth.pixels(motion(1e-9 * stamp)[None])[0, camera, 0]
            lights = [Light(uv, 1500.0, 1.5)] if one.in_image(uv) else []
            bag.image(f"/{one.name}/image_raw", START + stamp, sensor.expose(scenery.expected(lights), rng))
        fu, fv, cu, cv = one.intrinsics
        bag.info(
            f"/{one.name}/camera_info",
            START,
            size=one.resolution,
            K=np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]]),
            d=np.pad(one.distortion, (0, 5 - len(one.distortion))),
            frame=f"{one.name}_optical_frame",
        )
    return bag


def moving(kind: str, simulated: Simulated, seconds: float, offsets: Sequence[float]) -> Recording:
    """What a simulated arm looks like while it moves through its poses: joints at 125 Hz, images at 30 Hz.

    Args:
        kind: of the bag.
        simulated: the arm, its poses, the LED, and two cameras without distortion or with radtan.
        seconds: that it takes.
        offsets: of each camera's clock: a image is taken that much after its stamp. [s]
    """
    session, truth, bag = simulated.session, simulated.truth, Recording(kind)
    rig = session.rig

    def motion(time: float) -> np.ndarray:
        """Joint values (n,): from pose to pose with the least jerk, and never beyond either."""
        steps = len(truth.q) - 1
        i = min(int(time / seconds * steps), steps - 1)
        u = time / seconds * steps - i
        return truth.q[i] + (truth.q[i + 1] - truth.q[i]) * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5)

    actuated = [joint.mimic is None for joint in session.chain.joints]
    for i in range(round(125 * seconds)):
        bag.joints(START + 8_000_000 * i, motion(0.008 * i)[actuated], session.chain.actuated)
    scene = simulated.truth
    rng = np.random.default_rng(0)
    for camera, (one, offset) in enumerate(zip(rig.cameras, offsets, strict=True)):
        sensor, scenery = Sensor(one.resolution), Scenery.flat(one.resolution, 25.0)
        for i in range(round(30 * seconds)):
            stamp = 33_333_333 * i
            uv = scene.pixels(motion(1e-9 * stamp + offset)[None])[0, camera, 0]
            lights = [Light(uv, 1500.0, 1.5)] if one.in_image(uv) else []
            image = sensor.expose(scenery.expected(lights), rng)
            bag.image(f"/{one.name}/image_raw", START + stamp, image)
            bag.info(
                f"/{one.name}/camera_info",
                START + stamp,
                size=one.resolution,
                K=np.array(
                    [[one.intrinsics[0], 0, one.intrinsics[2]], [0, one.intrinsics[1], one.intrinsics[3]], [0, 0, 1]]
                ),
                d=np.pad(one.distortion, (0, 5 - len(one.distortion))),
                frame=f"{one.name}_optical_frame",
            )
    T = pin.SE3(np.linalg.inv(np.array(rig.T_cam_world[1])))
    first, second = (f"{name}_optical_frame" for name in rig.names)
    bag.static(START, [(first, second, T.translation, pin.Quaternion(T.rotation).coeffs())])
    return bag
