"""What a motion says of poses and frames: labels, joint values, and which of them are independent."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from urdfcal.errors import SessionError
from urdfcal.session.trajectory import AT_REST, AtRest, JointLog, Motion, Trajectory

TIME = np.linspace(3.0, 9.0, 121)
LOG = JointLog(TIME, np.stack([np.sin(TIME), np.cos(TIME)], axis=1))
OFFSETS = np.array([0.02, -0.007])


def filmed() -> Trajectory:
    """Frames of two cameras, in no order of time."""
    camera = np.array([0, 1, 0, 1, 0, 0])
    time = np.array([7.9, 3.5, 4.1, 5.2, 4.6, 6.4])
    return Trajectory(LOG, (("a", "b", "c", "d"), ("a", "b")), camera, np.array([3, 0, 0, 1, 1, 2]), time)


class TestAtRest:
    def test_poses_keep_their_labels(self) -> None:
        assert [AT_REST.label(k, ("home", "up")) for k in range(2)] == ["home", "up"]

    def test_clocks_do_not_matter(self) -> None:
        q = np.arange(6.0).reshape(3, 2)
        assert AT_REST.joint_values(q, OFFSETS) is q
        assert AT_REST.covered(3, np.array([1e6, -1e6])).tolist() == [True, True, True]

    def test_some_of_its_poses_are_at_rest(self) -> None:
        assert AT_REST.at(np.array([0, 2])) == AT_REST

    def test_each_configuration_is_independent_and_its_repeats_belong_to_it(self) -> None:
        q = np.array([[0.0, 0.0], [1.0, 0.0], [0.04, -0.04], [1.0, 0.06], [0.0, 0.01], [0.0, 0.0]])
        assert AT_REST.independent(q).tolist() == [0, 1, 0, 2, 0, 0]

    def test_repeats_are_in_one_fold(self) -> None:
        q = np.repeat(np.arange(10.0)[:, None], 5, axis=0)
        fold = AT_REST.folds(q, 5, seed=0).reshape(10, 5)
        assert (fold == fold[:, :1]).all()
        assert np.bincount(fold[:, 0]).tolist() == [2] * 5

    @pytest.mark.parametrize(("poses", "folds"), [(20, 5), (23, 5), (3, 3), (7, 2), (2, 4)])
    def test_folds_are_of_equal_size_but_for_one(self, poses: int, folds: int) -> None:
        fold = AT_REST.folds(np.arange(float(poses))[:, None], folds, seed=0)
        sizes = np.bincount(fold, minlength=folds)
        assert fold.shape == (poses,)
        assert len(sizes) == folds
        assert np.ptp(sizes) <= 1

    def test_folds_are_mixed_and_the_seed_decides_how(self) -> None:
        q = np.arange(40.0)[:, None]
        first = AT_REST.folds(q, 4, seed=1)
        assert np.array_equal(first, AT_REST.folds(q, 4, seed=1))
        assert not np.array_equal(first, AT_REST.folds(q, 4, seed=2))
        assert not np.array_equal(first, np.arange(40) % 4)
        assert np.any(np.diff(first) < 0)  # no stretches

    def test_it_travels_to_other_processes(self) -> None:
        assert pickle.loads(pickle.dumps(AT_REST)) == AtRest()  # noqa: S301 - our own


class TestFilmed:
    def test_a_frame_goes_by_the_name_its_camera_gave_it(self) -> None:
        labels = tuple("012345")
        assert [filmed().label(k, labels) for k in range(6)] == ["d", "a", "a", "b", "b", "c"]

    def test_joint_values_are_the_logs_whatever_was_read_before(self) -> None:
        time = filmed().time + OFFSETS[filmed().camera]
        found = filmed().joint_values(np.full((6, 2), np.nan), OFFSETS)
        np.testing.assert_allclose(found, np.stack([np.sin(time), np.cos(time)], axis=1), atol=1e-6)

    def test_what_the_log_covers_depends_on_the_clock(self) -> None:
        assert filmed().covered(6, np.zeros(2)).all()
        assert filmed().covered(6, np.array([1.05, 0.0])).tolist() == [False, True, True, True, True, True]
        assert filmed().covered(6, np.array([0.0, -1.0])).tolist() == [True, False, True, True, True, True]

    def test_some_frames_are_a_trajectory_of_the_same_log(self) -> None:
        chosen = np.array([4, 1])
        some = filmed().at(chosen)
        assert some.log is LOG
        np.testing.assert_array_equal(some.values(OFFSETS), filmed().values(OFFSETS)[chosen])
        assert [some.label(k) for k in range(2)] == ["b", "a"]

    def test_frames_of_the_same_second_are_not_independent(self) -> None:
        """Counted from the first frame, at 3.5 s."""
        assert filmed().independent(np.zeros((6, 1))).tolist() == [4, 0, 0, 1, 1, 2]

    def test_folds_are_stretches_of_time(self) -> None:
        """Whatever the seed, and of the chosen frames alone."""
        assert filmed().folds(np.zeros((6, 1)), 3, seed=0).tolist() == [2, 0, 0, 1, 1, 2]
        assert filmed().folds(np.zeros((6, 1)), 3, seed=7).tolist() == [2, 0, 0, 1, 1, 2]
        assert filmed().at(np.array([0, 2, 4, 5])).folds(np.zeros((4, 1)), 2, seed=0).tolist() == [1, 0, 0, 1]

    @pytest.mark.parametrize("frames", [5, 6, 11, 40])
    def test_folds_hold_nearly_equal_numbers(self, frames: int) -> None:
        time = np.random.default_rng(0).uniform(3.5, 8.5, frames)
        many = Trajectory(LOG, (("x",) * frames,), np.zeros(frames, int), np.arange(frames), time)
        sizes = np.bincount(many.folds(np.zeros((frames, 1)), 5, seed=0), minlength=5)
        assert len(sizes) == 5
        assert np.ptp(sizes) <= 1

    def test_columns_of_different_length_are_refused(self) -> None:
        with pytest.raises(SessionError, match="cameras, rows and times differ in number"):
            Trajectory(LOG, (("a", "b"),), np.zeros(2, int), np.arange(2), np.array([4.0]))

    def test_its_arrays_cannot_be_written_to(self) -> None:
        for array in (filmed().camera, filmed().row, filmed().time, LOG.time, LOG.values):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = array[0]


def test_a_motion_says_all_of_it() -> None:
    """A kind of motion that leaves something out cannot be made."""

    class Silent(Motion):
        pass

    with pytest.raises(TypeError, match="abstract"):
        Silent()  # type: ignore[abstract]
    assert Motion.__abstractmethods__ == {
        "at",
        "label",
        "joint_values",
        "read_otherwise",
        "covered",
        "independent",
        "folds",
    }
