from __future__ import annotations

import warnings
from dataclasses import FrozenInstanceError

import cv2
import numpy as np
import pytest

from urdfcal.cameras.camera import Camera
from urdfcal.cameras.lens import Lens
from urdfcal.errors import CameraError

SIZE = (1280, 1024)
K = [1400.0, 1404.0, 640.5, 509.25]
WIDE = [620.0, 618.0, 630.0, 520.0]
CAMERAS = [
    Camera("none", SIZE, K),
    Camera("radtan4", SIZE, K, "radtan", [-0.28, 0.12, 1.2e-3, -0.7e-3]),
    Camera("radtan5", SIZE, WIDE, "radtan", [-0.30, 0.09, 1e-3, -5e-4, 0.01]),
    Camera("pincushion", SIZE, K, "radtan", [0.11, 0.05, -3e-3, 2e-3, 0.02]),
    Camera("photo", (4000, 6000), [8185.4, 8170.4, 2009.3, 2964.0], "radtan", [-0.021, -0.206, -2e-3, -1e-3, 0.719]),
    Camera("equidistant", SIZE, WIDE, "equidistant", [-0.02, 0.01, -0.003, 0.0004]),
    Camera("fisheye", SIZE, [420.0, 421.0, 640.5, 511.0], "equidistant", [0.1, 0.05, 0.02, 0.01]),
]
each_camera = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
# A single barrel coefficient: the polynomial r - 0.3 r³ turns back at r = 1.054.
FOLDING = Camera("folding", SIZE, WIDE, "radtan", [-0.3, 0.0, 0.0, 0.0])


def image_grid(camera: Camera, count: int = 61) -> np.ndarray:
    w, h = camera.resolution
    return np.stack(np.meshgrid(np.linspace(-0.5, w - 0.5, count), np.linspace(-0.5, h - 0.5, count)), axis=-1)


def points_in_view(camera: Camera, count: int = 200, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    w, h = camera.resolution
    return camera.unproject(rng.uniform([0, 0], [w, h], (count, 2))) * rng.uniform(0.3, 4.0, (count, 1))


def assert_columns_agree(J: np.ndarray, reference: np.ndarray, tolerance: float) -> None:
    for column in range(J.shape[-1]):
        scale = np.abs(reference[..., column]).max()
        error = np.abs(J[..., column] - reference[..., column]).max()
        assert scale > 0.0
        assert error <= tolerance * scale, f"column {column}: {error / scale:.1e}"


@each_camera
def test_derivative_wrt_the_point_agrees_with_finite_differences(camera: Camera) -> None:
    points = points_in_view(camera)
    _, J, _ = camera.project_with_derivatives(points)
    h = 1e-6
    reference = np.stack(
        [(camera.project(points + h * e) - camera.project(points - h * e)) / (2 * h) for e in np.eye(3)], axis=-1
    )
    assert_columns_agree(J, reference, 1e-7)


@each_camera
def test_derivative_wrt_every_parameter_agrees_with_finite_differences(camera: Camera) -> None:
    points = points_in_view(camera)
    _, _, J = camera.project_with_derivatives(points)
    h = 1e-4  # the projection is linear in every parameter, so only rounding counts
    reference = np.stack(
        [
            (camera.with_parameters(camera.parameters + h * e).project(points)
             - camera.with_parameters(camera.parameters - h * e).project(points)) / (2 * h)
            for e in np.eye(len(camera.parameters))
        ],
        axis=-1,
    )  # fmt: skip
    assert J.shape == (len(points), 2, len(camera.parameter_names))
    assert_columns_agree(J, reference, 1e-7)


@each_camera
def test_the_three_projections_are_one(camera: Camera) -> None:
    points = points_in_view(camera).reshape(20, 10, 3)
    uv, J, _ = camera.project_with_derivatives(points)
    np.testing.assert_array_equal(camera.project(points), uv)
    np.testing.assert_array_equal(camera.project_with_jacobian(points)[0], uv)
    np.testing.assert_array_equal(camera.project_with_jacobian(points)[1], J)


@each_camera
def test_projection_agrees_with_opencv(camera: Camera) -> None:
    points = points_in_view(camera)
    fx, fy, cx, cy = camera.intrinsics
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if camera.distortion_model == "equidistant":
        reference = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), matrix, camera.distortion)[0]
    else:
        coefficients = camera.distortion if len(camera.distortion) else None
        reference = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)[0]
    np.testing.assert_allclose(camera.project(points), reference.reshape(-1, 2), rtol=0, atol=1e-9)


@each_camera
def test_every_pixel_of_the_image_comes_back(camera: Camera) -> None:
    uv = image_grid(camera)
    rays = camera.unproject(uv)
    assert np.isfinite(rays).all()
    assert (rays[..., 2] == 1.0).all()
    np.testing.assert_allclose(camera.project(rays), uv, rtol=0, atol=1e-10)


@each_camera
def test_rays_come_back_from_their_pixels(camera: Camera) -> None:
    points = points_in_view(camera, seed=3)
    np.testing.assert_allclose(camera.unproject(camera.project(points)), points / points[:, 2:], rtol=0, atol=1e-12)


@each_camera
def test_any_leading_shape_gives_the_same_numbers(camera: Camera) -> None:
    points = points_in_view(camera, 12)
    uv, J, J_parameters = camera.project_with_derivatives(points)
    for shape in ((12,), (3, 4), (2, 3, 2), (12, 1)):
        reshaped = camera.project_with_derivatives(points.reshape(*shape, 3))
        assert reshaped[0].shape == (*shape, 2)
        for got, expected in zip(reshaped, (uv, J, J_parameters), strict=True):
            np.testing.assert_array_equal(got.reshape(expected.shape), expected)
        np.testing.assert_array_equal(camera.unproject(uv.reshape(*shape, 2)).reshape(-1, 3), camera.unproject(uv))
    assert camera.project_with_derivatives(points[0])[1].shape == (2, 3)
    np.testing.assert_allclose(camera.project(points[0]), uv[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(camera.unproject(uv[0]), camera.unproject(uv)[0], rtol=0, atol=1e-15)
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)
    assert camera.unproject(np.zeros((0, 2))).shape == (0, 3)


@each_camera
def test_the_optical_axis_meets_the_principal_point_exactly(camera: Camera) -> None:
    np.testing.assert_array_equal(camera.project(np.array([0.0, 0.0, 2.0])), camera.intrinsics[2:])
    np.testing.assert_array_equal(camera.unproject(camera.intrinsics[2:]), [0.0, 0.0, 1.0])


@each_camera
def test_what_cannot_be_seen_is_nan_without_a_warning(camera: Camera) -> None:
    hidden = [
        [0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.2, -1.0], [0.1, 0.2, -1e-300], [np.nan, 0.0, 1.0],
        [0.0, 0.0, np.nan], [np.inf, 0.0, 1.0], [0.0, 0.0, np.inf], [1.0, 0.0, 1e-300],
    ]  # fmt: skip
    points = np.array([[0.1, 0.05, 1.0], *hidden])
    before = points.copy()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        uv, J, J_parameters = camera.project_with_derivatives(points)
        single = [camera.project(point) for point in points]
        rays = camera.unproject(uv)
    for array in (uv, J, J_parameters, rays):
        assert np.isfinite(array[0]).all()
        assert np.isnan(array[1:]).all()
    np.testing.assert_allclose(single, uv, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(points, before)


def test_a_point_beyond_the_fold_does_not_appear_in_the_image() -> None:
    r = 1.5
    folded_back = np.array([r * (1.0 - 0.3 * r**2), 0.0]) * WIDE[:2] + WIDE[2:]
    assert FOLDING.in_image(folded_back)  # what the bare polynomial would say
    assert np.isnan(FOLDING.project(np.array([r, 0.0, 1.0]))).all()
    fold = 1.0 / np.sqrt(0.9)
    inside, outside = np.array([[0.998 * fold, 0.0, 1.0], [1.001 * fold, 0.0, 1.0]])
    assert np.isfinite(FOLDING.project(inside)).all()
    assert np.isnan(FOLDING.project(outside)).all()


def test_pixels_no_ray_meets_are_nan() -> None:
    fold = 1.0 / np.sqrt(0.9)
    reach = fold * (1.0 - 0.3 * fold**2)  # nothing is seen further from the axis than this
    angles = np.linspace(0.0, 2.0 * np.pi, 50)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * WIDE[:2]
    assert np.isfinite(FOLDING.unproject(0.999 * reach * circle + WIDE[2:])).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isnan(FOLDING.unproject(1.001 * reach * circle + WIDE[2:])).all()
        assert np.isnan(FOLDING.unproject(100.0 * reach * circle + WIDE[2:])).all()
    fisheye = Camera("ideal", SIZE, WIDE, "equidistant", [0.0] * 4)
    quarter_turn = 0.5 * np.pi * circle
    assert np.isfinite(fisheye.unproject(0.99 * quarter_turn + WIDE[2:])).all()
    assert np.isnan(fisheye.unproject(1.01 * quarter_turn + WIDE[2:])).all()


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("model", "scale"),
    [
        ("radtan", [0.4, 0.3, 0.01, 0.01, 0.2]),
        ("radtan", [0.4, 0.3, 0.3, 0.3]),
        ("equidistant", [0.3, 0.2, 0.1, 0.05]),
    ],
)
def test_lenses_are_invertible_up_to_their_fold_and_no_further(model: str, scale: list[float]) -> None:
    rng = np.random.default_rng(7)
    folds = 0
    for _ in range(60):
        lens = Lens.from_coefficients(model, rng.normal(size=len(scale)) * scale)
        angles = rng.uniform(-np.pi, np.pi, 500)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        xy = min(lens.radius, 20.0) * np.sqrt(rng.uniform(0.0, 1.0, (500, 1))) * directions
        distorted, J = lens.distort_with_jacobian(xy)
        assert (np.linalg.eigvals(J).real > 0.0).all()
        np.testing.assert_allclose(lens.distort(lens.undistort(distorted)), distorted, rtol=1e-12, atol=1e-12)
        # undistort finds the very ray again, as well as the lens' derivative lets it
        error = np.linalg.norm(lens.undistort(distorted) - xy, axis=1)
        steepness = np.linalg.svd(J, compute_uv=False)[:, -1]
        assert (error * steepness < 1e-12 * (1.0 + np.linalg.norm(distorted, axis=1))).all()
        if lens.radius < 20.0:
            folds += 1
            past = np.tan(1.002 * lens.limit) if lens.fisheye else 1.002 * lens.limit
            around = np.linspace(-np.pi, np.pi, 721)
            _, J = lens.distort_with_jacobian(past * np.stack([np.cos(around), np.sin(around)], axis=-1))
            assert np.linalg.eigvals(J).real.min() < 0.0
    assert folds > 10


def test_parameters_make_the_camera_again() -> None:
    for camera in CAMERAS:
        again = camera.with_parameters(camera.parameters)
        assert again.name == camera.name
        np.testing.assert_array_equal(again.parameters, camera.parameters)
        assert len(camera.parameter_names) == len(camera.parameters)
    assert CAMERAS[1].parameter_names == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    with pytest.raises(CameraError, match=r"8 parameters are needed, the array's shape is \(9,\)"):
        CAMERAS[1].with_parameters(np.zeros(9))
    with pytest.raises(CameraError, match="must be positive"):
        CAMERAS[1].with_parameters(-CAMERAS[1].parameters)


def test_a_change_of_a_coefficient_moves_the_fold() -> None:
    point = np.array([1.2, 0.0, 1.0])
    assert np.isnan(FOLDING.project(point)).all()
    flatter = FOLDING.with_parameters(np.array([*WIDE, -0.2, 0.0, 0.0, 0.0]))
    assert np.isfinite(flatter.project(point)).all()


def test_a_camera_cannot_be_changed() -> None:
    given = np.array(K)
    camera = Camera("cam", SIZE, given)
    given[0] = 1.0
    assert camera.intrinsics[0] == K[0]
    with pytest.raises(ValueError, match="read-only"):
        camera.intrinsics[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        camera.parameters[0] = 1.0
    with pytest.raises(FrozenInstanceError):
        camera.name = "other"  # type: ignore[misc]


def test_the_image_reaches_half_a_pixel_beyond_the_outermost_pixel_centres() -> None:
    camera = CAMERAS[0]
    uv = np.array([[-0.5, -0.5], [1279.5, 1023.5], [-0.6, 5.0], [5.0, 1023.6], [np.nan, 5.0], [9.4, 500.0]])
    assert camera.in_image(uv).tolist() == [True, True, False, False, False, True]
    assert camera.in_image(uv, margin=10.0).tolist() == [False] * 6
    assert camera.in_image(uv, margin=9.9).tolist() == [False] * 5 + [True]


BROKEN = {
    "no name": ({"name": " "}, "a camera is named ' '"),
    "one side": ({"resolution": (1280,)}, r"resolution \[1280\] is not \[width, height\]"),
    "fractional side": ({"resolution": (1280.0, 1024)}, r"in whole positive pixels"),
    "no height": ({"resolution": (1280, 0)}, r"in whole positive pixels"),
    "three intrinsics": ({"intrinsics": K[:3]}, "need the 4 numbers fx fy cx cy, 3 are given"),
    "NaN": ({"intrinsics": [np.nan, *K[1:]]}, "intrinsics .*nan.* must be a list of finite numbers"),
    "text": ({"intrinsics": ["a", *K[1:]]}, "must be a list of finite numbers"),
    "infinite coefficient": ({"distortion": [0, 0, 0, np.inf]}, "distortion .*inf.* must be a list of finite"),
    "matrix": ({"intrinsics": np.eye(3)}, "must be a list of finite numbers"),
    "negative focal length": ({"intrinsics": [-1400.0, *K[1:]]}, r"focal length \(-1400, 1404\) px must be positive"),
    "millimetres": ({"intrinsics": [16.0, 16.0, 640.0, 512.0]}, r"focal length \(16, 16\) .* like millimetres"),
    "normalised": ({"intrinsics": [1.1, 1.4, 0.5, 0.5]}, r"focal length \(1.1, 1.4\) .*like .* or normalised"),
    "telescope": ({"intrinsics": [1.4e6, 1.4e6, 640, 512]}, r"focal length \(1.4e\+06, 1.4e\+06\) px is a telescope's"),
    "coefficient of no lens": ({"distortion": [0, -2e6, 0, 0]}, "coefficient is -2e\\+06: no lens bends rays so far"),
    "centre in millimetres": ({"intrinsics": [1400, 1400, 6.4, 5.1]}, r"principal point \(6.4, 5.1\) .* millimetres"),
    "centre normalised": ({"intrinsics": [1400, 1400, 0.5, 0.5]}, r"principal point \(0.5, 0.5\) .* normalised"),
    "centre far outside": ({"intrinsics": [1400, 1400, 640, 5120]}, r"principal point \(640, 5120\) .* far outside"),
    "order fx cx fy cy": ({"intrinsics": [2400, 640, 1400, 512]}, "order is fx fy cx cy"),
    "unknown model": ({"distortion_model": "fov"}, "'fov' is not known. Use one of: radtan, equidistant, none"),
    "three coefficients": ({"distortion": [0.1, 0.1, 0.1]}, "takes 4 or 5 coefficients, 3 are given. Their order is"),
    "five for a fisheye": (
        {"distortion_model": "equidistant", "distortion": [0.0] * 5},
        "equidistant distortion takes 4 coefficients, 5 are given",
    ),
    "coefficients without a model": ({"distortion_model": "none"}, "none distortion takes 0 coefficients, 4"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_values_that_are_no_camera_are_refused(changes: dict[str, object], message: str) -> None:
    good = {
        "name": "left",
        "resolution": SIZE,
        "intrinsics": K,
        "distortion_model": "radtan",
        "distortion": [-0.2, 0.1, 0.0, 0.0],
    }
    Camera(**good)
    with pytest.raises(CameraError, match=message) as caught:
        Camera(**{**good, **changes})
    if "name" not in changes:
        assert str(caught.value).startswith("camera 'left': ")
