from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from urdfcal.rotations import (
    matrix_to_quaternion,
    matrix_to_rotation_vector,
    matrix_to_rpy,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
    rpy_to_matrix,
    skew,
    turn_z_to,
)

ROUNDING = 5e-15
angles = st.floats(-7.0, 7.0)


def round_trip_error(R):
    return np.abs(rpy_to_matrix(matrix_to_rpy(R)) - R).max()


@given(angles, angles, angles)
def test_the_matrix_is_pinocchios(roll, pitch, yaw):
    assert np.allclose(rpy_to_matrix([roll, pitch, yaw]), pin.rpy.rpyToMatrix(roll, pitch, yaw), rtol=0, atol=ROUNDING)


@given(angles, angles, angles)
def test_the_angles_give_back_the_matrix(roll, pitch, yaw):
    R = rpy_to_matrix([roll, pitch, yaw])
    assert round_trip_error(R) < ROUNDING
    assert -np.pi / 2 <= matrix_to_rpy(R)[1] <= np.pi / 2


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_away_from_gimbal_lock_the_matrix_gives_back_the_angles(roll, pitch, yaw):
    assert np.allclose(matrix_to_rpy(rpy_to_matrix([roll, pitch, yaw])), [roll, pitch, yaw], rtol=0, atol=1e-13)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("distance", [*(10.0**-k for k in range(1, 17)), 0.0])
@pytest.mark.parametrize("unit", [1.0, np.pi / 180])
def test_near_gimbal_lock_not_a_digit_is_lost(sign, distance, unit):
    rng = np.random.default_rng(3)
    for roll, yaw in rng.uniform(-np.pi, np.pi, (50, 2)):
        R = rpy_to_matrix([roll, sign * (np.pi / 2 - distance * unit), yaw])
        assert round_trip_error(R) < ROUNDING


def test_noise_in_the_matrix_at_gimbal_lock_stays_noise():
    rng = np.random.default_rng(4)
    for roll, yaw, *other in rng.uniform(-np.pi, np.pi, (500, 5)):
        A = rpy_to_matrix(other)
        R = A @ (A.T @ rpy_to_matrix([roll, np.pi / 2, yaw]))
        assert round_trip_error(R) < ROUNDING


def test_at_gimbal_lock_the_yaw_is_zero():
    rng = np.random.default_rng(5)
    for pitch in (np.pi / 2, -np.pi / 2):
        for roll, yaw in rng.uniform(-np.pi, np.pi, (50, 2)):
            assert matrix_to_rpy(rpy_to_matrix([roll, pitch, yaw]))[2] == 0.0


def test_the_24_turns_of_a_cube_come_back_without_negative_zeros():
    turns = 0
    for order, signs in product(permutations(range(3)), product([1.0, -1.0], repeat=3)):
        R = np.zeros((3, 3))
        R[range(3), order] = signs
        R[R == 0.0] = -0.0
        if np.linalg.det(R) > 0:
            turns += 1
            rpy = matrix_to_rpy(R)
            assert round_trip_error(R) < ROUNDING
            assert not np.any(np.signbit(rpy) & (rpy == 0.0))
            assert np.all(rpy > -np.pi)
    assert turns == 24


def test_what_comes_out_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        matrix_to_rpy(np.eye(3))[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        rpy_to_matrix([0, 0, 0])[0, 0] = 2.0


def random_vectors(count: int) -> np.ndarray:
    """Rotation vectors of all lengths from none to almost half a turn."""
    axes = np.random.default_rng(6).normal(size=(count, 3))
    lengths = np.concatenate([[0.0], np.geomspace(1e-15, 3.1, count - 1)])
    return axes / np.linalg.norm(axes, axis=1, keepdims=True) * lengths[:, None]


def test_rotation_vectors_are_pinocchios_and_come_back():
    w = random_vectors(200)
    R = rotation_vector_to_matrix(w)
    np.testing.assert_allclose(R, [pin.exp3(one) for one in w], rtol=0, atol=1e-15)
    back = matrix_to_rotation_vector(R.reshape(20, 10, 3, 3)).reshape(-1, 3)
    np.testing.assert_allclose(back, w, rtol=0, atol=1e-13)
    # An absolute error of 1e-13 would hide it: of small angles no digit is lost.
    np.testing.assert_allclose(back[:100], w[:100], rtol=1e-12)


def test_quaternions_are_pinocchios_whichever_component_is_largest():
    w = np.concatenate([random_vectors(50), np.pi * np.eye(3), -np.pi * np.eye(3)])
    R = rotation_vector_to_matrix(w)
    q = matrix_to_quaternion(R)
    assert set(np.abs(q).argmax(axis=1)) == {0, 1, 2, 3}
    for one, matrix in zip(q, R, strict=True):
        np.testing.assert_allclose(quaternion_to_matrix(one), matrix, rtol=0, atol=1e-15)
        np.testing.assert_allclose(quaternion_to_matrix(-3.0 * one), pin.Quaternion(one).matrix(), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(matrix_to_quaternion(R[7]), q[7])


@pytest.mark.parametrize("direction", [[0, 0, 2], [0, 0, -1], [1, 0, 0], [-0.3, 0.2, 0.9]])
def test_z_turns_to_a_direction_by_the_smallest_angle(direction):
    R = turn_z_to(direction)
    unit = np.array(direction) / np.linalg.norm(direction)
    np.testing.assert_allclose(R[:, 2], unit, atol=1e-15)
    assert np.linalg.norm(pin.log3(R)) == pytest.approx(np.arccos(unit[2]))


def test_skew_is_the_cross_product():
    v, w = np.random.default_rng(7).normal(size=(2, 5, 3))
    np.testing.assert_allclose((skew(v) @ w[..., None])[..., 0], np.cross(v, w), atol=1e-15)
