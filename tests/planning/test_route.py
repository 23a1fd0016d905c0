from __future__ import annotations

from itertools import permutations

import numpy as np

from urdfcal.planning.route import NOWHERE, Moves, distances, length, route

ANYWHERE = Moves(None, None)


def test_the_way_is_nearly_the_shortest() -> None:
    q = np.random.default_rng(3).uniform(-2.0, 2.0, (7, 3))
    way = route(q, np.zeros(3), ANYWHERE, q)
    assert sorted(way.pose) == list(range(7))
    np.testing.assert_array_equal(way.q, q[way.pose])
    points = np.vstack([np.zeros(3), q])
    shortest = min(length([0, *order], distances(points)) for order in permutations(range(1, 8)))
    assert length([0, *(way.pose + 1)], distances(points)) <= 1.1 * shortest


def test_without_a_start_the_way_begins_at_a_pose() -> None:
    q = np.array([[0.0], [2.0], [1.0]])
    way = route(q, None, ANYWHERE, q)
    np.testing.assert_array_equal(way.pose, [0, 2, 1])
    assert not NOWHERE.unreached


def wall(q: np.ndarray) -> bool:
    """Free but for a wall at x = 0 that ends at y = 1."""
    return bool(abs(q[0]) > 0.1 or q[1] > 1.0)


def test_the_way_leads_around_what_is_between() -> None:
    q, vias = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 0.0], [0.0, 5.0], [0.0, 2.5]])
    way = route(q, None, Moves(wall, wall), vias)
    np.testing.assert_array_equal(way.pose, [0, -1, 1])
    np.testing.assert_array_equal(way.q[1], [0.0, 2.5])
    for a, b in zip(way.q[:-1], way.q[1:], strict=True):
        assert all(wall(a + step * (b - a)) for step in np.linspace(0.0, 1.0, 200))


def test_what_no_way_leads_to_is_said() -> None:
    q = np.array([[-1.0, 0.0], [1.0, 0.0], [-2.0, 0.0]])
    way = route(q, None, Moves(wall, wall), np.array([[1.0, -3.0]]))
    assert way.unreached == (1,)
    np.testing.assert_array_equal(way.pose, [0, 2])


def test_from_where_it_is_not_clear_the_arm_moves_away() -> None:
    def clear(q: np.ndarray) -> bool:
        return bool(q[0] > 0.5)

    assert Moves(clear, wall).free(np.array([0.2, 0.0]), np.array([1.0, 0.0]))
    assert not Moves(clear, wall).free(np.array([-0.2, 0.0]), np.array([1.0, 0.0]))
