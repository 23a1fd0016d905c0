from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.errors import OutputError
from urdfcal.pipeline import calibrate
from urdfcal.result import fitted
from urdfcal.robot.dh import DHTable
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.arrays import Floats
    from urdfcal.result.fitted import FittedCalibration
    from urdfcal.robot.mechanism import Mechanism


@pytest.fixture(scope="module")
def calibration(fitted: Callable) -> FittedCalibration:
    return fitted("elbow3r", estimate=Estimate("dh", "fixed", "fixed"))


def lifted(T: Floats, metres: float) -> Floats:
    moved = np.array(T)
    moved[..., 2, 3] += metres
    return moved


def one_reader_errs(name: str, metres: float, patch: pytest.MonkeyPatch) -> None:
    """Make one of the three that are compared with the estimate see the tip elsewhere."""
    if name == "Pinocchio":
        read = fitted.read_mechanism

        def wrong(*given: object) -> Mechanism:
            chain = read(*given)
            first = lifted(chain.placements[:1], metres)
            return chain.with_placements(np.concatenate([first, chain.placements[1:]]))

        patch.setattr(fitted, "read_mechanism", wrong)
    elif name == "yourdfpy":
        links = fitted._yourdfpy_links
        patch.setattr(fitted, "_yourdfpy_links", lambda *given: lifted(links(*given), metres))
    else:
        forward = DHTable.forward
        patch.setattr(DHTable, "forward", lambda *given: lifted(forward(*given), metres))


@pytest.mark.parametrize("name", ["Pinocchio", "yourdfpy", "the DH rows"])
def test_each_reader_alone_refuses_a_urdf(
    name: str, calibration: FittedCalibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_reader_errs(name, 1e-8, monkeypatch)
    with pytest.raises(OutputError, match=rf"moves differently when read by {name}: 1\.0e-08 m"):
        calibration.calibrated_urdf()


@pytest.mark.parametrize("name", ["Pinocchio", "yourdfpy", "the DH rows"])
def test_rounding_is_no_difference(name: str, calibration: FittedCalibration, monkeypatch: pytest.MonkeyPatch) -> None:
    one_reader_errs(name, 1e-11, monkeypatch)
    assert calibration.calibrated_urdf() == calibration.apply_to_urdf(calibration.session.urdf)


def test_whole_placements_are_not_compared_with_dh_rows(simulated: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    full = calibrate(replace(simulated("elbow3r").session, estimate=Estimate("full", "fixed", "fixed")))
    one_reader_errs("the DH rows", 1.0, monkeypatch)
    assert full.calibrated_urdf()
