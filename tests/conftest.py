from __future__ import annotations

import gc
import os

# Workers, and the commands that they start, share the cores: threads of linear algebra would wait for each other.
# It counts if it is there before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Commands that tests start would each compile all of urdfcal, which takes 0.8 s: the first keeps what it compiled.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.states import true_state_of
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.estimation.state import State
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.session.knowledge import Estimate
    from urdfcal.simulation.truth import Simulated

# Workers come to hold more than a gigabyte of fixtures: to look through it for garbage as often as Python does by
# itself takes 4 to 8 % of the time.
gc.set_threshold(100_000, 50, 100)


@pytest.hookimpl(optionalhook=True)  # without xdist there is nothing to hand out
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Give each worker a stretch of the tests, as neighbours share fixtures, and who is done some of the others'."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


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


@pytest.fixture(scope="session")
def fitted(simulated: Callable[..., Simulated]) -> Callable[..., FittedCalibration]:
    """The calibration of a simulated session, made once for equal arguments."""

    @cache
    def make(rig: str, poses: int = 30, seed: int = 0, estimate: Estimate | None = None) -> FittedCalibration:
        session = simulated(rig, poses=poses, seed=seed).session
        return calibrate(session if estimate is None else replace(session, estimate=estimate))

    return make


@pytest.fixture(scope="session")
def measured(shared: Path) -> Callable[[str], FittedCalibration]:
    """The calibration of a measured session by the name of its folder, made once."""
    return cache(lambda name: calibrate(read_session(shared / name)))


@pytest.fixture(scope="session")
def true_state() -> Callable[..., State]:
    """The true state of a simulated session; values of joint models by name."""
    return true_state_of


@pytest.fixture
def no_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """What would mend a session that does not fit is not looked for, which takes seconds: for tests of other things."""
    monkeypatch.setattr("urdfcal.estimation.evidence.suspect", lambda *_: None)
