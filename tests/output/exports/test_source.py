from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import pytest

from urdfcal.errors import OutputError
from urdfcal.output.exports.tables import corrected_urdf

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def test_a_urdf_that_is_not_the_calibrations_is_refused(results: Callable, tmp_path: Path) -> None:
    result = results("elbow3r")
    with pytest.raises(OutputError, match="not beside"):
        corrected_urdf(result.calibration, tmp_path)
    path = tmp_path / result.urdf.path.name
    shutil.copy(result.urdf.path, path)
    assert corrected_urdf(result.calibration, tmp_path).data == result.urdf.data
    path.write_bytes(path.read_bytes().replace(b'name="joint_3"', b'name="third"'))
    with pytest.raises(OutputError, match="'joint_3' is not placed as"):
        corrected_urdf(result.calibration, tmp_path)
