"""The keys of session.yaml and rig.yaml."""

from __future__ import annotations

from datetime import date
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    WrapValidator,
    create_model,
    model_validator,
)

from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.measurements import MEASUREMENTS, Measurement
from urdfcal.io.keys import Keys, Name, NotNegative, PlaceKeys, Positive, ScaleKeys, Vector
from urdfcal.io.scene import ObstacleKeys, obstacles
from urdfcal.io.target_keys import AnyTargetKeys  # noqa: TC001  # as of the next
from urdfcal.robot.dh import Parameter  # noqa: TC001  # pydantic needs it at run time
from urdfcal.session.attachments import CameraMount
from urdfcal.session.knowledge import (
    AUTO,
    ArmGeometry,
    Estimate,
    Freedom,
    JointError,
    JointModelSaid,
    Led,
    LedDistance,
    Noise,
    Payload,
    PlaceDistance,
    TimeOffset,
    Tolerances,
)


class RobotKeys(Keys):
    """Which chain of which robot."""

    urdf: Name
    tip_link: Name
    base_link: Name | None = None


class LedKeys(Keys):
    """Where an LED sits on its link (the tip link, if none is named), and how well that is known, in m."""

    link: Name | None = None
    position: Vector | None = None
    sigma: NotNegative | None = None

    @model_validator(mode="after")
    def _sigma_of_something(self) -> LedKeys:
        if self.sigma is not None and self.position is None:
            raise ValueError("sigma is given without a position")
        return self


class LedDistanceKeys(Keys):
    """The distance of two LEDs, in m."""

    leds: tuple[Name, Name] = Field(strict=False)
    distance: Positive
    sigma: Positive


class PlaceDistanceKeys(Keys):
    """The distance of two places, in m."""

    places: tuple[Name, Name] = Field(strict=False)
    distance: Positive
    sigma: Positive


class MountKeys(PlaceKeys):
    """The link of an eye-in-hand camera, where on it (m, rad; the camera's z looks forward, y down), and how surely."""

    link: Name
    sigma: tuple[Positive, Positive] | None = Field(default=None, strict=False)

    def mount(self, camera: str) -> CameraMount:
        """The same in arrays."""
        return CameraMount(camera, self.link, self.T, None if self.sigma is None else np.repeat(self.sigma, 3))


class CamerasKeys(Keys):
    """The camera file; every other key is an eye-in-hand camera."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, MountKeys] = Field(init=False)

    file: Name

    @property
    def mounts(self) -> tuple[CameraMount, ...]:
        """The cameras that ride on the robot."""
        return tuple(keys.mount(camera) for camera, keys in self.__pydantic_extra__.items())


_Cameras = Annotated[CamerasKeys, BeforeValidator(lambda value: {"file": value} if isinstance(value, str) else value)]


def _pairs(value: Any) -> Any:
    """Take apart what is said of several numbers under one key: pose: [m, rad]."""
    keys = {kind.noise: [of.noise for of in kind.spreads.values()] for kind in MEASUREMENTS if kind.spreads}
    for name, own in keys.items() if isinstance(value, dict) else ():
        said = value.get(name)
        if isinstance(said, list) and len(said) == len(own):
            value = {**value, **dict(zip(own, said, strict=True))}
    return value


if TYPE_CHECKING:
    from collections.abc import Callable

    NoiseKeys: TypeAlias = Keys
    JointModelName: TypeAlias = str
else:
    NoiseKeys = create_model(
        "NoiseKeys",
        __base__=Keys,
        __doc__="Standard deviations of the joint readings, and of each kind of measurement.",
        joint=(NotNegative, 0.0),
        __validators__={"pair": model_validator(mode="before")(_pairs)},
        **{of.noise: (Positive, of.usual) for kind in MEASUREMENTS for of in kind.spread_of().values()},
    )
    JointModelName = Literal[tuple(model.name for model in JOINT_MODELS)]


def _by_joint(value: Any, on_or_off: Callable[[Any], bool]) -> JointModelSaid:
    """Read what switches a model on or off or leaves it to the measurements, for all joints or for each by name."""

    def read(said: Any) -> bool | Literal["auto"]:
        quoted = {"on": True, "off": False}  # YAML takes them for on and off only where they are not
        return AUTO if said == AUTO else on_or_off(quoted.get(said, said) if isinstance(said, str) else said)

    return {str(joint): read(said) for joint, said in value.items()} if isinstance(value, dict) else read(value)


_JointModels = Annotated[
    dict[JointModelName, Annotated[bool, WrapValidator(_by_joint)]],
    BeforeValidator(lambda value: {} if value == AUTO else value),
]


class EstimateKeys(Keys):
    """What is to be estimated; what is not named is left to the calibration."""

    geometry: ArmGeometry | None = None
    intrinsics: Freedom | dict[str, Freedom] | None = None
    extrinsics: Freedom | dict[str, Freedom] | None = None
    time_offset: TimeOffset | None = None


_Estimate = Annotated[EstimateKeys, BeforeValidator(lambda value: {} if value == "auto" else value)]


class TolerancesKeys(Keys):
    """How far the robot may be from nominal; every other key is a joint, with the exceptions for its row."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, dict[Parameter, NotNegative]] = Field(init=False)

    length: NotNegative = Tolerances.length
    angle: NotNegative = Tolerances.angle
    zero: NotNegative = Tolerances.zero


class PayloadKeys(Keys):
    """What the arm carried: on which link, its mass in kg, and its centre there in m."""

    link: Name
    mass: Positive
    center: Vector


class DirectionKeys(Keys):
    """A direction that is to be found."""

    direction: Literal["free"]


_Gravity = Annotated[
    Annotated[Vector, Tag("[vector]")] | Annotated[DirectionKeys, Tag("[direction]")],
    Discriminator(lambda value: "[direction]" if isinstance(value, dict) else "[vector]"),
]


class StandKeys(Keys):
    """Where a rig's first camera stands and looks, in the base link's frame, in m."""

    position: Vector
    look_at: Vector

    @model_validator(mode="after")
    def _looks_somewhere(self) -> StandKeys:
        if self.position == self.look_at:
            raise ValueError("position and look_at are the same place")
        return self


def _at_rest(estimate: EstimateKeys) -> EstimateKeys:
    if estimate.time_offset is not None:
        raise ValueError("time_offset belongs into a session with frames")
    return estimate


def _texts(value: Any) -> Any:
    """A list of one where a name stands alone, and of texts whatever YAML made of them."""
    listed = [] if value is None else value if isinstance(value, list) else [value]
    return [item if item is None or isinstance(item, (list, dict)) else str(item) for item in listed]


_Names = Annotated[list[Name], BeforeValidator(_texts)]


class ExcludeKeys(Keys):
    """What does not count; of poses ranges, too."""

    poses: _Names = Field(default=[])
    cameras: _Names = Field(default=[])
    leds: _Names = Field(default=[])


# "led:" with nothing behind it is the natural way to write an LED of unknown place.
_Led = Annotated[LedKeys, BeforeValidator(lambda value: {} if value is None else value)]


def _plainly(value: Any) -> Any:
    """Texts of numbers and dates as well: a serial number is one of both to YAML."""
    if not isinstance(value, dict):
        return value
    return {key: str(of) if isinstance(of, (int, float, date)) else of for key, of in value.items()}


_About = Annotated[dict[Name, str], BeforeValidator(_plainly)]


class SetupFile(Keys):
    """What rig.yaml and session.yaml share."""

    robot: RobotKeys
    leds: dict[Name, Annotated[LedKeys, BeforeValidator(lambda value: {} if value is None else value)]] = Field(
        default={}
    )
    targets: dict[Name, AnyTargetKeys] = Field(default={})
    led_distances: list[LedDistanceKeys] = Field(default=[])
    place_distances: list[PlaceDistanceKeys] = Field(default=[])
    cameras: _Cameras | None = None
    noise: NoiseKeys = NoiseKeys()
    estimate: _Estimate = EstimateKeys()
    tolerances: TolerancesKeys = TolerancesKeys()
    joint_models: _JointModels = Field(default={})
    scale: ScaleKeys | None = None
    payload: PayloadKeys | None = None
    gravity: _Gravity | None = None
    gear_ratio: dict[Name, Positive] = Field(default={})
    scene: dict[Name, ObstacleKeys] = Field(default={})
    about: _About = Field(default={})

    @model_validator(mode="after")
    def _something_is_seen(self) -> SetupFile:
        if not self.leds and not self.targets:
            raise ValueError("there is neither an LED nor a target: name at least one")
        return self

    def setup(self) -> dict[str, Any]:
        """The parts that need no other file, as arguments of :class:`~urdfcal.session.model.Setup`."""
        noise, tolerances = self.noise.model_dump(exclude_unset=True), self.tolerances
        own = {name: noise.pop(name) for name in ("pixel", "point", "joint") if name in noise}
        exceptions: Any = tolerances.__pydantic_extra__
        return {
            "leds": tuple(Led(name, **dict(led)) for name, led in self.leds.items()),
            "targets": tuple(target.target(name, self.scale) for name, target in self.targets.items()),
            "mounts": self.cameras.mounts if self.cameras is not None else (),
            "led_distances": tuple(LedDistance(**dict(distance)) for distance in self.led_distances),
            "place_distances": tuple(PlaceDistance(**dict(distance)) for distance in self.place_distances),
            "noise": Noise(**own, other=noise),
            "estimate": Estimate(**dict(self.estimate), gravity=getattr(self.gravity, "direction", None)),
            "tolerances": Tolerances(tolerances.length, tolerances.angle, tolerances.zero, exceptions),
            "joint_models": self.joint_models,
            "scale_sigma": None if self.scale is None else self.scale.sigma,
            "payload": None if self.payload is None else Payload(**dict(self.payload)),
            "gear_ratio": self.gear_ratio,
            "scene": obstacles(self.scene),
            "about": self.about,
            **({"gravity": np.array(self.gravity)} if isinstance(self.gravity, tuple | list) else {}),
        }


def _sizes(value: Any) -> Any:
    """A size of an error of joints: of all, or of each by name, or drawn."""

    def number(size: Any) -> bool:
        return isinstance(size, (int, float)) and not isinstance(size, bool) and bool(np.isfinite(size))

    each = value.values() if isinstance(value, dict) else [value]
    if value != "default" and not all(map(number, each)):
        raise ValueError(f"{value!r} stands where default, a number, or a number for each of some joints belongs")
    return value


class RigFile(SetupFile):
    """rig.yaml."""

    estimate: Annotated[_Estimate, AfterValidator(_at_rest)] = EstimateKeys()
    stand: StandKeys | None = None
    places: dict[Name, Vector] = Field(default={})
    errors: dict[JointError, Annotated[Any, AfterValidator(_sizes)]] = Field(default={})

    @model_validator(mode="after")
    def _measured(self) -> RigFile:
        if self.cameras is None and not self.places:
            raise ValueError("there are neither cameras nor places to touch: nothing can be measured")
        return self


if TYPE_CHECKING:
    _Tables: TypeAlias = SetupFile
else:
    _Tables = create_model("_Tables", __base__=SetupFile, **{kind.kind: (Name | None, None) for kind in MEASUREMENTS})


class SessionFile(_Tables):
    """session.yaml."""

    joints: Name
    frames: Name | None = None
    torques: Name | None = None
    previous: Name | None = None
    exclude: ExcludeKeys = ExcludeKeys()
    moved: dict[Name, _Names] = Field(default_factory=dict)

    @property
    def tables(self) -> dict[type[Measurement], str]:
        """The file of each kind of measurement that is named."""
        named = {kind: getattr(self, kind.kind) for kind in MEASUREMENTS}
        return {kind: name for kind, name in named.items() if name is not None}

    @model_validator(mode="after")
    def _measured(self) -> SessionFile:
        for kind in self.tables:
            if "camera" in kind.keys and self.cameras is None:
                raise ValueError(f"{kind.kind} are named, but no cameras")
            if self.frames is not None and "camera" not in kind.keys:
                both = f"frames and {kind.kind} are both named"
                raise ValueError(f"{both}: {kind.kind} belong to an arm that stands still")
        for name in ("torques", "previous"):
            if self.frames is not None and getattr(self, name) is not None:
                raise ValueError(f"frames and {name} are both named: {name} belongs to an arm that stands still")
        if self.scale is not None and self.tables and not any(kind.array for kind in self.tables):
            what = "scale says how well the lengths of what measures are known, and nothing here measures any"
            raise ValueError(f"{what}: place_distances have a sigma of their own")
        if self.place_distances and not any("place" in kind.keys for kind in self.tables):
            raise ValueError("place_distances are given, but nothing that names places, such as contacts")
        if self.frames is not None and self.cameras is None:
            raise ValueError("frames are named, but no cameras")
        if self.frames is None and self.estimate.time_offset is not None:
            raise ValueError("estimate.time_offset is given, but no frames: they do not matter to an arm at rest")
        return self
