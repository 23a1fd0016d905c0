"""What keys of session.yaml and rig.yaml are made of: names, numbers, places."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from urdfcal.names import flaw
from urdfcal.rotations import rpy_to_matrix

if TYPE_CHECKING:
    from urdfcal.arrays import Floats


def _named(name: str) -> str:
    if problem := flaw(name):
        raise ValueError(problem)
    return name


Name = Annotated[str, AfterValidator(_named)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class Keys(BaseModel):
    """Known keys alone, of the right types."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class OpenKeys(Keys):
    """A mapping in another program's file, which may say more than is read."""

    model_config = ConfigDict(extra="ignore")


class PlaceKeys(Keys):
    """Where something is on its link (m, rad), and how surely."""

    position: Vector | None = None
    rpy: Vector | None = None

    @model_validator(mode="after")
    def _whole(self) -> PlaceKeys:
        if (self.position is None) != (self.rpy is None):
            raise ValueError("position and rpy are given together, or neither")
        if getattr(self, "sigma", None) is not None and self.position is None:
            raise ValueError("sigma is given without a position")
        return self

    @property
    def T(self) -> Floats | None:
        """The same as a transform (4, 4)."""
        if self.position is None or self.rpy is None:
            return None
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rpy_to_matrix(np.array(self.rpy)), self.position
        return T


class ScaleKeys(Keys):
    """How well the unit of the cameras' baselines, or of a tracker's points, is known: a share of any length."""

    sigma: NotNegative
