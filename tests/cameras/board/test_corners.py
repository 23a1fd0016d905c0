from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.cameras.board.boards import CHARUCO, CHESSBOARD, PAIR, SIZE, held, placed, true_corners
from tests.cameras.board.rendering import BoardRenderer
from urdfcal.cameras.board.board import Board
from urdfcal.cameras.board.corners import refine
from urdfcal.cameras.board.detection import detect_board, what_is_seen
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.rig import Rig

LEFT = Rig(PAIR.cameras[:1], (np.eye(4),))
LENS = BoardRenderer(PAIR.cameras[0])


def images(board: Board, count: int, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses of boards wholly in view, with their true corners."""
    # Markers are read where a module is three pixels wide.
    poses = held(LEFT, board, 4 * count, np.random.default_rng(seed), far=0.9 if board.kind == "chessboard" else 0.55)
    found = [(T, true_corners(LEFT, board, T)[0]) for T in poses]
    return [(T, uv) for T, uv in found if np.isfinite(uv).all()][:count]


@pytest.mark.no_cover
def test_a_picture_does_not_depend_on_its_sampling() -> None:
    T, _ = images(CHARUCO, 1)[0]
    coarse = LENS.render(CHARUCO, T, blur=1.0).astype(float)
    fine = BoardRenderer(PAIR.cameras[0], 4).render(CHARUCO, T, blur=1.0).astype(float)
    assert np.ptp(coarse) > 150
    assert np.quantile(np.abs(coarse - fine), 0.999) <= 4
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.5


def test_a_board_half_out_of_the_picture_behind_or_beside_the_camera_is_no_trouble() -> None:
    wall = LENS.render(CHESSBOARD, placed([0, 0, 0], [0, 0, -0.5]))
    assert np.ptp(wall) == 0
    assert np.ptp(LENS.render(CHESSBOARD, placed([0, 0, 0], [5.0, 0, 0.5]))) == 0
    half = LENS.render(CHESSBOARD, placed([0, 0.3, 0], [0.1, 0, 0.5]))
    assert 0.05 < np.mean(half != wall) < 0.9
    across = LENS.render(CHESSBOARD, placed([0, 1.4, 0], [0, 0, 0.1]))
    assert across.shape == (512, 640)


@pytest.mark.no_cover
@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_corners_are_found_without_bias_and_better_than_by_opencv(board: Board) -> None:
    import cv2

    rng = np.random.default_rng(1)
    errors, theirs, blurs = [], [], []
    for T, uv in images(board, 5):
        image = LENS.render(board, T, blur=0.8, noise=2.0, rng=rng)
        corners = detect_board(image, board)
        assert corners.found.sum() >= 0.9 * len(uv)
        errors.append((corners.uv - uv)[corners.found])
        start = uv[corners.found].astype(np.float32).reshape(-1, 1, 2).copy()
        theirs.append(cv2.cornerSubPix(image, start, (4, 4), (-1, -1), (3, 50, 1e-3))[:, 0] - uv[corners.found])
        blurs.append(corners.blur[corners.found])
    error, blur = np.concatenate(errors), np.concatenate(blurs)
    rms = np.sqrt(np.mean(error**2))
    assert rms < 0.015
    assert rms < 0.6 * np.sqrt(np.mean(np.concatenate(theirs) ** 2))
    assert np.abs(error.mean(axis=0)).max() < 4.0 * rms / np.sqrt(len(error))
    # 0.8 px of blur, and the pixel's own width: sqrt(1 / 12)
    assert np.median(blur) == pytest.approx(np.hypot(0.8, 1 / np.sqrt(12)), abs=0.03)


def test_without_noise_corners_are_right_to_a_few_thousandths_at_any_blur() -> None:
    T, uv = images(CHESSBOARD, 1, seed=3)[0]
    for blur in (0.6, 1.2, 2.0):
        image = LENS.render(CHESSBOARD, T, blur=blur)
        corners = refine(image, CHESSBOARD, uv + np.random.default_rng(0).uniform(-0.5, 0.5, uv.shape))
        assert corners.found.all()
        assert np.sqrt(np.mean((corners.uv - uv) ** 2)) < 0.006
    bright = np.clip(255.0 * (image / 255.0) ** 0.45, 0, 255)  # a tone curve moves no corner
    assert np.sqrt(np.mean((refine(bright, CHESSBOARD, uv).uv - uv) ** 2)) < 0.006


def test_motion_shows_as_blur() -> None:
    T, uv = images(CHESSBOARD, 1, seed=4)[0]
    still, moved = (refine(LENS.render(CHESSBOARD, T, smear=s), CHESSBOARD, uv) for s in ((0.0, 0.0), (7.0, 2.0)))
    assert np.nanmedian(moved.blur) > 2.0 * np.nanmedian(still.blur)
    # and is no bias: the corner of the mean position
    assert np.abs(np.nanmean(moved.uv - uv, axis=0)).max() < 0.02


def test_depth_and_colour_do_not_matter() -> None:
    T, uv = images(CHARUCO, 1)[0]
    image = LENS.render(CHARUCO, T)
    eight = detect_board(image, CHARUCO)
    twelve = detect_board(image.astype(np.uint16) * 16 + 5, CHARUCO)
    coloured = detect_board(np.stack([image // 2 + 40, image, image // 3], axis=-1), CHARUCO)
    for other in (twelve, coloured):
        assert (other.found == eight.found).mean() > 0.9
        assert np.nanmax(np.abs(other.uv - eight.uv)) < 0.02
    assert np.nanmax(np.abs(eight.uv - uv)) < 0.03


def test_a_charuco_board_may_be_cut_and_keeps_its_numbers() -> None:
    T, uv = images(CHARUCO, 1)[0]
    image = LENS.render(CHARUCO, T)
    middle = int(uv[:, 0].mean())
    image[:, middle:] = 90
    corners = detect_board(image, CHARUCO)
    assert 10 < corners.found.sum() < 40
    assert (uv[corners.found, 0] < middle).all()
    assert np.nanmax(np.abs(corners.uv - uv)) < 0.05


@pytest.mark.parametrize("turn", [0.0, 0.5, 1.0, -0.5])
def test_a_chessboard_is_read_the_same_way_around_however_it_is_held(turn: float) -> None:
    T = placed([0.2, -0.3, 0.0], [0.0, 0.0, 0.6]) @ placed([0.0, 0.0, turn * np.pi], [0.0, 0.0, 0.0])
    T[:3, 3] -= T[:3, :3] @ CHESSBOARD.corners.mean(0)
    uv = true_corners(LEFT, CHESSBOARD, T)[0]
    corners = detect_board(LENS.render(CHESSBOARD, T), CHESSBOARD)
    assert np.nanmax(np.abs(corners.uv - uv)) < 0.03


@pytest.mark.parametrize("shape", [(8, 6), (7, 7), (6, 6)])
def test_a_board_that_looks_the_same_from_several_sides_is_read_in_one_of_its_orders(shape: tuple[int, int]) -> None:
    board = Board("chessboard", *shape, 0.03)
    for turn in (0.1, 1.7, 3.2):
        T = placed([0.0, 0.0, turn], [0.0, 0.0, 0.6])
        T[:3, 3] -= T[:3, :3] @ board.corners.mean(0)
        uv = true_corners(LEFT, board, T)[0]
        corners = detect_board(LENS.render(board, T), board)
        assert min(np.nanmax(np.abs(corners.uv - uv[order])) for order in board.symmetries) < 0.05


@pytest.mark.parametrize(("blur", "noise", "contrast"), [(0.8, 2.0, 1.0), (0.8, 3.0, 0.15), (3.0, 2.0, 0.25)])
def test_corners_know_their_covariance(blur: float, noise: float, contrast: float) -> None:
    rng = np.random.default_rng(3)
    chi2 = []
    for T, uv in images(CHESSBOARD, 4):
        image = contrast * LENS.render(CHESSBOARD, T, blur=blur).astype(float)
        corners = refine(image + 20 + rng.normal(0.0, noise, image.shape), CHESSBOARD, uv)
        assert corners.found.mean() > 0.95
        error, covariance = (corners.uv - uv)[corners.found], corners.covariance[corners.found]
        chi2.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))
    assert 1.3 < np.concatenate(chi2).mean() < 2.6


def test_a_soft_corner_is_found_where_its_blur_is_wider_than_the_window() -> None:
    T, uv = images(CHESSBOARD, 1, seed=3)[0]
    corners = refine(LENS.render(CHESSBOARD, T, blur=5.0, noise=1.0, rng=np.random.default_rng(0)), CHESSBOARD, uv)
    assert corners.found.mean() > 0.8
    assert np.sqrt(np.nanmean((corners.uv - uv) ** 2)) < 0.05


def spoilt(board: Board, T: np.ndarray, quality: int = 30) -> np.ndarray:
    """A picture blurred by 3 px, of a quarter of the contrast, and compressed."""
    import cv2

    image = LENS.render(board, T, blur=3.0, noise=2.0, rng=np.random.default_rng(0))
    dim = np.rint(0.25 * image + 30).astype(np.uint8)
    return cv2.imdecode(cv2.imencode(".jpg", dim, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_UNCHANGED)


def test_boards_are_found_in_soft_dim_compressed_and_small_pictures() -> None:
    import cv2

    for T, uv in images(CHESSBOARD, 3, seed=2):
        corners = detect_board(spoilt(CHESSBOARD, T), CHESSBOARD)
        assert corners.found.mean() > 0.9
        assert np.sqrt(np.nanmean((corners.uv - uv) ** 2)) < 0.4
        small = cv2.resize(LENS.render(CHESSBOARD, T), None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
        corners = detect_board(small, CHESSBOARD)
        assert np.nanmax(np.abs(corners.uv - (0.4 * (uv + 0.5) - 0.5))) < 0.1


def test_one_detector_after_the_other_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    import cv2

    T, uv = images(CHESSBOARD, 1)[0]
    image = LENS.render(CHESSBOARD, T)
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_, **__: (False, None))
    assert np.nanmax(np.abs(detect_board(image, CHESSBOARD).uv - uv)) < 0.03


@pytest.mark.parametrize("shape", [(8, 6), (9, 5), (11, 8)])
def test_another_size_is_named_and_no_part_of_it_taken(shape: tuple[int, int]) -> None:
    other = Board("chessboard", *shape, 0.03)
    T, _ = images(CHESSBOARD, 1)[0]
    image = LENS.render(CHESSBOARD, T, noise=2.0, rng=np.random.default_rng(0))
    assert detect_board(image, other) is None
    expected = f"a board of 9 x 6 inner corners was found, {shape[0]} x {shape[1]} asked for"
    assert what_is_seen(image, other) == expected


def test_another_kind_of_board_is_named() -> None:
    T = images(CHARUCO, 1)[0][0]
    image = LENS.render(CHARUCO, T)
    for other, expected in (
        (
            Board("charuco", 10, 7, 0.03, 0.022, "DICT_4X4_50"),
            "markers of DICT_5X5 up to number 34 were found, DICT_4X4",
        ),
        (
            Board("charuco", 9, 7, 0.03, 0.022, "DICT_5X5_100"),
            "a board 10 squares wide and 7 or more high were found, 9 x",
        ),
        (CHESSBOARD, "markers of DICT_5X5 up to number 34 were found, a chessboard asked for"),
    ):
        assert detect_board(image, other) is None
        assert expected in what_is_seen(image, other)
    chess = LENS.render(CHESSBOARD, images(CHESSBOARD, 1)[0][0])
    assert what_is_seen(chess, CHARUCO) == "a chessboard of 9 x 6 inner corners was found, a ChArUco board asked for"
    assert what_is_seen(np.full_like(chess, 90), CHARUCO) == "no board is found in it"


def test_boards_of_old_printers_are_told_and_read() -> None:
    import cv2

    old = Board("charuco", 8, 6, 0.03, 0.022, "DICT_5X5_100", legacy=True)
    image = cv2.GaussianBlur(old.to_opencv().generateImage((560, 430), marginSize=30), (0, 0), 0.8)
    assert detect_board(image, old).found.mean() > 0.9
    new = replace(old, legacy=False)
    assert detect_board(image, new) is None
    assert what_is_seen(image, new) == "its first square holds a marker: legacy: true"


def test_where_there_is_no_board_none_is_found() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, SIZE[::-1]).astype(np.uint8)
    flat = np.full(SIZE[::-1], 90, np.uint8)
    for image in (noise, flat):
        for board in (CHESSBOARD, CHARUCO):
            assert detect_board(image, board) is None
    other = LENS.render(Board("chessboard", 7, 5, 0.03), images(CHESSBOARD, 1)[0][0])
    assert detect_board(other, CHESSBOARD) is None


def test_corners_at_the_border_and_on_tiny_boards_are_left_out() -> None:
    camera = Camera("small", SIZE, [700.0, 700.0, 320.0, 256.0])
    T = placed([0, 0, 0], [-0.12, -0.075, 8.0])
    rig = Rig((camera,), (np.eye(4),))
    uv = true_corners(rig, CHESSBOARD, T)[0]
    assert not refine(BoardRenderer(camera).render(CHESSBOARD, T), CHESSBOARD, uv).found.any()
    T, uv = images(CHESSBOARD, 1)[0]
    shifted = uv - uv.min(axis=0)
    assert not refine(LENS.render(CHESSBOARD, T), CHESSBOARD, shifted).found.all()
