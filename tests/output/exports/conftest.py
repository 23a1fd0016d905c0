from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import pytest

import urdfcal
from tests.io.making import write_valid
from urdfcal.io.folder import read_session
from urdfcal.output.exports.tables import corrected_urdf
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.robot.urdf.urdf import Urdf

RIGS = ("ur5", "panda", "so101", "stanford", "elbow3r", "mimic")


class Result(NamedTuple):
    """A result as exports find it: loaded, with the corrected URDF beside it."""

    calibration: urdfcal.Calibration
    urdf: Urdf
    folder: Path


@pytest.fixture(scope="session")
def results(fitted: Callable, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Result]:
    """The result of a rig, or of a small arm in which a joint follows another; made once each."""

    @cache
    def make(rig: str) -> Result:
        folder = tmp_path_factory.mktemp(rig)
        if rig == "mimic":
            # It is built as drawn: nothing gets better, and noise alone makes the offsets.
            read = read_session(write_valid(folder / "session", 30))
            found = calibrate(replace(read, estimate=Estimate(geometry="dh")), force=True)
        else:
            found = fitted(rig)
        found.save(folder / "calibration.json")
        (folder / found.urdf_name).write_bytes(found.calibrated_urdf())
        loaded = urdfcal.Calibration.load(folder)
        return Result(loaded, corrected_urdf(loaded, folder), folder)

    return make


@pytest.fixture(params=RIGS)
def result(request: pytest.FixtureRequest, results: Callable[[str], Result]) -> Result:
    return results(request.param)
