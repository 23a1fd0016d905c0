from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from urdfcal.cameras.board.board import Board, read_board
from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from pathlib import Path


def test_corners_run_row_by_row_from_the_origin() -> None:
    board = Board("chessboard", 4, 3, 0.02)
    assert board.corners.shape == (12, 3)
    np.testing.assert_allclose(board.corners[1], [0.02, 0.0, 0.0])
    np.testing.assert_allclose(board.corners[4], [0.0, 0.02, 0.0])
    np.testing.assert_allclose(board.corners[-1], [0.06, 0.04, 0.0])


def test_a_charuco_board_counts_squares_as_opencv_does() -> None:
    board = Board("charuco", 8, 5, 0.03, 0.02, "DICT_4X4_50")
    printed = np.asarray(board.to_opencv().getChessboardCorners())
    np.testing.assert_allclose(board.corners, printed - printed[0], atol=1e-7)


def colours(board: Board) -> np.ndarray:
    """Which of the four squares around every corner (N, 4) is black, going around."""
    across, down = board.shape
    j, i = np.indices((down, across)).reshape(2, -1)
    return np.stack([(i + j + k) % 2 == 0 for k in range(4)], axis=1)


@pytest.mark.parametrize(("columns", "rows", "count"), [(9, 6, 1), (8, 6, 2), (9, 7, 2), (6, 6, 4), (7, 7, 2)])
def test_a_board_looks_the_same_in_each_of_its_orders(columns: int, rows: int, count: int) -> None:
    board = Board("chessboard", columns, rows, 0.02)
    assert len(board.symmetries) == count
    np.testing.assert_array_equal(board.symmetries[0], np.arange(columns * rows))
    assert len({tuple(order) for order in board.symmetries}) == count
    xy = board.corners[:, :2]
    for order in board.symmetries:
        # The order is a turn of the board onto itself ...
        turn = np.linalg.lstsq(xy - xy.mean(0), xy[order] - xy.mean(0), rcond=None)[0]
        np.testing.assert_allclose(turn @ turn.T, np.eye(2), atol=1e-12)
        assert np.linalg.det(turn) > 0
        np.testing.assert_allclose((xy - xy.mean(0)) @ turn, xy[order] - xy.mean(0), atol=1e-12)
        # ... that puts black squares onto black ones: quarter turns shift the four squares around a corner.
        quarters = round(np.arctan2(turn[0, 1], turn[0, 0]) / (0.5 * np.pi))
        np.testing.assert_array_equal(colours(board)[order], np.roll(colours(board), quarters, axis=1))


def test_boards_are_read_from_their_file(tmp_path: Path) -> None:
    path = tmp_path / "board.yaml"
    path.write_text("type: chessboard\ncolumns: 9\nrows: 6\nsquare: 0.025\n")
    assert read_board(path) == Board("chessboard", 9, 6, 0.025)
    path.write_text(path.read_text() + "marker:\ndictionary: ~\n")
    assert read_board(path) == Board("chessboard", 9, 6, 0.025)
    path.write_text("{type: charuco, columns: 10, rows: 7, square: 0.025, marker: 0.018, dictionary: DICT_4X4_50}")
    assert read_board(path) == Board("charuco", 10, 7, 0.025, 0.018, "DICT_4X4_50")
    path.write_text(
        path.read_text().replace("}", ", legacy: true, measured: {squares: 8, length: 0.204, sigma: 2e-4}}")
    )
    board = read_board(path)
    assert board.legacy
    assert (board.square, board.marker) == pytest.approx((0.0255, 0.018 * 1.02))
    assert board.scale_sigma == pytest.approx(2e-4 / 0.204)


@pytest.mark.parametrize(
    ("measured", "message"),
    [
        ((12, 0.3, 1e-4), "12 squares of together 0.3 ± 0.0001 m cannot be measured on a chessboard 9 x 6"),
        ((8, 0.2, 0.3), "cannot be measured"),
        ((9, 0.2, 1e-4), r"9 squares of together 0.2 m are -11 % off squares of 0.025 m. Count the squares"),
    ],
)
def test_lengths_that_cannot_be_the_boards_are_refused(measured: tuple[int, float, float], message: str) -> None:
    with pytest.raises(CameraError, match=message):
        Board("chessboard", 9, 6, 0.025).measured(*measured)


GOOD = {"type": "charuco", "columns": 10, "rows": 7, "square": 0.03, "marker": 0.02, "dictionary": "DICT_4X4_50"}
BROKEN = {
    "type": ({"type": "dots"}, "board type 'dots' is not known. Use chessboard or charuco"),
    "small": ({"columns": 3}, "a 3 x 7 charuco has 2 x 6 inner corners. It needs at least 3 x 3"),
    "millimetres": ({"square": 25}, "a square of 25 m is no board's. Give its side in metres"),
    "negative": ({"square": -0.02}, "a square of -0.02 m"),
    "text": ({"square": "25mm"}, r"yaml:5:9 \(square\): '25mm' is not a finite .* Lengths are in metres"),
    "fraction": ({"rows": 6.5}, "rows 6.5 is not a whole number"),
    "true": ({"rows": True}, "'true' is not a finite number"),
    "nothing": ({"columns": None}, r"\(columns\): 'null' is not a finite number"),
    "marker in millimetres": ({"marker": "20 mm"}, r"\(marker\): '20 mm' is not a finite .* Lengths are in metres"),
    "large marker": ({"marker": 0.03}, "markers of 0.03 m do not fit into squares of 0.03 m"),
    "no dictionary": ({"dictionary": None}, "needs the side of its markers and their dictionary"),
    "unknown dictionary": ({"dictionary": "DICT_3X3"}, "dictionary 'DICT_3X3' is not known. OpenCV has: .*DICT_4X4_50"),
    "too many markers": ({"columns": 20}, "a 20 x 7 board has 70 markers, DICT_4X4_50 holds 50"),
    "chessboard with markers": ({"type": "chessboard"}, "a chessboard has no markers"),
    "legacy": ({"legacy": "perhaps"}, r"\(legacy\): legacy is 'perhaps', not true or false"),
    "measured": ({"measured": {"squares": 8}}, r"\(measured.length\): measured.length is missing|length is missing"),
    "unknown key": ({"colour": "red"}, "key 'colour' of a board is not known. Allowed: type, columns"),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), BROKEN.values(), ids=BROKEN.keys())
def test_what_is_no_board_is_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    import yaml

    path = tmp_path / "board.yaml"
    path.write_text(yaml.safe_dump(GOOD))
    read_board(path)
    path.write_text(yaml.safe_dump({**GOOD, **changes}))
    with pytest.raises(CameraError, match=message) as caught:
        read_board(path)
    assert str(caught.value).startswith(str(path))


def test_files_that_are_no_boards_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "board.yaml"
    with pytest.raises(CameraError, match="cannot be read: No such file"):
        read_board(path)
    for text, message in (
        ("[1, 2]", "the keys type, columns, .* are expected here"),
        ("a: [", "this is not YAML"),
        ("", "the file holds nothing"),
        ("type: chessboard", r"\(columns\): columns is missing"),
    ):
        path.write_text(text)
        with pytest.raises(CameraError, match=message):
            read_board(path)
