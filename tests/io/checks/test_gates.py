"""Both sides of the gates of a session's checks: what is refused or named, and an honest session near it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.io import making
from tests.io.broken import cells, put, renamed_cameras, swap
from tests.io.making import write_cameras, write_valid
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.folder import read_positions, read_session

if TYPE_CHECKING:
    from pathlib import Path

YAML, JOINTS, PIXELS, POINTS = "session.yaml", "joints.csv", "detections.csv", "points.csv"


class TestCamerasOnLinks:
    @staticmethod
    def mounted(folder: Path, right: str) -> Path:
        write_cameras(folder / "cameras.yaml", placed=False)
        swap(YAML, "cameras: cameras.yaml", f"cameras: {{file: cameras.yaml, right: {{link: tip{right}}}}}")(folder)
        return folder

    @pytest.mark.parametrize(("position", "rpy"), [("[0.2, 0, 0.1]", "[0, 0, 6.2]"), ("[3, 0, 0]", "[1.5, -3.1, 0]")])
    def test_a_long_bracket_and_a_whole_turn_are_honest(self, folder: Path, position: str, rpy: str) -> None:
        session = read_session(self.mounted(folder, f", position: {position}, rpy: {rpy}"))
        assert [mount.camera for mount in session.mounts] == ["right"]

    def test_without_a_position_there_is_nothing_to_check(self, folder: Path) -> None:
        assert read_session(self.mounted(folder, "")).mounts[0].T_link_camera is None

    def test_millimetres_are_refused(self, folder: Path) -> None:
        with pytest.raises(SessionError, match=r"'cameras.right.position'.*200.*millimetres"):
            read_session(self.mounted(folder, ", position: [200, 0, 10], rpy: [0, 0, 0]"))

    @pytest.mark.parametrize("rpy", ["[0, 90, 0]", "[0, 0, -6.3]"])
    def test_degrees_are_refused(self, folder: Path, rpy: str) -> None:
        with pytest.raises(SessionError, match=r"'cameras.right.rpy'.*degrees"):
            read_session(self.mounted(folder, f", position: [0.2, 0, 0.1], rpy: {rpy}"))


class TestLimits:
    def test_how_many_readings_are_outside_is_said_if_there_are_more(self, folder: Path) -> None:
        put(JOINTS, 2, waist="3.0")(folder)
        with pytest.raises(SessionError, match=r"waist = 3 rad is outside .*\[-2.9, 2.9\](?! \(and)"):
            read_session(folder)
        put(JOINTS, 4, waist="-3.0")(folder)
        with pytest.raises(SessionError, match=r"joints.csv:4:.*waist = 3 rad .*and 1 more reading"):
            read_session(folder)

    def test_of_a_sliding_joint_in_metres(self, folder: Path) -> None:
        put(JOINTS, 2, slide="0.31")(folder)
        with pytest.raises(SessionError, match=r"slide = 0.31 m is outside the joint's limits \[0, 0.3\]"):
            read_session(folder)

    def test_below_the_lower_one(self, folder: Path) -> None:
        put(JOINTS, 2, slide="-0.0005")(folder)
        assert read_session(folder).readings[2, 2] == -0.0005
        put(JOINTS, 2, slide="-0.0055")(folder)
        with pytest.raises(SessionError, match=r"slide = -0\.0055 m is outside"):
            read_session(folder)

    def test_few_readings_in_degrees_are_errors_of_typing(self, folder: Path) -> None:
        """Only where most poses have them the unit is wrong."""

        def in_degrees(share: int) -> None:
            write_valid(folder)
            cells(JOINTS, lambda i, row: {**row, "shoulder": "80" if 0 < i <= share else "0.2"})(folder)

        in_degrees(3)
        with pytest.raises(SessionError, match="outside the joint's limits"):
            read_session(folder)
        in_degrees(5)
        with pytest.raises(SessionError, match=r"joints.csv:3:.*look like degrees: shoulder is 80"):
            read_session(folder)

    def test_what_no_unit_explains_is_outside_limits(self, folder: Path) -> None:
        cells(JOINTS, lambda i, row: {**row, "shoulder": str(150.0 + i)})(folder)
        with pytest.raises(SessionError, match="outside the joint's limits"):
            read_session(folder)


def test_a_joint_that_hardly_turns_is_named_in_radians(folder: Path) -> None:
    cells(JOINTS, lambda i, row: {**row, "waist": str(0.1 + 2e-5 * i), "slide": str(0.1 + 2e-3 * i)})(folder)
    (warning,) = read_session(folder).warnings
    assert "'waist'" in warning
    assert "0.00014 rad" in warning


def test_a_second_pair_of_equal_readings_is_counted(folder: Path) -> None:
    rows = (folder / JOINTS).read_text().split()
    rows[7], rows[8] = rows[4].replace("3,", "6,", 1), rows[3].replace("2,", "7,", 1)
    (folder / JOINTS).write_text("\n".join(rows))
    (warning,) = read_positions(folder).warnings
    assert "pose '6' has exactly the joint readings of pose '3', as have 1 more" in warning


class TestNoise:
    def test_a_sigma_in_the_table_is_judged_by_its_own_camera(self, folder: Path) -> None:
        """5 % of the longer side: 64 px of one camera, 200 px of the other."""
        text = (folder / "cameras.yaml").read_text()
        (folder / "cameras.yaml").write_text(
            text[::-1].replace("[1280, 1024]"[::-1], "[4000, 4000]"[::-1], 1)[::-1]  # the last, the right camera's
        )

        def sigma(camera: str) -> None:
            wide = {camera: "100"}
            cells(PIXELS, lambda _, row: {**row, "sigma": wide.get(row["camera"], "0.1")})(folder)

        header = (folder / PIXELS).read_text().split("\n", 1)
        assert header[0].endswith("u,v")
        sigma("right")
        lines = (folder / PIXELS).read_text().split("\n")
        (folder / PIXELS).write_text("\n".join([lines[0] + ",sigma", *lines[1:]]))
        assert read_session(folder).find(Detections).sigma.max() == 100.0
        sigma("left")
        with pytest.raises(SessionError, match=r"detections.csv:2:\d+.*100 px is of the size of the image"):
            read_session(folder)

    def test_reading_noise_of_five_degrees_is_the_limit(self, folder: Path) -> None:
        swap(YAML, "pixel: 0.1", "pixel: 0.1, joint: 0.09")(folder)
        assert read_session(folder).noise.joint == 0.09

    def test_of_points_as_large_as_the_arm(self, tracked: Path) -> None:
        swap(YAML, "point: 1e-4", "point: 0.5")(tracked)
        assert read_session(tracked).noise.point == 0.5
        swap(YAML, "point: 0.5", "point: 5")(tracked)
        with pytest.raises(SessionError, match=r"'noise.point'.*5 m is of the size of the arm"):
            read_session(tracked)


class TestPoints:
    def test_in_millimetres(self, tracked: Path) -> None:
        cells(POINTS, lambda _, row: {**row, **{axis: str(1e3 * float(row[axis])) for axis in "xyz"}})(tracked)
        with pytest.raises(SessionError, match=r"points.csv.*spread over .* looks like millimetres"):
            read_session(tracked)

    def test_a_single_one_far_off_is_named(self, tracked: Path) -> None:
        put(POINTS, 5, x="15")(tracked)
        assert len(read_session(tracked).find(Points)) == 16
        put(POINTS, 5, x="500")(tracked)
        with pytest.raises(SessionError, match=r"points.csv:7:\d+.* m from the others"):
            read_session(tracked)


class TestRays:
    def test_how_few_of_them_meet_is_said(self, folder: Path) -> None:
        """Cameras that look away from each other: their rays meet behind them."""
        back = np.diag([-1.0, 1.0, -1.0, 1.0])
        back[0, 3] = 0.5
        text = (folder / "cameras.yaml").read_text()
        start = text.index("  T_cn_cnm1")
        (folder / "cameras.yaml").write_text(text[:start] + f"  T_cn_cnm1: {back.tolist()}\n")
        warning = next(text for text in read_session(folder).warnings if "camera file" in text)
        assert "% of the rays meet" in warning

    def test_two_points_are_too_few_to_say_anything(self, folder: Path) -> None:
        """Three are needed: with two of them exchanged cameras pass."""
        other = {"left": "right", "right": "left"}

        def exchanged(points: int) -> None:
            write_valid(folder)
            cells(
                PIXELS,
                lambda _, row: (
                    {**row, "camera": other[row["camera"]]}
                    if row["led"] == "red" and int(row["pose"]) < points
                    else row
                    if row["camera"] == "left" and row["led"] == "blue"
                    else None
                ),
            )(folder)

        exchanged(2)
        assert not [text for text in read_session(folder).warnings if "rays" in text]
        exchanged(3)
        with pytest.raises(SessionError, match="'left' and 'right' look exchanged"):
            read_session(folder)


class TestRaysOfParallelCameras:
    """Side by side, as a stereo camera has them: under exchanged names their rays run apart."""

    @pytest.fixture
    def parallel(self, folder: Path) -> Path:
        shift = np.eye(4)
        shift[0, 3] = -0.15
        text = (folder / "cameras.yaml").read_text()
        start = text.index("  T_cn_cnm1")
        (folder / "cameras.yaml").write_text(text[:start] + f"  T_cn_cnm1: {shift.tolist()}\n")
        chain, readings = read_positions(folder).chain, making.measured()[0]
        points = making.T_LEFT_BASE @ making.tip_poses(chain, chain.joint_values(readings))

        def seen(_: int, row: dict[str, str]) -> dict[str, str]:
            led = making.LEDS[making.NAMES.index(row["led"])]
            x, y, z, _ = (shift if row["camera"] == "right" else np.eye(4)) @ points[int(row["pose"])] @ [*led, 1.0]
            return {**row, "u": f"{640.0 + 1400.0 * x / z:.3f}", "v": f"{512.0 + 1400.0 * y / z:.3f}"}

        cells(PIXELS, seen)(folder)
        assert read_session(folder).warnings == ()
        return folder

    def test_exchanged_names_are_found_where_no_ray_meets(self, parallel: Path) -> None:
        cells(PIXELS, renamed_cameras)(parallel)
        with pytest.raises(SessionError, match="'left' and 'right' look exchanged: as they are, 0% of the rays meet"):
            read_session(parallel)

    def test_and_where_they_are_exchanged_in_most_poses(self, parallel: Path) -> None:
        """The rays of the few others meet well: that is no reason to believe the names."""
        cells(PIXELS, lambda i, row: renamed_cameras(i, row) if int(row["pose"]) < 5 else row)(parallel)
        with pytest.raises(SessionError, match="'left' and 'right' look exchanged: as they are, 38% of the rays meet"):
            read_session(parallel)

    def test_what_an_exchange_explains_in_fewer_than_half_of_the_poses_it_does_not_explain(
        self, parallel: Path
    ) -> None:
        def mixed(i: int, row: dict[str, str]) -> dict[str, str]:
            pose = int(row["pose"])
            parted = {**row, "u": "640", "v": str(300 + 11 * i)}  # rays that are parallel
            return renamed_cameras(i, row) if pose < 3 else parted if pose < 5 else row

        cells(PIXELS, mixed)(parallel)
        (warning,) = read_session(parallel).warnings
        assert "38% of the rays meet: are the cameras where the camera file says?" in warning
