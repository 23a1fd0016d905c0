from __future__ import annotations

import numpy as np

from urdfcal.cli.workspace import along


def test_a_path_is_what_lies_between_its_rows_too() -> None:
    rows = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    path = along(rows)
    assert len(path) == 501
    for row in rows:
        assert np.abs(path - row).max(axis=1).min() < 1e-12
    np.testing.assert_allclose(path[125], [0.5, 0.0])
    np.testing.assert_allclose(path[375], [1.0, 1.0])


def test_a_path_of_many_rows_or_of_one_is_as_it_is() -> None:
    for count in (1, 600):
        rows = np.random.default_rng(0).normal(size=(count, 3))
        np.testing.assert_array_equal(along(rows), rows)
