from __future__ import annotations

import csv
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.io.kinds import Contacts, Depths
from tests.io.making import URDF, write_valid
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.csv_table import Table
from urdfcal.io.folder import read_session
from urdfcal.io.tables import read_joints, read_measurements
from urdfcal.io.writing import write_measurements
from urdfcal.robot.chain import Chain
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.io.tables import MeasurementTable

ARM = Urdf.parse(URDF.encode())
CHAIN = Chain.from_urdf(ARM, "tip", "base")
HEAD = "pose,waist,shoulder,slide,roll"
ROWS = "a,1,0.2,0.1,4\nb,2,0.3,0.1,5\nc,1.5,-0.2,0,6\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "table.csv"


def test_columns_come_in_any_order(path: Path) -> None:
    path.write_text(f"{HEAD}\n{ROWS}")
    expected = read_joints(path, CHAIN, ARM.joints)
    path.write_text("roll,slide,pose,shoulder,waist\n4,0.1,a,0.2,1\n5,0.1,b,0.3,2\n6,0,c,-0.2,1.5\n")
    found = read_joints(path, CHAIN, ARM.joints)
    assert found.poses == expected.poses == ("a", "b", "c")
    assert np.array_equal(found.readings, expected.readings)
    assert expected.readings[2].tolist() == [1.5, -0.2, 0.0, 6.0]


@pytest.mark.parametrize(
    "text",
    [
        f"\ufeff{HEAD}\n{ROWS}",
        f"{HEAD}\n{ROWS}".replace("\n", "\r\n"),
        f"{HEAD}\n{ROWS}".replace("\n", "\r"),
        f"{HEAD}\n{ROWS}\n  \n\n",
        f"{HEAD}\n{ROWS}".rstrip(),
        f"{HEAD}\n{ROWS}".replace(",", ", "),
        f"{HEAD}\n{ROWS}".replace(",", " , "),
        f"{HEAD}\n{ROWS}".replace("a,", '"a",').replace("pose", '"pose"'),
    ],
    ids=["byte order mark", "CRLF", "CR", "blank lines", "no last line end", "spaces", "spaces around", "quotes"],
)
def test_the_ways_of_other_programs_are_understood(path: Path, text: str) -> None:
    path.write_bytes(text.encode())
    table = read_joints(path, CHAIN, ARM.joints)
    assert table.poses == ("a", "b", "c")
    assert table.readings[:, 0].tolist() == [1.0, 2.0, 1.5]


def test_columns_off_the_chain_are_ignored_aloud(path: Path) -> None:
    path.write_text(f"{HEAD},grip,elbow\n" + ROWS.replace("\n", ",open,1\n"))
    table = read_joints(path, CHAIN, ARM.joints)
    assert table.readings.shape == (3, 4)
    grip, elbow = table.warnings
    assert "'grip' is ignored: the joint is not between 'base' and 'tip'" in grip
    assert "'elbow' is ignored: the joint follows 'shoulder'" in elbow


def test_time_is_kept_where_it_is_given(path: Path) -> None:
    path.write_text(f"{HEAD}\n{ROWS}")
    assert read_joints(path, CHAIN, ARM.joints).time is None
    path.write_text(f"{HEAD},time\n" + ROWS.replace("\n", ",1.5\n"))
    time = read_joints(path, CHAIN, ARM.joints).time
    assert time is not None
    assert time.tolist() == [1.5, 1.5, 1.5]


def test_sightings_are_sorted_and_know_their_rows(path: Path) -> None:
    path.write_text("pose,camera,led,u,v\nb,l,x,1,2\na,r,x,3,4\na,l,y,5,6\na,l,x,7,8\n")
    table = read_measurements(path, Detections, {"pose": "ab", "camera": "lr", "led": "xy"}, 0.2)
    assert table.rows.tolist() == [3, 2, 1, 0]
    assert table.measurements.values[:, 0].tolist() == [7, 5, 3, 1]
    assert table.measurements.sigma.tolist() == [0.2] * 4
    assert table.place(0, "v") == f"{path}:5:9"


def test_sigmas_of_the_table_win(path: Path) -> None:
    path.write_text("pose,led,x,y,z,sigma\na,x,1,2,3,0.5\na,y,1,2,3,0.25\n")
    assert read_measurements(path, Points, {"pose": "a", "led": "xy"}, 0.1).measurements.sigma.tolist() == [0.5, 0.25]


def test_leds_that_are_not_declared_are_taken_as_they_come(path: Path) -> None:
    path.write_text("pose,led,x,y,z\nb,second,1,2,3\na,first,4,5,6\na,second,7,8,9\n")
    table = read_measurements(path, Points, {"pose": "ab"}, 0.1)
    assert table.names["led"] == ("second", "first")
    assert table.measurements.index["led"].tolist() == [0, 1, 0]
    assert table.measurements.index["pose"].tolist() == [0, 0, 1]


class TestOpenVocabularies:
    """Names that only a table knows, such as of the places that an LED touches."""

    KNOWN: ClassVar = {"pose": ("a", "b", "c"), "led": ("x", "y")}

    def read(self, path: Path, rows: str) -> MeasurementTable:
        path.write_text(f"pose,led,place\n{rows}")
        return read_measurements(path, Contacts, self.KNOWN, 0.1)

    def test_they_are_the_tables_own(self, path: Path) -> None:
        table = self.read(path, "b,x,pin\na,y, hole\na,x,pin\n")
        measured = table.measurements
        assert type(measured) is Contacts
        assert measured.names == {"place": ("pin", "hole")}
        assert [measured.names["place"][k] for k in measured.place] == ["pin", "hole", "pin"]
        assert measured.pose.tolist() == [0, 0, 1]
        assert measured.led.tolist() == [0, 1, 0]
        assert measured.sigma.tolist() == [0.1] * 3
        assert measured.values.tolist() == [[0.0] * 3] * 3

    def test_what_is_named_elsewhere_is_not_repeated(self, path: Path) -> None:
        path.write_text("pose,led,x,y,z\nb,second,1,2,3\na,first,4,5,6\n")
        assert read_measurements(path, Points, {"pose": "ab"}, 0.1).measurements.names == {}

    def test_they_are_names_that_can_be_written(self, path: Path) -> None:
        with pytest.raises(SessionError, match=r"table.csv:3:5: place: the cell is empty"):
            self.read(path, "b,x,pin\na,y,\n")

    def test_the_same_twice_is_refused(self, path: Path) -> None:
        with pytest.raises(SessionError, match=r"csv:4:1: pose 'a', led 'x', place 'pin' is already in line 2"):
            self.read(path, "a,x,pin\na,x,hole\na,x,pin\n")

    def test_what_is_known_is_still_known(self, path: Path) -> None:
        with pytest.raises(SessionError, match=r"csv:2:3: there is no led 'z'. The LEDs are: x, y\."):
            self.read(path, "a,z,pin\n")

    def test_they_are_written_by_name(self, path: Path, tmp_path: Path) -> None:
        """Read back in the order of the table, they may be numbered otherwise: what they name is the same."""
        session = read_session(write_valid(tmp_path / "session"))
        known = {"pose": session.poses, "led": session.led_names}
        poses, places = np.array([0, 1, 1, 5]), ("never", "pin, left", "hole")
        rows = np.array([2, 1, 2, 1]), np.array([0.1, 0.2, 0.3, 0.4])[:, None]
        written = Depths(poses, np.zeros(4, int), *rows, 1e-4, names={"place": places})
        write_measurements(path, session, written)
        read = read_measurements(path, Depths, known, 1e-4).measurements
        assert path.read_text().startswith("pose,led,place,depth\n0,red,hole,0.1\n")
        assert read.names == {"place": ("hole", "pin, left")}
        expected = {(0, "hole", 0.1), (1, "pin, left", 0.2), (1, "hole", 0.3), (5, "pin, left", 0.4)}
        for table in (written, read):
            named = [table.names["place"][k] for k in table.place]
            assert set(zip(table.pose.tolist(), named, table.depth[:, 0].tolist(), strict=True)) == expected

    def test_what_has_no_numbers_is_written_without(self, path: Path, tmp_path: Path) -> None:
        session = read_session(write_valid(tmp_path / "session"))
        zeros = np.zeros(1, int)
        write_measurements(path, session, Contacts(zeros, zeros, zeros, Contacts.usual, names={"place": ("pin",)}))
        assert path.read_text() == "pose,led,place\n0,red,pin\n"
        write_measurements(path, session, Contacts(zeros, zeros, zeros, 0.5, names={"place": ("pin",)}))
        assert path.read_text() == "pose,led,place,sigma\n0,red,pin,0.5\n"


@given(
    numbers=st.lists(
        st.tuples(*[st.floats(allow_nan=False, allow_infinity=False, width=64)] * 2), min_size=1, max_size=20
    )
)
def test_every_number_is_read_exactly(
    numbers: list[tuple[float, float]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "exact.csv"
    path.write_text("a,b\n" + "".join(f"{a!r},{b!r}\n" for a, b in numbers))
    assert np.array_equal(Table.read(path, ["a", "b"]).numbers(["a", "b"]), np.array(numbers))


names = st.text(st.characters(categories=("L", "N", "P", "S")), min_size=1, max_size=8)


@given(data=st.data(), rows=st.integers(1, 5), columns=st.integers(1, 4))
def test_a_place_is_where_the_cell_is(
    data: st.DataObject, rows: int, columns: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    header = [f"c{i}" for i in range(columns)]
    cells = [[data.draw(names) for _ in header] for _ in range(rows)]
    path = tmp_path_factory.getbasetemp() / "places.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *cells])
    table = Table.read(path, header)
    lines = path.read_text(encoding="utf-8").split("\n")
    for row in range(rows):
        for i, column in enumerate(header):
            assert table.columns[column][row] == cells[row][i]
            line, position = map(int, table.place(row, column).rsplit(":", 2)[1:])
            rest = lines[line - 1][position - 1 :]
            assert next(csv.reader([rest]))[0] == cells[row][i]


def test_a_table_named_as_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="cannot be read: Is a directory"):
        Table.read(tmp_path, ["a"])
