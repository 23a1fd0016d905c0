"""Numbers handed in by a caller: kept as they are, or refused with their name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from urdfcal.arrays import finite_array, finite_number
from urdfcal.errors import SessionError


def test_an_array_is_a_copy_that_cannot_be_written_to() -> None:
    given = np.arange(6, dtype=np.float32).reshape(2, 3)
    kept = finite_array(given, (2, 3), "q", "session")
    given[:] = 0.0
    assert kept.dtype == np.float64
    assert kept.tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    with pytest.raises(ValueError, match="read-only"):
        kept[0, 0] = 1.0


def test_lists_and_arrays_without_rows_are_arrays() -> None:
    assert finite_array([1, 2], (2,), "q", "session").tolist() == [1.0, 2.0]
    assert finite_array(np.zeros((0, 3)), (0, 3), "q", "session").shape == (0, 3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([[1.0, 2.0], [3.0]], "q is not made of numbers"),
        (["a", "b"], "q is not made of numbers"),
        ([None, object()], "q is not made of numbers"),
        ([1.0, 2.0, 3.0], r"q has shape \(3,\), not \(2,\)"),
        ([[1.0, 2.0]], r"q has shape \(1, 2\), not \(2,\)"),
        (1.0, r"q has shape \(\), not \(2,\)"),
        ([1.0, np.nan], "q has values that are not finite"),
        ([-np.inf, 1.0], "q has values that are not finite"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_with_their_name(values: Any, message: str) -> None:
    with pytest.raises(SessionError, match=message) as caught:
        finite_array(values, (2,), "q", "the session's joints")
    assert str(caught.value).startswith("the session's joints")


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2.0), np.int64(2)])
@pytest.mark.parametrize("zero", [False, True])
def test_a_number_becomes_a_plain_one(value: Any, zero: bool) -> None:
    number = finite_number(value, "sigma", "noise", zero=zero)
    assert type(number) is float
    assert number == 2.0


@pytest.mark.parametrize("value", [True, np.True_, "2", None, [2.0], np.ones(1), 1j, np.nan, np.inf, -np.inf, -1e-300])
@pytest.mark.parametrize(("zero", "needed"), [(False, "positive"), (True, "non-negative")])
def test_what_is_no_such_number_is_refused(value: Any, zero: bool, needed: str) -> None:
    with pytest.raises(SessionError, match=f"not a {needed} number") as caught:
        finite_number(value, "sigma", "noise", zero=zero)
    assert f"sigma is {value!r}" in str(caught.value)
    assert str(caught.value).startswith("noise")


def test_zero_is_a_number_where_it_makes_sense() -> None:
    assert finite_number(0, "sigma", "noise", zero=True) == 0.0
    with pytest.raises(SessionError, match=r"sigma is 0\.0, not a positive number"):
        finite_number(0.0, "sigma", "noise", zero=False)
