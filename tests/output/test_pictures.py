"""What a recording shows of videos."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from urdfcal.images.files import write_video
from urdfcal.output.pictures import find_pictures
from urdfcal.session.trajectory import Trajectory
from urdfcal.simulation.motion import MotionSettings, set_in_motion

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.session.model import Session


@pytest.fixture(scope="module")
def filmed(simulated: Callable, tmp_path_factory: pytest.TempPathFactory) -> Session:
    """A session whose left camera has a video, each of its frames of a brightness of its own."""
    session = set_in_motion(simulated("elbow3r", poses=3), MotionSettings()).session
    folder = tmp_path_factory.mktemp("filmed")
    (folder / "images").mkdir()
    count = len(session.motion.frames[0])
    frames = (np.full((48, 64), 60 + 190 * k // count, dtype=np.uint8) for k in range(count))
    write_video(folder / "images" / f"{session.rig.names[0]}.mp4", frames, (64, 48), 30.0)
    return replace(session, folder=folder)


def test_frames_of_a_video_are_shown_evenly_each_at_its_own_pose(filmed: Session) -> None:
    motion = filmed.motion
    assert isinstance(motion, Trajectory)
    pictures, none = find_pictures(filmed)
    assert not none
    assert 50 < len(pictures) <= 100
    poses = np.array(sorted(pictures))
    assert np.all(motion.camera[poses] == 0)
    rows = motion.row[poses]
    assert np.ptp(np.diff(rows)) <= 2
    assert rows[-1] - rows[0] > 0.95 * (len(motion.frames[0]) - 2)
    for pose, row in zip(poses.tolist()[::10], rows.tolist()[::10], strict=True):
        image = cv2.imdecode(np.frombuffer(pictures[pose], np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image.mean() == pytest.approx(60 + 190 * row / len(motion.frames[0]), abs=4)


def test_a_film_of_something_else_is_left_out(filmed: Session, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    frames = (np.zeros((48, 64), dtype=np.uint8) for _ in range(3))
    write_video(tmp_path / "images" / f"{filmed.rig.names[0]}.mp4", frames, (64, 48), 30.0)
    assert [len(found) for found in find_pictures(replace(filmed, folder=tmp_path))] == [0, 0]
