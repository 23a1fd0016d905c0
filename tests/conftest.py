from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.leds import LEDS
from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.measurements.pixels import camera_state
from urdfcal.estimation.state import State
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats
    from urdfcal.session.model import Session
    from urdfcal.simulation.simulate import Simulated


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of measured data; tests that need it skip where it is absent."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the measured data are not here: {folder}")
    return folder


@cache
def _simulated(rig: str, poses: int, seed: int, pixel: float, outliers: float) -> Simulated:
    return simulate(read_rig(find_rig(rig)), poses=poses, seed=seed, pixel=pixel, outliers=outliers)


@pytest.fixture(scope="session")
def simulated() -> Callable[..., Simulated]:
    """A simulated session with its truth, made once for equal arguments."""

    def make(rig: str, poses: int = 30, seed: int = 0, pixel: float = 0.1, outliers: float = 0.0) -> Simulated:
        return _simulated(rig, poses, seed, pixel, outliers)

    return make


def state_of(
    session: Session, offsets: Floats, T_world_base: Floats, leds: Floats, T_cam_frame: Floats, **more: Floats
) -> State:
    """A state of a session with given values; ``time_offset`` and ``zero_offset`` may be given as well."""
    models = (model.of(session) for model in JOINT_MODELS)
    joints = {model.key: more.get(model.name, model.nominal) for model in models if model is not None}
    values = {ARM: offsets, BASE: T_world_base, LEDS: leds}
    return State({**values, **joints, **camera_state(session, T_cam_frame)})


@pytest.fixture(scope="session")
def true_state() -> Callable[[Simulated], State]:
    def state(simulated: Simulated, **more: Floats) -> State:
        truth = simulated.truth
        return state_of(simulated.session, truth.offsets, truth.T_world_base, truth.leds, truth.T_cam_frame, **more)

    return state
