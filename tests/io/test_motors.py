from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from urdfcal.errors import SessionError
from urdfcal.io.motors import read_motors

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize("high", [1024, 1000])
def test_a_motor_that_was_not_moved_through_its_range_is_named(high: int, tmp_path: Path) -> None:
    motors = {"elbow": {"range_min": 1000, "range_max": 3000}, "wrist": {"range_min": 1024, "range_max": high}}
    (tmp_path / "motors.json").write_text(json.dumps(motors))
    with pytest.raises(SessionError, match=rf"motors.json: motor 'wrist': range_min 1024 is not below .*{high}"):
        read_motors(tmp_path / "motors.json")
