"""Tables of measurements of any kind: sorted, read-only, each row unique, and names of what only the table names."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.io.kinds import Contacts
from urdfcal.arrays import ReadOnly
from urdfcal.errors import SessionError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.estimation.measurements.points import CorrelatedPoints

if TYPE_CHECKING:
    from urdfcal.session.measurements import Measurements


PLACES = ("hole", "pin")


def contacts(**changes: Any) -> Contacts:
    values = {
        "pose": np.array([4, 0, 2, 0]),
        "led": np.array([0, 1, 0, 1]),
        "place": np.array([1, 1, 0, 0]),
        "sigma": np.array([0.4, 0.1, 0.3, 0.2]),
        "names": {"place": PLACES},
    }
    return Contacts(**{**values, **changes})


def triangulated() -> CorrelatedPoints:
    """Four points whose numbers all say which of the rows they belong to."""
    pose, led = np.array([2, 0, 1, 0]), np.array([0, 1, 0, 0])
    tag = 10.0 * pose + led + 1.0
    return CorrelatedPoints(pose, led, np.outer(tag, np.ones(3)), 1e-3 * tag, covariance=tag[:, None, None] * np.eye(3))


def test_rows_are_sorted_with_all_they_say() -> None:
    table = contacts()
    assert table.pose.tolist() == [0, 0, 2, 4]
    assert table.led.tolist() == [1, 1, 0, 0]
    assert table.place.tolist() == [0, 1, 0, 1]
    assert table.sigma.tolist() == [0.2, 0.1, 0.3, 0.4]


def test_further_columns_are_sorted_along() -> None:
    points = triangulated()
    tag = 10.0 * points.pose + points.led + 1.0
    assert tag.tolist() == [1.0, 2.0, 11.0, 21.0]
    np.testing.assert_array_equal(points.xyz, np.outer(tag, np.ones(3)))
    np.testing.assert_array_equal(points.sigma, 1e-3 * tag)
    np.testing.assert_array_equal(points.covariance, tag[:, None, None] * np.eye(3))
    assert points.covariances is points.covariance
    with pytest.raises(ValueError, match="read-only"):
        points.covariance[0] = 0.0


def test_further_columns_come_along_with_chosen_rows() -> None:
    points = triangulated()
    for some in (points.rows(np.array([3, 1])), points.rows(np.array([False, True, False, True]))):
        assert type(some) is CorrelatedPoints
        assert some.pose.tolist() == [0, 2]
        assert some.covariance[:, 0, 0].tolist() == [2.0, 21.0]
    some = points.at(np.array([1, 2]))
    assert some.pose.tolist() == [0, 1]
    assert some.covariance[:, 0, 0].tolist() == [11.0, 21.0]


@given(st.permutations(range(6)))
def test_the_order_of_rows_does_not_matter(order: list[int]) -> None:
    rows = np.array([(p, c, led) for p in (0, 3) for c in (0, 1, 2) for led in (1,)])[order]
    uv = rows @ [[100.0, 1.0], [10.0, 2.0], [1.0, 3.0]]
    table = Detections(*rows.T, uv, 0.1 + uv[:, 0])
    expected = table.pose * 100.0 + table.camera * 10.0 + table.led
    assert np.all(np.diff(expected) > 0)
    np.testing.assert_array_equal(table.uv[:, 0], expected)
    np.testing.assert_array_equal(table.sigma, 0.1 + expected)


class TestSigma:
    @pytest.mark.parametrize("sigma", [0.25, np.float32(0.25), 1, np.array(0.25), np.array([0.25])])
    def test_one_serves_all_rows(self, sigma: Any) -> None:
        assert contacts(sigma=sigma).sigma.tolist() == [float(np.ravel(sigma)[0])] * 4

    def test_it_is_an_array_of_its_own(self) -> None:
        """A broadcast one would be a view of the caller's."""
        given = np.array([0.25])
        table = contacts(sigma=given)
        given[0] = 1.0
        assert table.sigma.tolist() == [0.25] * 4
        assert table.sigma.flags.c_contiguous
        assert not table.sigma.flags.writeable

    @pytest.mark.parametrize("shape", [(3,), (5,), (4, 1), (2, 4), (0,)])
    def test_others_are_refused(self, shape: tuple[int, ...]) -> None:
        with pytest.raises(SessionError, match=r"contacts.*sigma has shape .*, not \(4,\)"):
            contacts(sigma=np.ones(shape))

    @pytest.mark.parametrize(
        ("sigma", "message"),
        [
            (0.0, "sigma is 0; it must be positive"),
            (np.array([0.1, 0.1, -0.5, 0.1]), "sigma is -0.5; it must be positive"),
            (np.nan, "sigma has values that are not finite"),
            (np.inf, "sigma has values that are not finite"),
            ("wide", "sigma is not made of numbers"),
        ],
    )
    def test_it_must_be_positive(self, sigma: Any, message: str) -> None:
        with pytest.raises(SessionError, match=message):
            contacts(sigma=sigma)


class TestNames:
    def test_indices_stand_for_them_in_every_selection(self) -> None:
        table = contacts()
        assert table.names == {"place": PLACES}
        assert table.rows(np.array([2])).names == {"place": PLACES}
        assert table.at(np.array([2, 4])).names == {"place": PLACES}
        assert replace(table, sigma=1.0).names == {"place": PLACES}

    def test_they_are_no_column(self) -> None:
        assert set(contacts().arrays) == {"pose", "led", "place", "sigma"}
        assert list(contacts().index) == ["pose", "led", "place"]

    def test_a_kind_without_any_has_none(self) -> None:
        assert triangulated().names == {}

    def test_they_are_a_copy_that_cannot_be_written_to(self) -> None:
        given = {"place": PLACES}
        table = contacts(names=given)
        given["place"] = ("other",)
        assert table.names["place"] == PLACES
        with pytest.raises(TypeError):
            table.names["place"] = ("other",)  # type: ignore[index]

    def test_they_are_given_by_name(self) -> None:
        """Behind the columns of a kind they would be taken for one of these."""
        with pytest.raises(TypeError):
            Contacts(np.arange(2), np.arange(2), np.arange(2), 0.1, {"place": PLACES})  # type: ignore[call-arg]


def test_what_measures_that_something_is_zero_has_zeros() -> None:
    assert contacts().values.tolist() == [[0.0, 0.0, 0.0]] * 4
    assert len(contacts()) == 4


@pytest.mark.parametrize("table", [contacts(), triangulated()], ids=["contacts", "triangulated"])
def test_it_travels_to_other_processes(table: Measurements) -> None:
    other = pickle.loads(pickle.dumps(table))  # noqa: S301 - our own
    assert type(other) is type(table)
    assert type(other.names) is ReadOnly
    assert other.names == table.names
    assert other.arrays.keys() == table.arrays.keys()
    for name, column in table.arrays.items():
        np.testing.assert_array_equal(other.arrays[name], column)
        assert other.arrays[name].dtype == column.dtype
        assert not other.arrays[name].flags.writeable


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_a_read_only_mapping_can_be_pickled(protocol: int) -> None:
    given = ReadOnly({"a": ("x", "y"), "b": ()})
    other = pickle.loads(pickle.dumps(given, protocol))  # noqa: S301 - our own
    assert type(other) is ReadOnly
    assert other == given == {"a": ("x", "y"), "b": ()}
    assert repr(other) == "{'a': ('x', 'y'), 'b': ()}"
    with pytest.raises(TypeError):
        other["a"] = ()


class TestAt:
    def test_poses_are_numbered_anew(self) -> None:
        some = contacts().at(np.array([0, 1, 4]))
        assert some.pose.tolist() == [0, 0, 2]
        assert some.place.tolist() == [0, 1, 1]

    def test_without_rows_there_is_no_table(self) -> None:
        assert contacts().at(np.array([1, 3])) is None


class TestCheck:
    def test_indices_of_what_exists_pass(self) -> None:
        contacts().check({"pose": 5, "led": 2, "camera": 0})

    @pytest.mark.parametrize(("key", "count"), [("pose", 4), ("led", 1)])
    def test_others_are_refused(self, key: str, count: int) -> None:
        with pytest.raises(SessionError, match=f"{key} {count} does not exist: there are {count}"):
            contacts().check({"pose": 5, "led": 2, key: count})

    def test_what_only_the_table_names_is_not_counted(self) -> None:
        contacts().check({"pose": 5, "led": 2})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"place": np.array([1, 1, 0, 1])}, "contacts.*two measurements of pose 0, led 1, place 1"),
        ({"place": np.array([1, 1, 0])}, "contacts.*place is not an array of 4 indices"),
        ({"place": np.array([1, 1, 0, -1])}, "contacts.*place is not an array of 4 indices"),
        ({"place": np.array([1.0, 1.0, 0.0, 0.0])}, "contacts.*place is not an array of 4 indices"),
        ({"place": np.zeros((4, 1), int)}, "contacts.*place is not an array of 4 indices"),
        ({"pose": np.zeros((4, 1), int)}, "contacts.*there is no measurement"),
        ({"pose": np.zeros(0, int)}, "contacts.*there is no measurement"),
    ],
)
def test_tables_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SessionError, match=message):
        contacts(**changes)


def test_the_same_at_another_place_is_another_measurement() -> None:
    """No key alone makes two rows the same: all of them do."""
    assert len(contacts(pose=np.zeros(4, int), led=np.array([0, 0, 1, 1]), place=np.array([0, 1, 0, 1]))) == 4


def test_what_was_measured_must_be_of_the_kinds_size() -> None:
    with pytest.raises(SessionError, match=r"points.*xyz has shape \(2, 2\), not \(2, 3\)"):
        Points(np.arange(2), np.zeros(2, int), np.ones((2, 2)), 0.1)  # type: ignore[arg-type]
