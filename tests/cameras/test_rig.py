from __future__ import annotations

import time
import warnings

import numpy as np
import pytest

from urdfcal.cameras.camera import Camera
from urdfcal.cameras.rig import Rig, Status, Triangulation
from urdfcal.errors import CameraError

SIZE = (1280, 1024)
LENS = [-0.28, 0.12, 1.2e-3, -0.7e-3]
LEFT = Camera("left", SIZE, [1400.0, 1402.0, 640.5, 511.0], "radtan", LENS)
RIGHT = Camera("right", SIZE, [1410.0, 1400.0, 630.0, 520.0], "radtan", [*LENS, 0.01])
TOP = Camera("top", SIZE, [620.0, 621.0, 650.0, 500.0], "equidistant", [-0.02, 0.01, -0.003, 0.0004])
PLAIN = (Camera("a", SIZE, [1400.0, 1400.0, 640.0, 512.0]), Camera("b", SIZE, [1400.0, 1400.0, 640.0, 512.0]))


def facing(position: list[float], target: list[float]) -> np.ndarray:
    """T_cam_world of a camera at a position, looking at a target."""
    z = np.subtract(target, position)
    z = z / np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = [x, np.cross(z, x), z]
    T[:3, 3] = -T[:3, :3] @ position
    return T


TARGET = [0.0, 0.0, 1.5]
T_RIGHT = facing([0.5, 0.02, 0.1], TARGET)
T_TOP = facing([0.1, -0.6, 0.3], TARGET)
STEREO = Rig((LEFT, RIGHT), (np.eye(4), T_RIGHT))
TRIPLE = Rig((LEFT, RIGHT, TOP), (np.eye(4), T_RIGHT, T_TOP))


def points_before(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-0.25, -0.25, 1.2], [0.25, 0.25, 1.8], (count, 3))


def detections(rig: Rig, points: np.ndarray) -> np.ndarray:
    return np.stack(
        [
            camera.project(points @ T[:3, :3].T + T[:3, 3])
            for camera, T in zip(rig.cameras, rig.T_cam_world, strict=True)
            if T is not None
        ],
        axis=1,
    )


def squared_errors(found: Triangulation, truth: np.ndarray) -> np.ndarray:
    error = found.points - truth
    return np.einsum("mi,mij,mj->m", error, np.linalg.inv(found.covariances), error)


def assert_nan_unless_ok(found: Triangulation) -> None:
    for array in (found.points, found.covariances, found.rms):
        finite = np.isfinite(array.reshape(len(array), -1))
        assert finite[found.ok].all()
        assert not finite[~found.ok].any()


@pytest.mark.parametrize("rig", [STEREO, TRIPLE], ids=["stereo", "three"])
def test_noise_free_sightings_give_the_true_points(rig: Rig) -> None:
    points = points_before(500)
    found = rig.triangulate(detections(rig, points), 0.1)
    assert found.ok.all()
    np.testing.assert_allclose(found.points, points, rtol=0, atol=1e-12)
    assert found.rms.max() < 1e-9


@pytest.mark.parametrize("rig", [STEREO, TRIPLE], ids=["stereo", "three"])
def test_covariances_are_true(rig: Rig) -> None:
    draws = 20_000
    points = points_before(draws, seed=1)
    rng = np.random.default_rng(2)
    sigma = rng.uniform(0.05, 0.5, (draws, len(rig.cameras)))
    uv = detections(rig, points)
    found = rig.triangulate(uv + sigma[:, :, None] * rng.normal(size=uv.shape), sigma)
    assert found.ok.all()
    chi2 = squared_errors(found, points)
    assert abs(chi2.mean() / 3.0 - 1.0) < 0.03
    assert abs((chi2 < 7.815).mean() - 0.95) < 0.005
    residuals = 2 * len(rig.cameras)
    assert abs((found.rms**2 * residuals).mean() / (residuals - 3) - 1.0) < 0.03
    np.testing.assert_array_equal(found.covariances, np.swapaxes(found.covariances, 1, 2))


def test_depth_is_worse_than_width() -> None:
    found = STEREO.triangulate(detections(STEREO, np.array([[0.05, 0.0, 1.5]])), 0.1)
    x, y, z = np.sqrt(np.diag(found.covariances[0]))
    assert z > 3.0 * max(x, y)


def test_the_solution_is_the_minimum_of_the_weighted_pixel_errors() -> None:
    rng = np.random.default_rng(3)
    sigma = rng.uniform(0.2, 2.0, (50, 3))
    uv = detections(TRIPLE, points_before(50)) + rng.normal(size=(50, 3, 2))
    found = TRIPLE.triangulate(uv, sigma)

    def cost(points: np.ndarray) -> np.ndarray:
        return np.sum(((uv - detections(TRIPLE, points)) / sigma[:, :, None]) ** 2, axis=(1, 2))

    np.testing.assert_allclose(found.rms, np.sqrt(cost(found.points) / 6.0), rtol=1e-12)
    h = 1e-5
    for axis in np.eye(3):
        slope = (cost(found.points + h * axis) - cost(found.points - h * axis)) / (2.0 * h)
        curvature = (cost(found.points + h * axis) + cost(found.points - h * axis) - 2.0 * cost(found.points)) / h**2
        assert (np.abs(slope / curvature) < 1e-9).all()


def test_world_is_the_first_cameras_frame() -> None:
    """The same points, described from the other camera."""
    points = points_before(50)
    noisy = detections(STEREO, points) + np.random.default_rng(4).normal(0.0, 0.3, (50, 2, 2))
    from_left = STEREO.triangulate(noisy, 0.3)
    from_right = Rig((RIGHT, LEFT), (np.eye(4), np.linalg.inv(T_RIGHT))).triangulate(noisy[:, ::-1], 0.3)
    R, t = T_RIGHT[:3, :3], T_RIGHT[:3, 3]
    np.testing.assert_allclose(from_right.points, from_left.points @ R.T + t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(from_right.covariances, R @ from_left.covariances @ R.T, rtol=1e-4, atol=1e-12)


def test_missing_views_count_and_two_are_enough() -> None:
    points = points_before(8)
    uv = detections(TRIPLE, points)
    views = np.array([[bool(i & bit) for bit in (1, 2, 4)] for i in range(8)])
    uv[~views] = np.nan
    sigma = np.where(views, 0.1, 0.0)  # of a detection that is not there, sigma means nothing
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = TRIPLE.triangulate(uv, sigma)
    enough = views.sum(axis=1) >= 2
    assert found.status.tolist() == [Status.OK if e else Status.TOO_FEW_VIEWS for e in enough]
    np.testing.assert_allclose(found.points[enough], points[enough], rtol=0, atol=1e-12)
    assert_nan_unless_ok(found)
    stereo = STEREO.triangulate(detections(STEREO, points), 0.1)
    np.testing.assert_allclose(found.covariances[3], stereo.covariances[3], rtol=1e-9)
    gain = np.linalg.eigvalsh(stereo.covariances[7] - found.covariances[7])
    assert gain[0] > -1e-18  # a third view, two numbers, takes nothing away
    assert gain[1] > 1e-10


def test_half_a_sighting_is_no_sighting() -> None:
    uv = detections(STEREO, points_before(1))
    uv[0, 1, 0] = np.nan
    assert STEREO.triangulate(uv, 0.1).status[0] == Status.TOO_FEW_VIEWS


def test_a_camera_of_unknown_place_takes_no_part() -> None:
    points = points_before(20)
    uv = detections(TRIPLE, points)
    uv[:, 2] += 300.0
    rig = Rig((LEFT, RIGHT, TOP), (np.eye(4), T_RIGHT, None))
    found = rig.triangulate(uv, 0.1)
    np.testing.assert_array_equal(found.points, STEREO.triangulate(uv[:, :2], 0.1).points)
    alone = Rig((LEFT, RIGHT), (np.eye(4), None)).triangulate(uv[:, :2], 0.1)
    assert (alone.status == Status.TOO_FEW_VIEWS).all()


def test_rays_that_meet_behind_the_cameras_are_told() -> None:
    rig = Rig(PLAIN, (np.eye(4), facing([0.5, 0.0, 0.0], [0.5, 0.0, 1.0])))
    diverging = np.array([[[540.0, 512.0], [740.0, 512.0]], [[740.0, 512.0], [540.0, 512.0]]])
    found = rig.triangulate(diverging, 0.1)
    assert found.status.tolist() == [Status.BEHIND_CAMERA, Status.OK]
    assert_nan_unless_ok(found)
    np.testing.assert_allclose(found.points[1], [0.25, 0.0, 0.25 * 14.0], rtol=1e-12)


def test_parallel_rays_are_told() -> None:
    rig = Rig(PLAIN, (np.eye(4), facing([0.05, 0.0, 0.0], [0.05, 0.0, 1.0])))
    assert rig.triangulate(np.full((1, 2, 2), 500.0), 0.1).status[0] == Status.PARALLEL_RAYS
    assert rig.triangulate(np.full((1, 2, 2), 500.0), 1e-12).status[0] == Status.PARALLEL_RAYS
    on_the_baseline = Rig(PLAIN, (np.eye(4), facing([0.0, 0.0, 0.5], [0.0, 0.0, 1.0])))
    assert on_the_baseline.triangulate(np.array([[[640.0, 512.0]] * 2]), 0.1).status[0] == Status.PARALLEL_RAYS


def test_the_limit_of_parallel_rays_is_where_the_covariance_stops_being_true() -> None:
    sigma, baseline, draws = 0.1, 0.05, 10_000
    rig = Rig(PLAIN, (np.eye(4), facing([baseline, 0.0, 0.0], [baseline, 0.0, 1.0])))
    rng = np.random.default_rng(5)
    noise = np.sqrt(2.0) * sigma / 1400.0
    for ratio, told in ((7.0, Status.PARALLEL_RAYS), (14.0, Status.OK)):
        point = np.tile([0.0, 0.0, baseline / (ratio * noise)], (draws, 1))
        found = rig.triangulate(detections(rig, point) + rng.normal(0.0, sigma, (draws, 2, 2)), sigma)
        assert (found.status == told).mean() > 0.99
        assert_nan_unless_ok(found)
    ok = found.ok
    assert abs((squared_errors(found, point)[ok] < 7.815).mean() - 0.95) < 0.01


def test_a_pixel_no_ray_meets_is_told() -> None:
    folding = Camera("folding", SIZE, [620.0, 618.0, 630.0, 520.0], "radtan", [-0.3, 0.0, 0.0, 0.0])
    rig = Rig((folding, RIGHT), (np.eye(4), T_RIGHT))
    uv = detections(rig, points_before(2))
    uv[0, 0] = [630.0 + 0.71 * 620.0, 520.0]  # the lens reaches 0.703
    found = rig.triangulate(uv, 0.1)
    assert found.status.tolist() == [Status.OUTSIDE_LENS, Status.OK]
    assert_nan_unless_ok(found)


def test_nonsense_sightings_end_in_a_status_without_a_warning() -> None:
    uv = np.random.default_rng(6).uniform(0.0, SIZE, (20_000, 2, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = STEREO.triangulate(uv, 0.1)
    assert_nan_unless_ok(found)
    assert set(found.status) <= set(Status)
    assert (found.status == Status.NOT_CONVERGED).mean() < 0.02
    assert np.median(found.rms[found.ok]) > 100.0


def test_exchanged_cameras_show_in_the_residuals() -> None:
    rng = np.random.default_rng(8)
    uv = detections(STEREO, points_before(200)) + rng.normal(0.0, 0.1, (200, 2, 2))
    right, wrong = STEREO.triangulate(uv, 0.1), STEREO.triangulate(uv[:, ::-1], 0.1)
    assert np.median(right.rms) < 1.0
    assert np.median(np.where(wrong.ok, wrong.rms, np.inf)) > 10.0


@pytest.mark.parametrize("sigma", [1e-12, 1e-6, 1.0, 3.0])
def test_the_scale_of_sigma_changes_nothing_but_the_covariance(sigma: float) -> None:
    points = points_before(200)
    uv = detections(STEREO, points)
    found = STEREO.triangulate(uv, sigma)
    assert found.ok.all()
    np.testing.assert_allclose(found.points, points, rtol=0, atol=1e-12)
    reference = STEREO.triangulate(uv, 0.1)
    np.testing.assert_allclose(found.covariances, reference.covariances * (sigma / 0.1) ** 2, rtol=1e-9)


def test_no_points_and_read_only_results() -> None:
    empty = STEREO.triangulate(np.zeros((0, 2, 2)), 0.1)
    assert empty.points.shape == (0, 3)
    assert empty.covariances.shape == (0, 3, 3)
    found = STEREO.triangulate(detections(STEREO, points_before(2)), 0.1)
    for array in (found.points, found.covariances, found.rms, found.status):
        assert not array.flags.writeable
    assert found.status.dtype == np.intp


@pytest.mark.no_cover
def test_a_hundred_thousand_stereo_points_take_about_a_second() -> None:
    uv = detections(STEREO, points_before(100_000))
    uv += np.random.default_rng(9).normal(0.0, 0.1, uv.shape)
    start = time.process_time()
    found = STEREO.triangulate(uv, 0.1)
    assert time.process_time() - start < 3.0  # about 0.6 s; the margin is for a busy machine
    assert found.ok.all()


def test_cameras_are_found_by_name() -> None:
    assert TRIPLE.names == ("left", "right", "top")
    assert TRIPLE.index("top") == 2
    with pytest.raises(CameraError, match=r"there is no camera 'middle'. There are: left, right, top"):
        TRIPLE.index("middle")


def test_without_cameras_it_is_empty() -> None:
    """So a session that something else measures has a rig as well."""
    empty = Rig()
    assert (empty.cameras, empty.T_cam_world, empty.sigmas, empty.names) == ((), (), (), ())
    with pytest.raises(CameraError, match="0 cameras have 1 transforms"):
        Rig((), (np.eye(4),))


@pytest.mark.parametrize(
    ("cameras", "transforms", "message"),
    [
        ((LEFT, LEFT), (np.eye(4), None), "two cameras are named 'left'"),
        ((LEFT, RIGHT), (np.eye(4),), "2 cameras have 1 transforms"),
        ((LEFT, RIGHT), (None, None), "camera 'left': T_cam_world of the first camera is not the identity"),
        ((LEFT, RIGHT), (T_RIGHT, np.eye(4)), "not the identity. The world frame is the first camera's"),
        ((LEFT, RIGHT), (np.eye(4), np.eye(3)), "camera 'right': T_cam_world is not a rigid"),
        ((LEFT, RIGHT), (np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])), "not a rigid"),
        ((LEFT, RIGHT), (np.eye(4), 1.001 * T_RIGHT), "not a rigid"),
        ((LEFT, RIGHT), (np.eye(4), np.full((4, 4), np.nan)), "not a rigid"),
    ],
)
def test_what_is_no_rig_is_refused(cameras: tuple, transforms: tuple, message: str) -> None:
    with pytest.raises(CameraError, match=message):
        Rig(cameras, transforms)


@pytest.mark.parametrize(
    ("uv", "sigma", "message"),
    [
        (np.zeros((3, 3, 2)), 0.1, r"pixels of 2 cameras have the shape \(3, 3, 2\)"),
        (np.zeros((2, 2)), 0.1, "not \\(M, C, 2\\)"),
        (np.zeros((3, 2, 2)), np.ones((2, 2)), r"sigma has the shape \(2, 2\)"),
        (np.zeros((3, 2, 2)), 0.0, "camera 'left': sigma 0 px of detection 0 must be positive"),
        (np.zeros((3, 2, 2)), [[1.0, 1.0], [1.0, np.nan], [1.0, 1.0]], "camera 'right': sigma nan px of detection 1"),
    ],
)
def test_sightings_that_do_not_fit_are_refused(uv: np.ndarray, sigma: object, message: str) -> None:
    with pytest.raises(CameraError, match=message):
        STEREO.triangulate(uv, sigma)


def test_some_cameras_of_several_groups_keep_their_groups_and_lenses() -> None:
    T = np.eye(4)
    T[0, 3] = 0.5
    cameras = tuple(Camera(name, (1280, 960), [900.0, 900.0, 640.0, 480.0]) for name in "abcd")
    rig = Rig(cameras, (np.eye(4), T, np.eye(4), T), group=(0, 0, 2, 2), lens=(0, 1, 2, 1))
    some = rig.at(np.array([1, 2, 3]))
    assert some.group == (0, 1, 1)
    assert some.lens == (0, 1, 0)
    places = [np.eye(4), np.eye(4), T]
    assert all(np.array_equal(place, expected) for place, expected in zip(some.T_cam_world, places, strict=True))
    with pytest.raises(CameraError, match="camera 'c': T_cam_world of the first camera is not the identity"):
        Rig(cameras, (np.eye(4), T, T, T), group=(0, 0, 2, 2))
