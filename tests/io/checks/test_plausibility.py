from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.io import making
from tests.io.broken import append, cells, put, renamed_cameras, swap
from tests.io.making import write_cameras, write_points, write_valid
from urdfcal.errors import SessionError
from urdfcal.io.folder import read_positions, read_session

if TYPE_CHECKING:
    from pathlib import Path

YAML, JOINTS, PIXELS, POINTS = "session.yaml", "joints.csv", "detections.csv", "points.csv"


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("poses", [3, 40])
def test_honest_sessions_raise_no_alarm(tmp_path: Path, seed: int, poses: int) -> None:
    assert read_session(write_valid(tmp_path / "cameras", poses, seed)).warnings == ()
    assert read_session(write_points(tmp_path / "tracker", poses, seed)).warnings == ()


def test_a_wrist_without_limits_may_be_wound_up(folder: Path) -> None:
    put(JOINTS, 2, roll="-12.5")(folder)
    assert read_session(folder).readings[2, 3] == -12.5


def test_a_joint_may_overrun_its_limit_by_less_than_a_controller_allows(folder: Path) -> None:
    put(JOINTS, 2, shoulder="1.8005")(folder)
    assert read_session(folder).readings[2, 1] == 1.8005
    assert read_session(folder).warnings == ()


class TestLimits:
    """The shoulder reads up to 1.8 rad; its zero may be off by 5 mrad unless the session says otherwise."""

    def test_beyond_by_less_than_the_zero_may_be_off_is_a_warning(self, folder: Path) -> None:
        put(JOINTS, 2, shoulder="-1.8049")(folder)
        (warning,) = read_session(folder).warnings
        assert warning.endswith("joints.csv:4:10: pose '2': shoulder is 0.0049 rad beyond its limits")
        put(JOINTS, 2, shoulder="1.8051")(folder)
        with pytest.raises(SessionError, match=r"shoulder = 1.8051 rad is outside.*calibrate --ignore-limits"):
            read_session(folder)

    def test_each_joint_is_told_once_by_its_worst_reading(self, folder: Path) -> None:
        put(JOINTS, 2, shoulder="1.802")(folder)
        put(JOINTS, 3, shoulder="1.804", slide="0.3021")(folder)
        put(JOINTS, 5, shoulder="1.803")(folder)
        shoulder, slide = read_session(folder).warnings
        assert shoulder.endswith("pose '3': shoulder is 0.004 rad beyond its limits, and 2 more readings by less")
        assert slide.endswith("pose '3': slide is 0.0021 m beyond its limits")

    @pytest.mark.parametrize(
        ("tolerances", "joint", "just", "more"),
        [
            ("{zero: 0.03}", "shoulder", "1.829", "1.831"),
            ("{shoulder: {theta: 0.02}}", "shoulder", "1.819", "1.821"),
            ("{shoulder: {theta: 0}}", "shoulder", "1.8009", "1.8011"),
            ("{slide: {d: 0.01}, zero: 0}", "slide", "-0.009", "-0.011"),
        ],
    )
    def test_the_tolerance_is_the_joints_own(
        self, folder: Path, tolerances: str, joint: str, just: str, more: str
    ) -> None:
        append(YAML, f"tolerances: {tolerances}\n")(folder)
        put(JOINTS, 2, **{joint: just})(folder)
        read_session(folder)
        put(JOINTS, 2, **{joint: more})(folder)
        with pytest.raises(SessionError, match="is outside the joint's limits"):
            read_session(folder)

    def test_where_most_are_beyond_signs_and_columns_are_suspected(self, folder: Path) -> None:
        """The slide goes from 0 to 0.3 m: turned round, or read where the roll turns, most is beyond."""
        text = (folder / JOINTS).read_text()
        cells(JOINTS, lambda _, row: {**row, "slide": str(-float(row["slide"]))})(folder)
        with pytest.raises(
            SessionError, match=r"otherwise: is the sign of slide turned\? Correct it; .*--ignore-limits"
        ):
            read_session(folder)
        (folder / JOINTS).write_text(text)
        cells(JOINTS, lambda _, row: {**row, "slide": row["roll"], "roll": row["slide"]})(folder)
        with pytest.raises(SessionError, match=r"are the columns of slide and roll exchanged\?"):
            read_session(folder)
        (folder / JOINTS).write_text(text)
        put(JOINTS, 2, slide="-0.2")(folder)
        with pytest.raises(SessionError, match=r"Correct the reading, or the limits"):
            read_session(folder)

    def test_they_may_be_ignored(self, folder: Path) -> None:
        put(JOINTS, 2, shoulder="2.2")(folder)
        (warning,) = read_session(folder, ignore_limits=True).warnings
        assert "pose '2': shoulder is 0.4 rad beyond its limits" in warning
        assert read_positions(folder).warnings == (warning,)

    def test_a_wrong_unit_is_none_the_less(self, folder: Path) -> None:
        cells(JOINTS, lambda _, row: {**row, "roll": str(np.degrees(float(row["roll"])))})(folder)
        with pytest.raises(SessionError, match="the readings of roll look like degrees"):
            read_session(folder, ignore_limits=True)

    def test_of_a_moving_arm_the_line_is_named(self, moving: Path) -> None:
        put(JOINTS, 20, shoulder="1.804")(moving)
        (warning,) = [text for text in read_session(moving).warnings if "beyond" in text]
        assert re.search(r"joints.csv:22:\d+: shoulder is 0.004 rad beyond its limits$", warning)


def test_one_reading_in_degrees_is_a_reading_outside_limits(folder: Path) -> None:
    put(JOINTS, 2, waist="57.3")(folder)
    with pytest.raises(SessionError, match=r"joints.csv:4:3: waist = 57.3 rad is outside the joint's limits"):
        read_session(folder)


def test_one_joint_in_degrees_is_named_alone(folder: Path) -> None:
    cells(JOINTS, lambda _, row: {**row, "roll": str(np.degrees(float(row["roll"])))})(folder)
    with pytest.raises(SessionError, match="the readings of roll look like degrees"):
        read_session(folder)


def test_an_led_on_a_long_tool_is_no_wrong_unit(folder: Path) -> None:
    swap(YAML, "[0.05, 0.02, 0.03]", "[0.3, 0.2, 0.9]")(folder)
    assert read_session(folder).warnings == ()


def test_an_led_in_the_world_may_be_as_far_as_a_camera(folder: Path) -> None:
    reach, given = read_session(folder).chain.reach, "position: [0.05, 0.02, 0.03]"
    near, far = (f"link: world, position: [0, 0, {share * reach}]" for share in (10.0, 30.0))
    swap(YAML, given, near)(folder)
    assert read_session(folder).leds[0].link == "world"
    swap(YAML, near, far)(folder)
    with pytest.raises(SessionError, match="m from the world's origin looks like millimetres"):
        read_session(folder)


def test_a_tracker_may_stand_far_away(tracked: Path) -> None:
    cells(POINTS, lambda _, row: {**row, "x": str(float(row["x"]) + 25.0)})(tracked)
    assert read_session(tracked).warnings == ()


def test_a_joint_that_never_moves_is_named(folder: Path) -> None:
    cells(JOINTS, lambda i, row: {**row, "waist": "0.5", "slide": str(0.1 + 1e-5 * i)})(folder)
    waist, slide = read_session(folder).warnings
    assert waist.endswith("joint 'waist' never moves: its parameters are unidentifiable")
    assert slide.endswith("joint 'slide' moves by only 7e-05 m: its parameters are unidentifiable")


def test_the_same_readings_under_two_labels_are_named(folder: Path) -> None:
    rows = (folder / JOINTS).read_text().split()
    rows[7] = rows[4].replace("3,", "6,", 1)
    (folder / JOINTS).write_text("\n".join(rows))
    (warning,) = read_session(folder).warnings
    assert warning.endswith("joints.csv:8:1: pose '6' has exactly the joint readings of pose '3'")


def test_cameras_beside_points_are_not_used(tracked: Path) -> None:
    write_cameras(tracked / "cameras.yaml")
    swap(YAML, "joints:", "cameras: cameras.yaml\njoints:")(tracked)
    (warning,) = read_session(tracked).warnings
    assert "there are no detections: the cameras are not used" in warning


def test_cameras_a_little_off_are_a_warning(folder: Path) -> None:
    T = making.T_RIGHT_LEFT.copy()
    T[1, 3] += 0.01
    swap("cameras.yaml", str(making.T_RIGHT_LEFT.tolist()), str(T.tolist()))(folder)
    (warning,) = read_session(folder).warnings
    assert "the rays miss each other by" in warning
    assert "are the cameras where the camera file says?" in warning


def test_a_camera_that_moved_is_where_the_camera_file_says_before(folder: Path) -> None:
    header, *rows = (folder / PIXELS).read_text().split()
    names = header.split(",")
    moved = [dict(zip(names, row.split(","), strict=True)) for row in rows]
    for row in moved:
        if row["camera"] == "right" and int(row["pose"]) >= 3:
            row["v"] = str(float(row["v"]) + 10.0)
    (folder / PIXELS).write_text("\n".join([header, *(",".join(row.values()) for row in moved)]) + "\n")
    (warning,) = read_session(folder).warnings
    assert "the rays miss each other by" in warning
    swap(YAML, "joints:", "moved: {right: [3]}\njoints:")(folder)
    assert read_session(folder).warnings == ()


def test_much_noise_declared_does_not_hide_an_exchange(folder: Path) -> None:
    swap(YAML, "pixel: 0.1", "pixel: 10")(folder)
    assert read_session(folder).warnings == ()
    cells(PIXELS, renamed_cameras)(folder)
    with pytest.raises(SessionError, match="cameras 'left' and 'right' look exchanged"):
        read_session(folder)


def test_exchanged_names_are_found_among_three_cameras(folder: Path) -> None:
    """The third camera is right; only the pair that is exchanged is named."""
    third = making.looking([2.3, 0.0, 1.6], making.TARGET)
    step = third @ np.linalg.inv(making.T_RIGHT_BASE)
    block = (folder / "cameras.yaml").read_text().split("right:\n")[1].split("  T_cn_cnm1")[0]
    with (folder / "cameras.yaml").open("a") as file:
        file.write(f"top:\n{block}  T_cn_cnm1: {step.tolist()}\n")
    chain, q = read_session(folder).chain, read_session(folder).q
    with (folder / PIXELS).open("a") as file:
        for i, T in enumerate(making.tip_poses(chain, q)):
            point = third @ T @ [*making.LEDS[0], 1.0]
            u, v = 1400.0 * point[:2] / point[2] + [640.0, 512.0]
            file.write(f"{i},top,red,{u:.3f},{v:.3f}\n")
    assert read_session(folder).warnings == ()
    other = {"left": "left", "right": "top", "top": "right"}
    cells(PIXELS, lambda _, row: {**row, "camera": other[row["camera"]]})(folder)
    with pytest.raises(SessionError, match="cameras 'right' and 'top' look exchanged"):
        read_session(folder)
