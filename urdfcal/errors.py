"""The errors of urdfcal: one root, each saying what is wrong, where, and what to do."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from collections.abc import Iterator


class UrdfcalError(Exception):
    """Root of every error urdfcal raises on purpose.

    Attributes:
        what: the finding, with the offending value.
        where: file, line, column, joint or frame; empty when the call itself is the place.
        remedy: what the user can do about it; empty when the finding says it.
    """

    exit_code: ClassVar[int] = 2

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.remedy = remedy

    def __str__(self) -> str:
        place = f"{self.where}: " if self.where else ""
        remedy = f" {self.remedy}" if self.remedy else ""
        return f"{place}{self.what.rstrip('.')}.{remedy}"


class RobotError(UrdfcalError):
    """The robot description cannot be read or is not a chain that can be calibrated."""


class CameraError(UrdfcalError):
    """A camera file, a camera model or a ray geometry that makes no sense."""


class SessionError(UrdfcalError):
    """A session folder, or a table in it, that cannot be trusted."""


class OutputError(UrdfcalError):
    """A result that cannot be written or read where the user wants it."""


class CalibrationError(UrdfcalError):
    """The data were readable, but the calibration fails its own checks."""

    exit_code: ClassVar[int] = 1


@contextmanager
def placed(where: object) -> Iterator[None]:
    """Say of what is refused meanwhile where that was, unless it says so itself: a file, a folder."""
    try:
        yield
    except UrdfcalError as error:
        error.where = error.where or str(where)
        raise
