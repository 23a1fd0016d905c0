"""The keys of session.yaml and rig.yaml."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    WrapValidator,
    create_model,
    model_validator,
)

from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.measurements import MEASUREMENTS, Measurement
from urdfcal.names import flaw
from urdfcal.robot.dh import Parameter  # noqa: TC001  # pydantic needs it at run time
from urdfcal.rotations import rpy_to_matrix
from urdfcal.session.attachments import CameraMount
from urdfcal.session.knowledge import (
    ArmGeometry,
    Estimate,
    Freedom,
    JointError,
    Led,
    LedDistance,
    Noise,
    Payload,
    TimeOffset,
    Tolerances,
)


def _named(name: str) -> str:
    if problem := flaw(name):
        raise ValueError(problem)
    return name


Name = Annotated[str, AfterValidator(_named)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class _Keys(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class RobotKeys(_Keys):
    """Which chain of which robot."""

    urdf: Name
    tip_link: Name
    base_link: Name | None = None


class LedKeys(_Keys):
    """Where an LED sits on its link (the tip link, if none is named), and how well that is known, in m."""

    link: Name | None = None
    position: Vector | None = None
    sigma: NotNegative | None = None

    @model_validator(mode="after")
    def _sigma_of_something(self) -> LedKeys:
        if self.sigma is not None and self.position is None:
            raise ValueError("sigma is given without a position")
        return self


class LedDistanceKeys(_Keys):
    """The distance of two LEDs, in m."""

    leds: tuple[Name, Name] = Field(strict=False)
    distance: Positive
    sigma: Positive


class MountKeys(_Keys):
    """The link of an eye-in-hand camera, where on it (m, rad; the camera's z looks forward, y down), and how surely."""

    link: Name
    position: Vector | None = None
    rpy: Vector | None = None
    sigma: tuple[Positive, Positive] | None = Field(default=None, strict=False)

    @model_validator(mode="after")
    def _whole(self) -> MountKeys:
        if (self.position is None) != (self.rpy is None):
            raise ValueError("position and rpy are given together, or neither")
        if self.sigma is not None and self.position is None:
            raise ValueError("sigma is given without a position")
        return self

    def mount(self, camera: str) -> CameraMount:
        """The same in arrays."""
        if self.position is None or self.rpy is None:
            return CameraMount(camera, self.link)
        T_link_camera = np.eye(4)
        T_link_camera[:3, :3], T_link_camera[:3, 3] = rpy_to_matrix(np.array(self.rpy)), self.position
        sigma = None if self.sigma is None else np.repeat(self.sigma, 3)
        return CameraMount(camera, self.link, T_link_camera, sigma)


class CamerasKeys(_Keys):
    """The camera file; every other key is an eye-in-hand camera."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, MountKeys] = Field(init=False)

    file: Name

    @property
    def mounts(self) -> tuple[CameraMount, ...]:
        """The cameras that ride on the robot."""
        return tuple(keys.mount(camera) for camera, keys in self.__pydantic_extra__.items())


_Cameras = Annotated[CamerasKeys, BeforeValidator(lambda value: {"file": value} if isinstance(value, str) else value)]

if TYPE_CHECKING:
    from collections.abc import Callable

    NoiseKeys: TypeAlias = _Keys
    JointModelName: TypeAlias = str
else:
    NoiseKeys = create_model(
        "NoiseKeys",
        __base__=_Keys,
        __doc__="Standard deviations of the joint readings, and of each kind of measurement.",
        joint=(NotNegative, 0.0),
        **{kind.noise: (Positive, kind.usual) for kind in MEASUREMENTS},
    )
    JointModelName = Literal[tuple(model.name for model in JOINT_MODELS)]


def _by_joint(value: Any, on_or_off: Callable[[Any], bool]) -> bool | dict[str, bool]:
    """Read what switches a model on or off, for all joints or for each by name."""
    if isinstance(value, dict):
        return {str(joint): on_or_off(said) for joint, said in value.items()}
    return on_or_off(value)


_JointModels = Annotated[
    dict[JointModelName, Annotated[bool, WrapValidator(_by_joint)]],
    BeforeValidator(lambda value: {} if value == "auto" else value),
]


class EstimateKeys(_Keys):
    """What is to be estimated; what is not named is left to the calibration."""

    geometry: ArmGeometry | None = None
    intrinsics: Freedom | dict[str, Freedom] | None = None
    extrinsics: Freedom | dict[str, Freedom] | None = None
    time_offset: TimeOffset | None = None


_Estimate = Annotated[EstimateKeys, BeforeValidator(lambda value: {} if value == "auto" else value)]


class TolerancesKeys(_Keys):
    """How far the robot may be from nominal; every other key is a joint, with the exceptions for its row."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, dict[Parameter, NotNegative]] = Field(init=False)

    length: NotNegative = Tolerances.length
    angle: NotNegative = Tolerances.angle
    zero: NotNegative = Tolerances.zero


class ScaleKeys(_Keys):
    """How well the unit of the cameras' baselines, or of a tracker's points, is known: a share of any length."""

    sigma: NotNegative


class PayloadKeys(_Keys):
    """What the arm carried: on which link, its mass in kg, and its centre there in m."""

    link: Name
    mass: Positive
    center: Vector


def _known_direction(gravity: Any) -> Any:
    if isinstance(gravity, dict):
        raise ValueError(  # noqa: TRY004  # pydantic's way
            "the direction of gravity cannot be estimated: measure how the base leans, and write [x, y, z] in the base "
            "link's frame, in m/s^2"
        )
    return gravity


class StandKeys(_Keys):
    """Where a rig's first camera stands and looks, in the base link's frame, in m."""

    position: Vector
    look_at: Vector

    @model_validator(mode="after")
    def _looks_somewhere(self) -> StandKeys:
        if self.position == self.look_at:
            raise ValueError("position and look_at are the same place")
        return self


def _at_least_one(leds: dict[str, LedKeys]) -> dict[str, LedKeys]:
    if not leds:
        raise ValueError("there is no LED: name at least one")
    return leds


def _at_rest(estimate: EstimateKeys) -> EstimateKeys:
    if estimate.time_offset is not None:
        raise ValueError("time_offset belongs into a session with frames")
    return estimate


def _texts(value: Any) -> Any:
    """A list of one where a name stands alone, and of texts whatever YAML made of them."""
    listed = [] if value is None else value if isinstance(value, list) else [value]
    return [item if item is None or isinstance(item, (list, dict)) else str(item) for item in listed]


_Names = Annotated[list[Name], BeforeValidator(_texts)]


class ExcludeKeys(_Keys):
    """What does not count; of poses ranges, too."""

    poses: _Names = []
    cameras: _Names = []
    leds: _Names = []


class SetupFile(_Keys):
    """What rig.yaml and session.yaml share."""

    robot: RobotKeys
    # "led:" with nothing behind it is the natural way to write an LED of unknown place.
    leds: Annotated[
        dict[Name, Annotated[LedKeys, BeforeValidator(lambda value: {} if value is None else value)]],
        AfterValidator(_at_least_one),
    ]
    led_distances: list[LedDistanceKeys] = []
    cameras: _Cameras | None = None
    noise: NoiseKeys = NoiseKeys()
    estimate: _Estimate = EstimateKeys()
    tolerances: TolerancesKeys = TolerancesKeys()
    joint_models: _JointModels = {}
    scale: ScaleKeys | None = None
    payload: PayloadKeys | None = None
    gravity: Annotated[Vector | None, BeforeValidator(_known_direction)] = None
    gear_ratio: dict[Name, Positive] = {}

    def setup(self) -> dict[str, Any]:
        """The parts that need no other file, as arguments of :class:`~urdfcal.session.model.Setup`."""
        noise, tolerances = self.noise.model_dump(exclude_unset=True), self.tolerances
        own = {name: noise.pop(name) for name in ("pixel", "point", "joint") if name in noise}
        exceptions: Any = tolerances.__pydantic_extra__
        return {
            "leds": tuple(Led(name, **dict(led)) for name, led in self.leds.items()),
            "mounts": self.cameras.mounts if self.cameras is not None else (),
            "led_distances": tuple(LedDistance(**dict(distance)) for distance in self.led_distances),
            "noise": Noise(**own, other=noise),
            "estimate": Estimate(**dict(self.estimate)),
            "tolerances": Tolerances(tolerances.length, tolerances.angle, tolerances.zero, exceptions),
            "joint_models": self.joint_models,
            "scale_sigma": None if self.scale is None else self.scale.sigma,
            "payload": None if self.payload is None else Payload(**dict(self.payload)),
            "gear_ratio": self.gear_ratio,
            **({} if self.gravity is None else {"gravity": np.array(self.gravity)}),
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

    cameras: _Cameras
    estimate: Annotated[_Estimate, AfterValidator(_at_rest)] = EstimateKeys()
    stand: StandKeys | None = None
    errors: dict[JointError, Annotated[Any, AfterValidator(_sizes)]] = {}


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
        if self.frames is not None and self.cameras is None:
            raise ValueError("frames are named, but no cameras")
        if self.frames is None and self.estimate.time_offset is not None:
            raise ValueError("estimate.time_offset is given, but no frames: they do not matter to an arm at rest")
        return self
