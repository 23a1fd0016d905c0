"""What measurements show: frozen recordings, pixels outside their image, and what was never seen."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.io import making
from tests.io.broken import cells, put, swap
from tests.io.kinds import Contacts, Depths
from tests.io.making import write_cameras, write_points, write_valid
from tests.io.test_frame_tables import FRAMES, write_moving
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.checks.content import frozen_recording
from urdfcal.io.checks.plausibility import Inputs
from urdfcal.io.folder import read_session
from urdfcal.io.tables import read_joints, read_measurements
from urdfcal.io.writing import write_session

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.io.tables import MeasurementTable
    from urdfcal.session.measurements import Measurements

YAML, JOINTS, PIXELS, POINTS = "session.yaml", "joints.csv", "detections.csv", "points.csv"


@pytest.fixture
def both(folder: Path, tmp_path: Path) -> Path:
    """The valid session with points of a tracker beside the detections."""
    (folder / POINTS).write_bytes((write_points(tmp_path / "tracked") / POINTS).read_bytes())
    swap(YAML, "noise:", "points: points.csv\nnoise:")(folder)
    return folder


def own_table(folder: Path, kind: type[Measurements]) -> tuple[Inputs, MeasurementTable]:
    """Read a table of a kind that session.yaml does not know, and the valid session as what it belongs to."""
    session = read_session(folder)
    joints = read_joints(folder / JOINTS, session.chain, session.urdf.joints)
    known = {"pose": joints.poses, "led": session.led_names}
    table = read_measurements(folder / f"{kind.kind}.csv", kind, known, kind.usual)
    return Inputs(None, session, joints, tables={kind: table}), table


class TestFrozenRecordings:
    @staticmethod
    def repeat(moving: Path, frames: int) -> None:
        """Let so many frames of the left camera show what the one before shows."""
        lines = (moving / PIXELS).read_text().split()
        for k in range(1, 1 + 2 * frames, 2):
            for led in (0, 1):
                seen = lines[1 + 2 * (k - 1) + led].split(",")[-2:]
                lines[1 + 2 * k + led] = ",".join([*lines[1 + 2 * k + led].split(",")[:-2], *seen])
        (moving / PIXELS).write_text("\n".join(lines) + "\n")

    def test_videos_repeat_a_picture_now_and_then(self, moving: Path) -> None:
        self.repeat(moving, 1)  # of 40: 2.5 %
        assert not [text for text in read_session(moving).warnings if "joints have moved" in text]

    def test_exactly_five_percent_are_now_and_then(self, moving: Path) -> None:
        self.repeat(moving, 2)
        assert not [text for text in read_session(moving).warnings if "joints have moved" in text]
        self.repeat(moving, 3)
        assert [text for text in read_session(moving).warnings if f"3 of {2 * FRAMES} frames" in text]

    def test_one_in_a_hundred_rows_is_left_out(self, tmp_path: Path) -> None:
        """Pose 60 shows what pose 59 shows, of 4 detections each."""
        for poses in (100, 99):
            folder = write_valid(tmp_path / str(poses), poses)
            rows = (folder / PIXELS).read_text().split()
            rows[241:245] = [row.replace("59,", "60,", 1) for row in rows[237:241]]
            (folder / PIXELS).write_text("\n".join(rows) + "\n")
            if poses == 100:
                session = read_session(folder)
        found = r"detections.csv:242:1: pose '60' shows exactly what pose '59' shows \(line 238\), but the joints have"
        (warning,) = session.warnings
        assert re.search(found + " moved: the recording has frozen: 4 of 400 detections were left out$", warning)
        assert len(session.find(Detections)) == 396
        assert 60 not in session.find(Detections).pose
        assert 59 in session.find(Detections).pose
        with pytest.raises(SessionError, match=found):
            read_session(folder)

    def test_all_that_are_left_out_are_counted(self, tmp_path: Path) -> None:
        folder = write_valid(tmp_path / "long", 300)
        rows = (folder / PIXELS).read_text().split()
        for pose in (60, 80, 81):
            rows[1 + 4 * pose : 5 + 4 * pose] = [row.replace("59,", f"{pose},", 1) for row in rows[237:241]]
        (folder / PIXELS).write_text("\n".join(rows) + "\n")
        session = read_session(folder)
        assert "has frozen, and 2 more times: 12 of 1200 detections were left out" in session.warnings[0]
        assert len(session.find(Detections)) == 1188

    def test_many_are_named(self, moving: Path) -> None:
        self.repeat(moving, 4)
        (warning,) = [text for text in read_session(moving).warnings if "joints have moved" in text]
        assert f"4 of {2 * FRAMES} frames" in warning

    def test_in_a_session_of_poses_one_is_enough(self, folder: Path) -> None:
        lines = (folder / PIXELS).read_text().split()
        lines[13:17] = [line.replace("2,", "3,", 1) for line in lines[9:13]]
        (folder / PIXELS).write_text("\n".join(lines) + "\n")
        with pytest.raises(SessionError, match="pose '3' shows exactly what pose '2' shows"):
            read_session(folder)

    def test_the_same_pixel_may_be_another_led(self, folder: Path) -> None:
        cells(PIXELS, lambda i, row: row if i % 4 == int(row["pose"]) % 2 else None)(folder)
        for row in (4, 5):
            put(PIXELS, row, u="700.25", v="600.125")(folder)
        assert not [text for text in read_session(folder).warnings if "shows" in text]
        put(PIXELS, 6, u="700.25", v="600.125")(folder)  # by the LED of row 4
        with pytest.raises(SessionError, match="pose '6' shows exactly what pose '4' shows"):
            read_session(folder)

    def test_a_single_measured_point_does_not_repeat_by_chance(self, tracked: Path) -> None:
        """Not even where its coordinates are round; two whole pixels may."""
        cells(POINTS, lambda _, row: row if row["led"] == "red" else None)(tracked)
        for row in (4, 5):
            put(POINTS, row, x="0.5", y="0.0", z="0.5")(tracked)
        with pytest.raises(SessionError, match="pose '5' shows exactly what pose '4' shows"):
            read_session(tracked)

    def test_an_arm_that_moves_may_wait(self, moving: Path) -> None:
        rows = (moving / JOINTS).read_text().split()
        for k in range(101, 120):
            rows[k] = ",".join([rows[k].split(",")[0], *rows[100].split(",")[1:]])
        (moving / JOINTS).write_text("\n".join(rows) + "\n")
        assert not [text for text in read_session(moving).warnings if "exactly" in text]

    def test_what_measures_that_something_is_zero_may_repeat(self, folder: Path) -> None:
        """All contacts show the same: that they are."""
        (folder / "contacts.csv").write_text("pose,led,place\n0,red,a\n1,red,a\n2,red,a\n")
        inputs, table = own_table(folder, Contacts)
        assert frozen_recording(inputs, table) == (table, [])

    def test_the_same_number_at_another_place_is_another_measurement(self, folder: Path) -> None:
        def depths(place: str) -> str:
            return f"pose,led,place,depth\n0,red,a,0.125\n1,red,{place},0.125\n2,red,a,0.25\n"

        (folder / "depths.csv").write_text(depths("b"))
        inputs, table = own_table(folder, Depths)
        assert frozen_recording(inputs, table) == (table, [])
        (folder / "depths.csv").write_text(depths("a"))
        inputs, table = own_table(folder, Depths)
        with pytest.raises(SessionError, match="pose '1' shows exactly what pose '0' shows"):
            frozen_recording(inputs, table)

    def test_each_kind_is_judged_on_its_own(self, both: Path) -> None:
        """A frozen tracker is not excused by cameras that went on."""
        assert read_session(both).warnings == ()
        rows = (both / POINTS).read_text().split()
        rows[11:13] = [row.replace("4,", "5,", 1) for row in rows[9:11]]
        (both / POINTS).write_text("\n".join(rows))
        with pytest.raises(SessionError, match=r"points.csv:12:1: pose '5' shows exactly what pose '4' shows"):
            read_session(both)


class TestPixelsOutsideTheirImage:
    def test_one_is_left_out_however_few_there_are_and_whatever_the_rays_do(self, folder: Path) -> None:
        put(PIXELS, 6, u="1290")(folder)
        for placed in (True, False):
            write_cameras(folder / "cameras.yaml", placed=placed)
            session = read_session(folder)
            assert len(session.find(Detections)) == 31
            (warning,) = session.warnings
            assert re.search(r"outside the 1280 x 1024 image of camera 'right'(?!, as do): left out$", warning)

    def test_more_are_counted(self, folder: Path) -> None:
        write_cameras(folder / "cameras.yaml", placed=False)
        put(PIXELS, 6, u="1290")(folder)
        put(PIXELS, 10, u="1290")(folder)
        with pytest.raises(SessionError, match=r"as do 1 more of 32"):
            read_session(folder)

    def test_fewer_than_one_in_twenty_of_a_camera_are_left_out(self, tmp_path: Path) -> None:
        """Of 21 poses the right camera has 42 detections: 2 are 4.8 %; of 20 poses 2 of its 40 are 5 %."""
        for poses in (20, 21):
            folder = write_valid(tmp_path / str(poses), poses)
            put(PIXELS, 6, u="1290")(folder)
            put(PIXELS, 10, u="-3")(folder)
            if poses == 20:
                with pytest.raises(SessionError, match="outside the 1280 x 1024 image of camera 'right'"):
                    read_session(folder)
        session = read_session(folder)
        (warning,) = session.warnings
        assert re.search(
            r"detections.csv:8:\d+: \(1290, .*\) lies outside the 1280 x 1024 image of camera 'right', as do 1 more of "
            r"84 measurements: left out$",
            warning,
        )
        table = session.find(Detections)
        assert len(table) == 82
        assert table.uv.min() > 0.0
        assert table.uv[:, 0].max() < 1280.0

    def test_each_camera_has_few(self, tmp_path: Path) -> None:
        """What is few of all detections may be many of one camera's."""
        folder = write_valid(tmp_path / "session", 60)
        cells(PIXELS, lambda i, row: row if row["camera"] == "left" or i < 40 else None)(folder)
        put(PIXELS, 2, u="1290")(folder)
        put(PIXELS, 6, u="1290")(folder)
        with pytest.raises(SessionError, match="image of camera 'right'"):
            read_session(folder)

    def test_one_is_an_error_of_its_own_even_where_the_image_might_be_turned(self, tmp_path: Path) -> None:
        folder = write_valid(tmp_path / "session", 40)
        cells(PIXELS, lambda _, row: row if float(row["u"]) < 1020 else None)(folder)
        put(PIXELS, 0, v="1100")(folder)
        (warning,) = read_session(folder).warnings
        assert warning.endswith("image of camera 'left': left out")

    def test_what_is_left_out_stays_out_beside_what_is_excluded(self, tmp_path: Path) -> None:
        folder = write_valid(tmp_path / "session", 40)
        put(PIXELS, 6, u="1290")(folder)
        session = read_session(folder, exclude_poses=["7"])
        assert len(session.find(Detections)) == 155
        write_session(tmp_path / "written", session)
        again = read_session(tmp_path / "written")
        assert again.find(Detections).uv.tolist() == session.find(Detections).uv.tolist()
        assert again.excluded.poses == ("7",)
        assert again.warnings == ()

    def test_many_are_of_another_resolution(self, folder: Path) -> None:
        write_cameras(folder / "cameras.yaml", placed=False)
        cells(PIXELS, lambda _, row: {**row, "u": str(2.0 * float(row["u"])), "v": str(1.9 * float(row["v"]))})(folder)
        seen = np.array([row.split(",")[1:] for row in (folder / PIXELS).read_text().split()[1:]])
        own = seen[seen[:, 0] == "left"][:, 2:].astype(float).max(axis=0)
        with pytest.raises(SessionError, match=rf"camera 'left'.*resolution.*reach to \({own[0]:g}, {own[1]:g}\)"):
            read_session(folder)

    def test_exactly_five_percent_are_of_another_resolution(self, folder: Path) -> None:
        folder = write_valid(folder.parent / "of_twenty", 20)
        write_cameras(folder / "cameras.yaml", placed=False)
        put(PIXELS, 6, u="1290")(folder)
        put(PIXELS, 10, u="1290")(folder)
        with pytest.raises(SessionError, match="leave it out"):
            read_session(folder)

    def test_on_its_side_and_the_rays_miss(self, folder: Path) -> None:
        """The image's shape says that u and v are exchanged; the cameras' poses are wrong besides."""
        T = making.T_RIGHT_LEFT.copy()
        T[1, 3] += 0.01
        swap("cameras.yaml", str(making.T_RIGHT_LEFT.tolist()), str(T.tolist()))(folder)
        for _ in range(2):
            swap("cameras.yaml", "[1280, 1024]", "[700, 1100]")(folder)
        cells(PIXELS, lambda _, row: row if float(row["v"]) < 690 else None)(folder)
        with pytest.raises(SessionError, match=r"All would fit with u and v exchanged: are they\?"):
            read_session(folder)

    def test_the_camera_file_is_named_where_cameras_have_more_keys(self, folder: Path) -> None:
        write_cameras(folder / "cameras.yaml", placed=False)
        swap(YAML, "cameras: cameras.yaml", "cameras: {file: cameras.yaml, right: {link: tip}}")(folder)
        cells(PIXELS, lambda _, row: {**row, "u": str(2.0 * float(row["u"])), "v": str(1.9 * float(row["v"]))})(folder)
        with pytest.raises(SessionError, match=r"at the resolution of cameras\.yaml\?"):
            read_session(folder)

    def test_each_camera_has_its_own_image(self, folder: Path) -> None:
        text = (folder / "cameras.yaml").read_text()
        (folder / "cameras.yaml").write_text(text.replace("[1280, 1024]", "[1400, 1100]", 1))
        put(PIXELS, 4, u="1300.5")(folder)  # the left camera's
        read_session(folder)
        put(PIXELS, 6, u="1300.5")(folder)
        (warning,) = read_session(folder).warnings
        assert "lies outside the 1280 x 1024 image of camera 'right': left out" in warning


def test_whole_pixels_may_repeat_by_chance_and_fractions_may_not(folder: Path) -> None:
    def one_sighting(pixel: str) -> None:
        write_valid(folder)
        cells(PIXELS, lambda i, row: row if int(row["pose"]) > 1 or i % 4 == 0 else None)(folder)
        put(PIXELS, 0, u=pixel, v="600")(folder)
        put(PIXELS, 1, u=pixel, v="600")(folder)

    one_sighting("700.5")
    assert read_session(folder).warnings == ()
    one_sighting("700.25")
    with pytest.raises(SessionError, match="pose '1' shows exactly what pose '0' shows"):
        read_session(folder)


def test_a_frozen_tracker_is_found(tracked: Path) -> None:
    rows = (tracked / POINTS).read_text().split()
    rows[11:13] = [row.replace("4,", "5,", 1) for row in rows[9:11]]
    (tracked / POINTS).write_text("\n".join(rows))
    with pytest.raises(SessionError, match=r"points.csv:12:1: pose '5' shows exactly what pose '4' shows \(line 10\)"):
        read_session(tracked)


def test_the_same_pose_may_show_the_same_twice(folder: Path) -> None:
    rows = (folder / JOINTS).read_text().split()
    rows[4] = rows[3].replace("2,", "3,", 1)
    (folder / JOINTS).write_text("\n".join(rows))
    rows = (folder / PIXELS).read_text().split()
    rows[13:17] = [row.replace("2,", "3,", 1) for row in rows[9:13]]
    (folder / PIXELS).write_text("\n".join(rows))
    assert len(read_session(folder).warnings) == 1


def test_poses_leds_and_cameras_never_seen_are_named(folder: Path) -> None:
    cells(PIXELS, lambda _, row: row if row["led"] == "red" and row["camera"] == "left" else None)(folder)
    cells(PIXELS, lambda _, row: row if row["pose"] not in "36" else None)(folder)
    poses, leds, cameras = read_session(folder).warnings
    assert poses.endswith("joints.csv: 2 of 8 poses have no measurement: 3, 6")
    assert leds.endswith("session.yaml:5:1, key 'leds': never seen: blue")
    assert cameras.endswith("session.yaml:8:1, key 'cameras': these cameras see nothing: right")


def test_a_pose_in_eight_may_go_unseen(folder: Path) -> None:
    cells(PIXELS, lambda _, row: row if row["pose"] != "6" else None)(folder)
    assert read_session(folder).warnings == ()


def test_what_another_instrument_measured_is_not_unseen(both: Path) -> None:
    """Poses and LEDs count once in any table; a camera that sees nothing is of no use whatever a tracker saw."""
    cells(PIXELS, lambda _, row: row if row["led"] == "red" and row["camera"] == "left" else None)(both)
    cells(PIXELS, lambda _, row: row if row["pose"] not in "36" else None)(both)
    (cameras,) = read_session(both).warnings
    assert cameras.endswith("these cameras see nothing: right")
    cells(POINTS, lambda _, row: row if row["led"] == "red" and row["pose"] not in "36" else None)(both)
    poses, leds, _ = read_session(both).warnings
    assert poses.endswith("joints.csv: 2 of 8 poses have no measurement: 3, 6")
    assert leds.endswith("never seen: blue")


class TestImagesOfTheWrongShape:
    """The image is turned on its side: width and height, or u and v, are exchanged. Which, only the rays can tell."""

    @pytest.fixture
    def turned(self, folder: Path) -> Path:
        for name in ("cameras.yaml",):
            swap(name, "[1280, 1024]", "[700, 1100]")(folder)
            swap(name, "[1280, 1024]", "[700, 1100]")(folder)
        cells(PIXELS, lambda _, row: row if float(row["v"]) < 690 else None)(folder)
        return folder

    def test_the_rays_meet_so_the_resolution_is_wrong(self, turned: Path) -> None:
        with pytest.raises(SessionError, match=r"the rays meet, so the pixels are right.*\[1100, 700\]"):
            read_session(turned)

    def test_they_meet_once_u_and_v_are_exchanged(self, turned: Path) -> None:
        swap("cameras.yaml", "[700, 1100]", "[1100, 700]")(turned)
        swap("cameras.yaml", "[700, 1100]", "[1100, 700]")(turned)
        cells(PIXELS, lambda _, row: {**row, "u": row["v"], "v": row["u"]})(turned)
        with pytest.raises(SessionError, match="u and v look exchanged"):
            read_session(turned)

    def test_without_the_cameras_places_it_cannot_be_told_and_is_said(self, turned: Path) -> None:
        text = (turned / "cameras.yaml").read_text()
        (turned / "cameras.yaml").write_text(text[: text.index("  T_cn_cnm1")])
        warning, *_ = read_session(turned).warnings
        assert "lies outside the 700 x 1100 image of camera 'left'" in warning
        assert "either they are exchanged, or in cameras.yaml width and height are" in warning


def test_an_arm_on_its_way_may_be_out_of_view_half_of_the_time(moving: Path) -> None:
    def unseen(kept: int) -> list[str]:
        write_moving(moving)
        cells(PIXELS, lambda i, row: row if i < 2 * kept else None)(moving)
        return [text for text in read_session(moving).warnings if "no measurement" in text]

    assert unseen(FRAMES) == []
    assert "21 of 40" in unseen(FRAMES - 1)[0]
