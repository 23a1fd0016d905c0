from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.cameras.board.boards import (
    CHARUCO,
    CHESSBOARD,
    PAIR,
    SIZE,
    as_views,
    errors,
    held,
    placed,
    seen,
    true_corners,
    turned,
)
from tests.cameras.board.rendering import BoardRenderer
from urdfcal.cameras.board.board import Board
from urdfcal.cameras.board.bundle import Bundle, adjust
from urdfcal.cameras.board.calibration import calibrate_cameras
from urdfcal.cameras.board.detection import detect_board
from urdfcal.cameras.board.start import board_poses
from urdfcal.cameras.board.views import BoardViews, find_images, read_views
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.rig import Rig
from urdfcal.errors import CameraError
from urdfcal.images.files import write_image

if TYPE_CHECKING:
    from pathlib import Path


def alone(camera: Camera) -> Rig:
    return Rig((camera,), (np.eye(4),))


def with_bad(views: BoardViews, camera: int, view: int, change: np.ndarray) -> BoardViews:
    uv = np.array(views.uv)
    uv[camera, view] += change
    return replace(views, uv=uv)


@pytest.fixture(scope="module")
def renderers() -> list[BoardRenderer]:
    return [BoardRenderer(camera) for camera in PAIR.cameras]


@pytest.mark.no_cover
@pytest.mark.parametrize(("board", "seed"), [(CHESSBOARD, 0), (CHARUCO, 1)], ids=["chessboard", "charuco"])
def test_cameras_from_rendered_pictures_are_within_three_sigma_of_the_truth(
    board: Board, seed: int, renderers: list[BoardRenderer]
) -> None:
    rng = np.random.default_rng(seed)
    poses = held(PAIR, board, 9, rng, far=0.6)
    uv = np.full((2, len(poses), len(board.corners), 2), np.nan)
    for v, T in enumerate(poses):
        for c in range(2):
            image = renderers[c].render(board, PAIR.T_cam_world[c] @ T, blur=0.8, noise=2.0, rng=rng)
            if (corners := detect_board(image, board)) is not None:
                uv[c, v] = corners.uv
    found = calibrate_cameras(as_views(PAIR, uv), board)
    assert [len(camera.distortion) for camera in found.rig.cameras] == [4, 4]
    error = errors(found.rig, PAIR)
    deviation = error / np.sqrt(np.diag(found.covariance))
    assert np.abs(deviation).max() < 3.5, dict(zip(found.names, deviation.round(1), strict=True))
    assert all(q.sigma < 0.02 for q in found.qualities)
    assert 8.0 < error @ np.linalg.solve(found.covariance, error) < 45.0  # 22 parameters


@pytest.mark.no_cover
def test_standard_deviations_are_true() -> None:
    chi2, deviations = [], []
    for seed in range(6):
        found = calibrate_cameras(seen(PAIR, CHESSBOARD, 12, seed, 0.05), CHESSBOARD)
        if any(len(camera.distortion) == 5 for camera in found.rig.cameras):
            continue  # k3 by chance, one in a few hundred
        error = errors(found.rig, PAIR)
        deviations.append(error / np.sqrt(np.diag(found.covariance)))
        chi2.append(error @ np.linalg.solve(found.covariance, error))
    assert len(chi2) >= 5
    # 22 degrees of freedom: the mean of 6 has a standard deviation of 2.7
    assert 16.0 < np.mean(chi2) < 29.0
    assert 0.85 < np.sqrt(np.mean(np.square(deviations))) < 1.15
    assert found.names[:4] == ("left.fx", "left.fy", "left.cx", "left.cy")
    assert found.names[-6:] == tuple(f"right.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
    lens, pose = found.rig.sigmas[1].parameters, found.rig.sigmas[1].pose
    np.testing.assert_array_equal(np.concatenate([lens, pose]), np.sqrt(np.diag(found.covariance))[8:])
    assert found.rig.sigmas[0].pose is None
    scale = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(found.rig.correlation, found.covariance / np.outer(scale, scale), rtol=0, atol=1e-14)


LENSES = [
    Camera("wide", SIZE, [310.0, 309.0, 315.0, 260.0], "radtan", [-0.30, 0.09, 1e-3, -5e-4]),
    Camera("tele", SIZE, [2500.0, 2502.0, 315.0, 260.0], "radtan", [-0.2, 0.3, 1e-3, -5e-4]),
    Camera("ideal", SIZE, [700.0, 702.0, 300.0, 250.0]),
    Camera("fisheye", SIZE, [210.0, 210.5, 320.5, 255.0], "equidistant", [0.05, 0.02, 0.01, 0.003]),
    Camera("k3", SIZE, [350.0, 351.0, 318.0, 257.0], "radtan", [-0.3, 0.15, 1e-3, -5e-4, -0.04]),
]


@pytest.mark.parametrize("camera", LENSES, ids=lambda camera: camera.name)
def test_every_kind_of_lens_is_found_from_nothing(camera: Camera) -> None:
    views = seen(alone(camera), CHESSBOARD, 20, 3, 0.01)
    model = camera.distortion_model
    found = calibrate_cameras(views, CHESSBOARD, model)
    assert len(found.rig.cameras[0].distortion) == len(camera.distortion)
    deviation = errors(found.rig, alone(camera)) / found.rig.sigmas[0].parameters
    assert np.abs(deviation).max() < 4.0
    assert found.qualities[0].sigma == pytest.approx(0.01, rel=0.1)


def test_derivatives_of_the_whole_agree_with_finite_differences() -> None:
    views = seen(PAIR, CHARUCO, 3, 0, 0.5)
    poses = np.stack([placed([0.1, 0.2, 0.3], [0.0, 0.0, 0.6]), placed([-0.3, 0.1, 0], [0.05, 0, 0.7])])
    bundle = Bundle(CHARUCO, PAIR.cameras, np.stack(PAIR.T_cam_world), poses)
    uv = bundle.project() + np.random.default_rng(0).normal(size=(2, 2, 54, 2))
    whitening = np.random.default_rng(1).uniform(0.5, 2.0, (2, 2, 54, 2, 2))
    assert np.isfinite(views.uv).any()
    normal = bundle.normal_equations(uv, whitening)
    zeros = np.zeros(bundle.size), np.zeros((2, 6))

    def cost(shared: np.ndarray, each: np.ndarray) -> float:
        return bundle.moved(shared, each).normal_equations(uv, whitening).cost

    scale = 1e-2 / np.sqrt(np.diag(normal.shared.sum(axis=0)))
    for i in range(bundle.size):
        step = np.zeros(bundle.size)
        step[i] = scale[i]
        slope = (cost(step, zeros[1]) - cost(-step, zeros[1])) / (2 * scale[i])
        assert slope == pytest.approx(-2.0 * normal.g_shared[:, i].sum(), rel=1e-5, abs=1e-3 / scale[i])
    for v, i in np.ndindex(2, 6):
        step = np.zeros((2, 6))
        step[v, i] = 1e-6
        slope = (cost(zeros[0], step) - cost(zeros[0], -step)) / 2e-6
        assert slope == pytest.approx(-2.0 * normal.g_views[v, i], rel=1e-4, abs=1.0)


def test_poses_come_out_of_exact_corners() -> None:
    rng = np.random.default_rng(2)
    for camera in LENSES:
        poses = np.stack(held(alone(camera), CHESSBOARD, 8, rng))
        uv = np.stack([true_corners(alone(camera), CHESSBOARD, T)[0] for T in poses])
        whole = np.isfinite(uv).all(axis=(1, 2))
        np.testing.assert_allclose(board_poses(camera, CHESSBOARD, uv[whole]), poses[whole], rtol=0, atol=1e-8)


@pytest.mark.parametrize("shape", [(8, 6), (6, 6)])
def test_boards_read_from_different_sides_by_two_cameras_are_set_right(shape: tuple[int, int]) -> None:
    board = Board("chessboard", *shape, 0.03)
    views = seen(PAIR, board, 14, 5)
    uv = np.array(views.uv)
    rng = np.random.default_rng(0)
    for c, v in np.ndindex(uv.shape[:2]):
        uv[c, v] = uv[c, v, board.symmetries[rng.integers(len(board.symmetries))]]
    found = calibrate_cameras(replace(views, uv=uv), board)
    assert not found.rejected
    assert np.abs(errors(found.rig, PAIR) / np.sqrt(np.diag(found.covariance))).max() < 4.0


@pytest.mark.no_cover
def test_three_cameras_are_chained_by_whatever_two_of_them_see() -> None:
    third = Camera("third", SIZE, [705.0, 705.0, 322.0, 251.0], "radtan", [-0.1, 0.05, 0.0, 0.0])
    rig = Rig((*PAIR.cameras, third), (*PAIR.T_cam_world, placed([0.0, 0.6, 0.0], [-0.42, 0.0, 0.1])))
    views = seen(rig, CHESSBOARD, 60, 1)
    uv = np.array(views.uv)
    # The first and the third have nothing in common.
    uv[0, ::2], uv[2, 1::2] = np.nan, np.nan
    found = calibrate_cameras(replace(views, uv=uv), CHESSBOARD)
    assert found.rig.T_cam_world[2] is not None
    assert np.abs(errors(found.rig, rig) / np.sqrt(np.diag(found.covariance))).max() < 4.0
    uv[2] = np.nan
    with pytest.raises(CameraError, match="camera 'third': only 0 of its images can be used"):
        calibrate_cameras(replace(views, uv=uv), CHESSBOARD)


def test_a_camera_without_common_views_has_no_place() -> None:
    views = seen(PAIR, CHESSBOARD, 30, 4)
    uv = np.array(views.uv)
    uv[0, ::2], uv[1, 1::2] = np.nan, np.nan
    found = calibrate_cameras(replace(views, uv=uv), CHESSBOARD)
    assert found.rig.T_cam_world[1] is None
    assert found.rig.sigmas[1].pose is None
    assert len(found.names) == len(found.covariance) == 16
    assert any("camera 'right' has no view in common" in text for text in found.warnings)
    assert (
        np.abs(
            errors(Rig(found.rig.cameras, (np.eye(4), PAIR.T_cam_world[1])), PAIR)[:16]
            / np.sqrt(np.diag(found.covariance))
        ).max()
        < 4
    )


@pytest.mark.no_cover
def test_views_that_do_not_belong_are_left_out_with_their_reason() -> None:
    views = seen(PAIR, CHESSBOARD, 16, 7)
    both = np.flatnonzero(np.isfinite(views.uv[:, :, 0, 0]).all(axis=0))
    moved, soft, few = both[:3]
    rng = np.random.default_rng(0)
    change = rng.normal(0.0, 1.0, (54, 2))
    bad = with_bad(views, 0, moved, change)
    bad.uv[1, few, 6:] = np.nan
    # A soft picture says so of its corners, and stays.
    covariance = np.array(bad.covariance)
    covariance[1, soft] = 0.5**2 * np.eye(2)
    bad.uv[1, soft] += rng.normal(0.0, 0.5, (54, 2))
    found = calibrate_cameras(replace(bad, covariance=covariance), CHESSBOARD)
    reasons = {(r.camera, r.view): r.reason for r in found.rejected}
    assert set(reasons) == {("left", f"{moved:02d}"), ("right", f"{few:02d}")}
    assert f"{soft:02d}" in found.qualities[1].views
    assert "x that of the others" in reasons["left", f"{moved:02d}"]
    assert reasons["right", f"{few:02d}"] == "only 6 of 54 corners are found, in 1 rows and 6 columns"
    assert np.abs(errors(found.rig, PAIR) / np.sqrt(np.diag(found.covariance))).max() < 4.0
    assert f"{moved:02d}" not in found.qualities[0].views


def test_a_board_that_moved_between_two_cameras_is_found_though_either_picture_is_good() -> None:
    views = seen(PAIR, CHESSBOARD, 16, 8)
    T = held(PAIR, CHESSBOARD, 16, np.random.default_rng(8))
    both = np.flatnonzero(np.isfinite(views.uv[:, :, 0, 0]).all(axis=0))[2]
    shifted = T[both].copy()
    shifted[:3, 3] += [0.004, 0.0, 0.0]
    uv = np.array(views.uv)
    uv[1, both] = true_corners(PAIR, CHESSBOARD, shifted)[1]
    found = calibrate_cameras(replace(views, uv=uv), CHESSBOARD)
    assert [r.view for r in found.rejected] == [f"{both:02d}"]
    assert "did the board move between the cameras?" in found.rejected[0].reason
    assert np.abs(errors(found.rig, PAIR) / np.sqrt(np.diag(found.covariance))).max() < 4.0


def test_cameras_that_did_not_take_their_pictures_at_the_same_time_are_refused() -> None:
    views = seen(PAIR, CHESSBOARD, 24, 8)
    uv = np.array(views.uv)
    both = np.isfinite(uv[:, :, 0, 0]).all(axis=0)
    uv = uv[:, both]
    uv[1] = np.roll(uv[1], 1, axis=0)
    with pytest.raises(CameraError, match="taken at the same time, or with the board held still"):
        calibrate_cameras(as_views(PAIR, uv), CHESSBOARD)
    # A board in a shaking hand: every view a millimetre off
    rng = np.random.default_rng(3)
    shaken = [
        T @ placed([0, 0, 0], rng.normal(0.0, 1e-3, 3)) for T in held(PAIR, CHESSBOARD, 24, np.random.default_rng(8))
    ]
    uv = np.array(views.uv)
    uv[1] = np.stack([true_corners(PAIR, CHESSBOARD, T)[1] for T in shaken]) + rng.normal(0.0, 0.02, uv[1].shape)
    with pytest.raises(CameraError, match=r"fit to 0.02\d* px alone, but to [\d.]+ px together"):
        calibrate_cameras(replace(views, uv=uv), CHESSBOARD)


def test_single_corners_far_off_are_left_out() -> None:
    views = seen(PAIR, CHESSBOARD, 14, 9)
    uv = np.array(views.uv)
    seen_corners = np.argwhere(np.isfinite(uv[..., 0]))
    for c, v, n in np.random.default_rng(0).permutation(seen_corners)[:15]:
        uv[c, v, n] += [0.7, -0.4]
    found = calibrate_cameras(replace(views, uv=uv), CHESSBOARD)
    assert sum(q.outliers for q in found.qualities) == 15
    assert np.abs(errors(found.rig, PAIR) / np.sqrt(np.diag(found.covariance))).max() < 4.0


def test_too_few_views_are_refused() -> None:
    views = seen(alone(PAIR.cameras[0]), CHESSBOARD, 2, 1)
    with pytest.raises(
        CameraError, match=r"camera 'left': only \d of its images can be used.*at least 3 .*Add sharp images"
    ):
        calibrate_cameras(views, CHESSBOARD)
    few = calibrate_cameras(seen(alone(PAIR.cameras[0]), CHESSBOARD, 6, 1), CHESSBOARD)
    assert any("images are few, 15 to 30 are good" in text for text in few.warnings)
    many = calibrate_cameras(seen(alone(PAIR.cameras[0]), CHESSBOARD, 20, 1), CHESSBOARD)
    assert not any("are few" in text or "focal length" in text for text in many.warnings)


@pytest.mark.parametrize("tilt", [0.0, 0.05, 0.12])
def test_boards_parallel_to_the_image_are_refused(tilt: float) -> None:
    views = seen(alone(PAIR.cameras[0]), CHESSBOARD, 20, 1, 0.02, tilt=tilt)
    with pytest.raises(CameraError, match=r"camera 'left': .* Add images with the board turned by 20° to 45°"):
        calibrate_cameras(views, CHESSBOARD)


@pytest.mark.parametrize(("tilt", "noise", "refused"), [(0.3, 0.5, False), (0.15, 4.0, True)])
def test_a_focal_length_known_badly_is_a_warning_and_refused_where_it_is_open(
    tilt: float, noise: float, refused: bool
) -> None:
    camera = PAIR.cameras[0]
    rng = np.random.default_rng(0)
    poses = [placed([tilt * (i % 3 - 1), tilt * (i // 3 - 1), 0.0], [-0.12, -0.07, 0.6]) for i in range(9)]
    uv = np.stack([true_corners(alone(camera), CHESSBOARD, T) for T in poses], axis=1)
    views = as_views(alone(camera), uv + rng.normal(0.0, noise, uv.shape))
    if refused:
        with pytest.raises(CameraError, match=r"focal length only to [\d.]+ % .* Add images .* Or --force takes them"):
            calibrate_cameras(views, CHESSBOARD)
    found = calibrate_cameras(views, CHESSBOARD, force=refused)
    deviation = errors(found.rig, alone(camera)) / found.rig.sigmas[0].parameters
    assert np.abs(deviation[:2]).max() < 4.0
    assert any(re.search(r"the focal length is known to [\d.]+ % only", text) for text in found.warnings)
    assert any("tell the focal length only to" in text for text in found.warnings) == refused


@pytest.mark.no_cover
def test_views_that_contradict_each_other_widen_the_standard_deviations() -> None:
    """A sheet of paper that hangs differently bent in every picture: its corners err together."""
    deviations = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        poses = held(PAIR, CHESSBOARD, 16, rng)
        middle = CHESSBOARD.corners.mean(axis=0)
        uv = []
        for T in poses:
            x, y, _ = 20.0 * (CHESSBOARD.corners - middle).T
            bent = replace(CHESSBOARD)
            bend = rng.normal(0.0, 1e-3, 3) @ np.stack([x * x, x * y, y * y])
            object.__setattr__(bent, "corners", CHESSBOARD.corners + np.stack([0 * x, 0 * x, bend], axis=1) / 4.0)
            uv.append(true_corners(PAIR, bent, T))
        views = as_views(PAIR, np.stack(uv, axis=1) + rng.normal(0.0, 0.02, (2, 16, 54, 2)))
        found = calibrate_cameras(views, CHESSBOARD, force=True)
        count = [len(camera.parameters) for camera in found.rig.cameras]
        if count == [8, 8]:
            deviations.append(errors(found.rig, PAIR) / np.sqrt(np.diag(found.covariance)))
    assert len(deviations) >= 3
    # With corners taken for independent this is 2.5.
    assert 0.6 < np.sqrt(np.mean(np.square(deviations))) < 1.6


@pytest.mark.no_cover
def test_soft_and_dim_pictures_give_cameras_as_good_as_they_say() -> None:
    rig = alone(PAIR.cameras[0])
    renderer, poses = BoardRenderer(rig.cameras[0]), held(rig, CHESSBOARD, 10, np.random.default_rng(4), far=0.5)
    views = as_views(rig, np.full((1, 10, 54, 2), np.nan))
    for v, T in enumerate(poses):
        image = 0.25 * renderer.render(CHESSBOARD, T, blur=3.0, noise=2.0, rng=np.random.default_rng(v)) + 40
        if corners := detect_board(np.rint(image).astype(np.uint8), CHESSBOARD):
            views.uv[0, v], views.covariance[0, v] = corners.uv, corners.covariance
    found = calibrate_cameras(views, CHESSBOARD)
    sigma = found.rig.sigmas[0].parameters
    assert np.abs(errors(found.rig, rig) / sigma).max() < 4.0
    assert sigma[0] < 0.005 * 700.0


@pytest.mark.no_cover
def test_lengths_are_as_well_known_as_the_board() -> None:
    views = seen(PAIR, CHESSBOARD, 14, 5)
    found = calibrate_cameras(views, CHESSBOARD.measured(8, 0.2424, 2.4e-4))
    assert found.rig.scale_sigma == pytest.approx(1e-3, rel=0.02)
    baseline = np.linalg.norm(found.rig.T_cam_world[1][:3, 3])
    assert baseline == pytest.approx(1.01 * np.linalg.norm(PAIR.T_cam_world[1][:3, 3]), rel=2e-3)
    assert not any("--measured" in text for text in found.warnings)
    assert any("--measured 8 " in text for text in calibrate_cameras(views, CHESSBOARD).warnings)
    # One camera alone has no lengths.
    single = seen(alone(PAIR.cameras[0]), CHESSBOARD, 14, 5)
    assert calibrate_cameras(single, CHESSBOARD.measured(8, 0.24, 2.4e-4)).rig.scale_sigma is None
    assert not any("--measured" in text for text in calibrate_cameras(single, CHESSBOARD).warnings)


def test_corners_that_are_no_boards_are_refused() -> None:
    views = seen(alone(PAIR.cameras[0]), CHESSBOARD, 10, 1)
    shuffled = np.random.default_rng(0).permuted(views.uv, axis=2)
    with pytest.raises(CameraError, match="camera 'left'"):
        calibrate_cameras(replace(views, uv=shuffled), CHESSBOARD)


def test_coverage_and_tilt_are_told() -> None:
    views = seen(alone(PAIR.cameras[0]), CHESSBOARD, 25, 2)
    found = calibrate_cameras(views, CHESSBOARD)
    quality = found.qualities[0]
    assert quality.covered.shape == (6, 8)
    cells = {(int(v // (512 / 6)), int(u // 80)) for u, v in (views.uv[0] + 0.5).reshape(-1, 2) if np.isfinite(u)}
    assert quality.coverage == pytest.approx(len(cells) / 48)
    assert len(quality.tilts) == len(quality.views) == len(quality.rms)
    assert 0.0 <= quality.tilts.min() < quality.tilts.max() <= 62.0
    left = np.where(views.uv[..., :1] < 300, views.uv, np.nan)
    halved = calibrate_cameras(replace(views, uv=left), CHESSBOARD)
    assert halved.qualities[0].coverage < 0.5
    assert any("Add images with the board at the right" in text for text in halved.warnings)


def test_a_fit_that_has_its_corners_exactly_stays_there() -> None:
    poses = np.stack(held(PAIR, CHESSBOARD, 6, np.random.default_rng(0)))
    bundle = Bundle(CHESSBOARD, PAIR.cameras, np.stack(PAIR.T_cam_world), poses)
    fitted = adjust(bundle, bundle.project(), np.zeros((2, 6, 54, 2, 2)))
    for got, expected in zip(fitted.bundle.cameras, PAIR.cameras, strict=True):
        np.testing.assert_allclose(got.parameters, expected.parameters, rtol=1e-8, atol=1e-8)


def test_pictures_are_found_in_natural_order_and_read(tmp_path: Path) -> None:
    renderer = BoardRenderer(PAIR.cameras[0])
    T = placed([0.3, 0.2, 0.0], [-0.1, -0.07, 0.6])
    image = renderer.render(CHESSBOARD, T)
    for camera in ("cam2", "cam10"):
        (tmp_path / camera).mkdir()
        for view in ("view10", "view9"):
            write_image(tmp_path / camera / f"{view}.png", image)
    (tmp_path / "cam2" / "notes.txt").write_text("no image")
    (tmp_path / "cam2" / "broken.png").write_bytes(b"no image")
    write_image(tmp_path / "cam10" / "small.png", image[:200])
    write_image(tmp_path / "cam10" / "empty.png", np.full_like(image, 90))
    (tmp_path / "empty").mkdir()
    assert {camera: list(found) for camera, found in find_images(tmp_path).items()} == {
        "cam2": ["broken", "view9", "view10"],
        "cam10": ["empty", "small", "view9", "view10"],
    }
    steps: list[int] = []
    views = read_views(tmp_path, CHESSBOARD, steps.append)
    assert sum(steps) == 7
    assert views.cameras == ("cam2", "cam10")
    assert views.resolutions == (SIZE, SIZE)
    assert views.views == ("broken", "empty", "small", "view9", "view10")
    assert np.isfinite(views.uv).all(axis=(2, 3)).tolist() == [[False, False, False, True, True]] * 2
    np.testing.assert_allclose(views.uv[1, 4], true_corners(PAIR, CHESSBOARD, T)[0], atol=0.02)
    reasons = {(r.camera, r.view): r.reason for r in views.rejected}
    assert reasons["cam2", "broken"] == "this is no image, or a damaged one"
    assert reasons["cam10", "small"] == "it has 640 x 200 pixels, the others 640 x 512"
    assert reasons["cam10", "empty"].startswith("no board is found in it")


def test_pictures_too_soft_for_their_squares_are_left_out_with_the_reason(tmp_path: Path) -> None:
    T = placed([0.3, 0.2, 0.0], [-0.1, -0.07, 0.9])
    for name, blur in (("sharp", 0.8), ("soft", 2.0), ("softer", 4.5)):
        write_image(tmp_path / f"{name}.png", BoardRenderer(PAIR.cameras[0]).render(CHESSBOARD, T, blur=blur))
    views = read_views(tmp_path, CHESSBOARD)
    (left_out,) = views.rejected
    with pytest.raises(CameraError, match=r"only 2 of its images can be used \(1 x it is too soft\)"):
        calibrate_cameras(views, CHESSBOARD)
    assert left_out.view == "softer"
    assert re.match(r"it is too soft: edges are blurred by 4\.\d px .*, squares 2\d px", left_out.reason)


def test_a_folder_of_pictures_is_one_camera(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", np.zeros((20, 30), np.uint8))
    assert list(find_images(tmp_path)) == ["cam0"]
    write_image(tmp_path / "a.tif.png", np.zeros((20, 30), np.uint8))
    (tmp_path / "a.jpg").write_bytes(b"")
    with pytest.raises(CameraError, match="are both called 'a'"):
        find_images(tmp_path)


def test_folders_without_pictures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="there are no images"):
        find_images(tmp_path)
    with pytest.raises(CameraError, match="there is no such folder"):
        find_images(tmp_path / "nowhere")
    (tmp_path / "cam0").mkdir()
    (tmp_path / "cam0" / "a.png").write_bytes(b"")
    with pytest.raises(CameraError, match="none of its files is an image"):
        read_views(tmp_path, CHESSBOARD)


def test_turns_are_rotations() -> None:
    np.testing.assert_allclose(turned([0, 0, 0.5 * np.pi]), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
