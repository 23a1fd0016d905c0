"""Real pictures, where the package opencv-doc is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.cameras.board import real
from urdfcal.cameras.board.board import Board
from urdfcal.cameras.board.calibration import BoardCalibration, calibrate_cameras
from urdfcal.cameras.board.views import read_views

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.skipif(not real.FOLDER.is_dir(), reason="the Debian package opencv-doc is not installed")


def calibrated(folder: Path, how: str = "") -> BoardCalibration:
    real.write(folder, how)
    board = Board("chessboard", 9, 6, 0.025)
    return calibrate_cameras(read_views(folder, board), board)


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> BoardCalibration:
    return calibrated(tmp_path_factory.mktemp("real") / "clean")


def test_all_of_opencvs_pictures_are_used_and_fit_better_than_by_opencv(clean: BoardCalibration) -> None:
    errors = real.opencv()
    for quality in clean.qualities:
        assert len(quality.views) == 13
        assert quality.outliers <= 5
        residual = np.sqrt(2.0) * np.sqrt(np.mean(quality.rms**2))
        assert residual < 1.1 * errors[quality.name]
        assert residual < 1.02 * errors["pair"]


@pytest.mark.no_cover
@pytest.mark.parametrize("how", ["small", "soft+dim+jpeg"])
def test_spoilt_copies_are_at_most_twice_as_uncertain(clean: BoardCalibration, how: str, tmp_path: Path) -> None:
    found = calibrated(tmp_path / "spoilt", how)
    assert len(found.rig.cameras) == 2
    size = 0.5 if "small" in how else 1.0
    for ours, theirs, sigma, cleaner in zip(
        found.rig.cameras, clean.rig.cameras, found.rig.sigmas, clean.rig.sigmas, strict=True
    ):
        assert (sigma.parameters[:4] / size < 2.0 * cleaner.parameters[:4]).all()
        apart = ours.intrinsics / size - theirs.intrinsics
        apart[2:] += 0.5 * (1.0 / size - 1.0)  # pixel (0, 0) is the centre of the first one
        assert (np.abs(apart) < 4.0 * np.hypot(sigma.parameters[:4] / size, cleaner.parameters[:4])).all()
