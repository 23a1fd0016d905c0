"""session.yaml and rig.yaml: their keys, checked strictly, every error with its line, column and key."""

from __future__ import annotations

import re
import reprlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args

import numpy as np
import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from urdfcal.errors import SessionError
from urdfcal.names import flaw, listed, suggest
from urdfcal.robot.dh import Parameter  # noqa: TC001  # pydantic needs it at run time
from urdfcal.rotations import rpy_to_matrix
from urdfcal.session.attachments import CameraMount
from urdfcal.session.model import Estimate, Freedom, Geometry, Led, LedDistance, Noise, TimeOffset, Tolerances
from urdfcal.source import Source

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from pydantic_core import ErrorDetails


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
    """The link that a camera rides on, where on it (m, rad; the camera's z looks forward, y down), and how surely."""

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
    """The camera file; every other key is a camera that rides on the robot."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, MountKeys] = Field(init=False)

    file: Name

    @property
    def mounts(self) -> tuple[CameraMount, ...]:
        """The cameras that ride on the robot."""
        return tuple(keys.mount(camera) for camera, keys in self.__pydantic_extra__.items())


def _file_alone(value: Any) -> Any:
    return {"file": value} if isinstance(value, str) else value


class NoiseKeys(_Keys):
    """Standard deviations of what was measured."""

    pixel: Positive = Noise.pixel
    point: Positive = Noise.point
    joint: NotNegative = Noise.joint


class EstimateKeys(_Keys):
    """What is to be estimated; what is not named is left to the calibration."""

    geometry: Geometry | None = None
    intrinsics: Freedom | dict[str, Freedom] | None = None
    extrinsics: Freedom | dict[str, Freedom] | None = None
    time_offset: TimeOffset | None = None


class TolerancesKeys(_Keys):
    """How far the robot may be from its drawing; every other key is a joint, with the exceptions for its row."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, dict[Parameter, NotNegative]] = Field(init=False)

    length: NotNegative = Tolerances.length
    angle: NotNegative = Tolerances.angle
    zero: NotNegative = Tolerances.zero

    @property
    def joints(self) -> dict[str, dict[str, float]]:
        """The exceptions, by joint and parameter."""
        return {joint: {str(k): value for k, value in of.items()} for joint, of in self.__pydantic_extra__.items()}


class StandKeys(_Keys):
    """Where a rig's first camera stands and looks, in the base link's frame, in m."""

    position: Vector
    look_at: Vector


def _nothing_is_empty(value: Any) -> Any:
    # "led:" with nothing behind it is the natural way to write an LED of unknown place.
    return {} if value is None else value


class SetupFile(_Keys):
    """What rig.yaml and session.yaml share."""

    robot: RobotKeys
    leds: dict[Name, Annotated[LedKeys, BeforeValidator(_nothing_is_empty)]]
    led_distances: list[LedDistanceKeys] = []
    cameras: Annotated[CamerasKeys, BeforeValidator(_file_alone)] | None = None
    noise: NoiseKeys = NoiseKeys()
    estimate: EstimateKeys = EstimateKeys()
    tolerances: TolerancesKeys = TolerancesKeys()

    @field_validator("leds")
    @classmethod
    def _one_led(cls, leds: dict[str, LedKeys]) -> dict[str, LedKeys]:
        if not leds:
            raise ValueError("there is no LED: name at least one")
        return leds

    @field_validator("estimate", mode="before")
    @classmethod
    def _auto(cls, value: Any) -> Any:
        return {} if value == "auto" else value

    def setup(self) -> dict[str, Any]:
        """The parts that need no other file, as arguments of :class:`~urdfcal.session.model.Setup`."""
        return {
            "leds": tuple(Led(name, led.position, led.sigma, led.link) for name, led in self.leds.items()),  # type: ignore[arg-type]
            "mounts": self.cameras.mounts if self.cameras is not None else (),
            "led_distances": tuple(LedDistance(d.leds, d.distance, d.sigma) for d in self.led_distances),
            "noise": Noise(**self.noise.model_dump()),
            "estimate": Estimate(**self.estimate.model_dump()),
            "tolerances": Tolerances(
                self.tolerances.length, self.tolerances.angle, self.tolerances.zero, self.tolerances.joints
            ),
        }


class RigFile(SetupFile):
    """rig.yaml."""

    cameras: Annotated[CamerasKeys, BeforeValidator(_file_alone)]
    stand: StandKeys | None = None

    @field_validator("stand")
    @classmethod
    def _looks_somewhere(cls, stand: StandKeys | None) -> StandKeys | None:
        if stand is not None and stand.position == stand.look_at:
            raise ValueError("position and look_at are the same place")
        return stand

    @field_validator("estimate")
    @classmethod
    def _has_no_clocks(cls, estimate: EstimateKeys) -> EstimateKeys:
        if estimate.time_offset is not None:
            raise ValueError("time_offset belongs into a session with frames")
        return estimate


class SessionFile(SetupFile):
    """session.yaml."""

    joints: Name
    frames: Name | None = None
    detections: Name | None = None
    points: Name | None = None

    @model_validator(mode="after")
    def _measured(self) -> SessionFile:
        if self.detections is not None and self.cameras is None:
            raise ValueError("detections are named, but no cameras")
        if self.frames is not None and self.cameras is None:
            raise ValueError("frames are named, but no cameras")
        if self.frames is not None and self.points is not None:
            raise ValueError("frames and points are both named: a tracker's points belong to an arm that stands still")
        if self.frames is None and self.estimate.time_offset is not None:
            raise ValueError("estimate.time_offset is given, but no frames: clocks do not matter to an arm at rest")
        return self


_Model = TypeVar("_Model", bound=SetupFile)
_KEY_OF_MAPPING = "[key]"
# A few anchors in a YAML file can stand for a list of billions: a message shows its beginning.
_SHORT = reprlib.Repr()
_SHORT.maxstring, _SHORT.maxlist, _SHORT.maxdict, _SHORT.maxlevel = 60, 4, 4, 1


@dataclass(frozen=True)
class Document:
    """A YAML file, with the place of everything in it.

    Attributes:
        source: the file.
        node: its root, as PyYAML composed it.
        data: what it says.
    """

    source: Source
    node: yaml.Node
    data: Any

    @classmethod
    def read(cls, path: Path) -> Document:
        """Read ``path``.

        Raises:
            SessionError: it cannot be read or is no YAML.
        """
        source = Source.read(path)
        try:
            loader = _Loader(source.text)
            node = loader.get_single_node()
            data = loader.construct_document(node) if node is not None else None
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            where = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
            raise SessionError(f"this is no YAML: {error.problem}", where=where) from error
        except yaml.reader.ReaderError as error:
            line = source.text.count("\n", 0, error.position) + 1
            raise SessionError(f"this is no YAML: {error.reason}", where=f"{path}:{line}") from error
        except RecursionError as error:
            raise SessionError("this is no YAML: it is nested too deeply", where=str(path)) from error
        if node is None:
            raise SessionError("the file is empty", where=str(path), remedy="It needs at least robot and leds.")
        return cls(source, node, data)

    def place(self, *keys: str | int) -> str:
        """Where ``keys`` lead: file:line:column of the last one that is there, and all of them, joined by dots."""
        node, mark = self.node, self.node.start_mark
        for key in keys:
            inner = _child(node, key)
            if inner is None:
                break
            node, mark = inner
        path = ".".join(str(key) for key in keys)
        named = f", key {path!r}" if path else ""
        return f"{self.source.path}:{mark.line + 1}:{mark.column + 1}{named}"

    def validate(self, model: type[_Model]) -> _Model:
        """Check the data against ``model``.

        Raises:
            SessionError: about the first thing that is wrong, saying how many more there are.
        """
        try:
            return model.model_validate(self.data)
        except ValidationError as error:
            raise self._translated(model, error.errors()) from None

    def _translated(self, model: type[SetupFile], errors: Sequence[ErrorDetails]) -> SessionError:
        # A misspelt key is unknown and, under its right name, missing: the first says more.
        first = min(errors, key=lambda error: error["type"] != "extra_forbidden")
        keys = [key for key in first["loc"] if key != _KEY_OF_MAPPING]
        what, remedy = _explained(first, _allowed(model, keys))
        if len(errors) > 1:
            what += f" (and {len(errors) - 1} more to put right)"
        return SessionError(what, where=self.place(*keys), remedy=remedy)


_NEEDED = {
    "float_type": "a number",
    "string_type": "text",
    "model_type": "a mapping of keys to values",
    "dict_type": "a mapping of keys to values",
    "list_type": "a list of numbers",
    "tuple_type": "a list of two: [m, rad], or two names",
}


def _explained(error: ErrorDetails, allowed: Sequence[str]) -> tuple[str, str]:
    """Say what is wrong and what to do about it."""
    kind, value, context = error["type"], error["input"], error.get("ctx", {})
    key = str(error["loc"][-1]) if error["loc"] else ""
    if kind == "extra_forbidden":
        return f"unknown key {key!r}", suggest(key, allowed, "keys")
    if kind == "missing":
        return f"the key {key!r} is missing", f"The keys are: {listed(allowed)}."
    if kind in _NEEDED:
        return f"{_shown(value)} stands where {_NEEDED[kind]} belongs", ""
    if kind == "literal_error":
        return f"{_shown(value)} is not {context['expected']}", ""
    if kind in ("too_short", "too_long"):
        return f"{_shown(value)} has {context['actual_length']} values, not 3", ""
    if kind == "greater_than":
        return f"{_shown(value)} is not greater than {context['gt']:g}", ""
    if kind == "greater_than_equal":
        return f"{_shown(value)} is less than {context['ge']:g}", ""
    if kind == "finite_number":
        return f"{_shown(value)} is not a finite number", ""
    return str(context.get("error", error["msg"])), ""


def _shown(value: Any) -> str:
    if value is None:
        return "nothing"
    return _SHORT.repr(value)


def _allowed(model: type[BaseModel], keys: Sequence[str | int]) -> list[str]:
    """The keys that the mapping holding ``keys[-1]`` may have."""
    for key in keys[:-1]:
        if key in model.model_fields:
            model = _model_in(model.model_fields[str(key)].annotation) or model
    return list(model.model_fields)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = (_model_in(argument) for argument in get_args(annotation))
    return next((model for model in inner if model), None)


def _child(node: yaml.Node, key: str | int) -> tuple[yaml.Node, yaml.Mark] | None:
    """What stands behind ``key``, and where the key is, or the item of a list."""
    if isinstance(node, yaml.MappingNode):
        pairs = ((value, name.start_mark) for name, value in reversed(node.value) if name.value == str(key))
        return next(pairs, None)
    if isinstance(node, yaml.SequenceNode) and isinstance(key, int):
        return node.value[key], node.value[key].start_mark
    return None


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with keys as written (an LED named 1 or on), each once, and 1e-4 a number."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: dict[str, int] = {}
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key is not text", key.start_mark)
            if key.value in seen:
                problem = f"the key {key.value!r} is already in line {seen[key.value]}"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen[key.value] = key.start_mark.line + 1
        self.flatten_mapping(node)
        return {key.value: self.construct_object(value, deep=deep) for key, value in node.value}


# YAML 1.1, which PyYAML reads, wants 1.0e-4; everyone writes 1e-4, as YAML 1.2 and JSON allow.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)
