from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from urdfcal.robot.urdf.rpy import matrix_to_rpy, rpy_to_matrix

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
