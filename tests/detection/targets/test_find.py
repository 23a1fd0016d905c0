"""Targets of every kind in pictures: where their points are, how surely, and why there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from urdfcal.cameras.camera import Camera
from urdfcal.detection.targets.alternatives import another_board, other_print
from urdfcal.detection.targets.find import Found, find_target
from urdfcal.rotations import rpy_to_matrix
from urdfcal.session.pattern import (
    AprilTagPattern,
    ArucoPattern,
    AsymmetricCirclesPattern,
    CharucoPattern,
    ChessboardPattern,
    CirclesPattern,
    Pattern,
    TagPlace,
)
from urdfcal.session.target import Target
from urdfcal.simulation.prints import PlacedPrint, PrintRenderer, prints_of

CAMERA = Camera("cam", (640, 512), (900.0, 905.0, 320.0, 250.0), "radtan", (-0.1, 0.08, 0.0004, -0.0003))
CORNER = TagPlace(np.array([0.12, 0.0, 0.03]), np.array([0.0, -0.7, 0.3]))
PATTERNS = {
    "charuco": CharucoPattern((5, 7), 0.03, 0.022, "DICT_5X5_100"),
    "legacy": CharucoPattern((5, 6), 0.03, 0.022, "DICT_4X4_50", legacy=True),
    "chessboard": ChessboardPattern((7, 4), 0.03),
    "circles": CirclesPattern((6, 5), 0.03),
    "acircles": AsymmetricCirclesPattern((4, 9), 0.022),
    "apriltag": AprilTagPattern(0.1, {3: TagPlace()}, "tag36h11"),
    "bundle": ArucoPattern(0.08, {3: TagPlace(), 7: CORNER}, "DICT_4X4_50"),
}
RENDERER = PrintRenderer(CAMERA)


def place(pattern: Pattern, rng: np.random.Generator, distance: float = 0.55) -> np.ndarray:
    """T_cam_target of a target in the middle of the picture, turned by up to half a radian."""
    points = np.array(list(pattern.points.values()))
    T = np.eye(4)
    T[:3, :3] = rpy_to_matrix(rng.uniform(-0.5, 0.5, 3))
    T[:3, 3] = np.array([*rng.uniform(-0.02, 0.02, 2), distance]) - T[:3, :3] @ points.mean(axis=0)
    return T


def picture(
    pattern: Pattern, T: np.ndarray, seed: int = 0, light: float = 1.0, noise: float = 1.5, **how: object
) -> np.ndarray:
    image = light * RENDERER.expected([PlacedPrint(T @ of, piece) for of, piece in prints_of(pattern)], **how)
    image = image + noise * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def truth(pattern: Pattern, T: np.ndarray) -> np.ndarray:
    points = np.array(list(pattern.points.values()))
    return CAMERA.project(points @ T[:3, :3].T + T[:3, 3])


@pytest.mark.no_cover
@pytest.mark.parametrize("name", PATTERNS)
def test_points_are_found_where_they_are_to_what_is_claimed(name: str) -> None:
    pattern, rng = PATTERNS[name], np.random.default_rng(1)
    off = []
    for seed in range(6):
        T = place(pattern, rng)
        found = find_target(picture(pattern, T, seed), Target("t", pattern), CAMERA)
        assert not found.reason
        assert found.seen > 0.9 * len(found.uv)
        true = truth(pattern, T)
        if name == "circles" and np.linalg.norm(found.uv[0] - true[0]) > 10.0:
            true = true[::-1]  # it looks the same turned around
        off.append((found.uv - true) / found.sigma[:, None])
        assert np.nanmax(np.abs(found.uv - true)) < 0.3
    off = np.concatenate(off)
    # Rendered to a thousandth of a pixel; what is claimed is within a factor of what is reached.
    assert 0.6 < np.sqrt(np.nanmean(off**2)) < 1.5
    assert np.all(np.abs(np.nanmean(off, axis=0)) < 0.4)


def test_a_board_that_is_cut_off_shows_the_rest() -> None:
    pattern = PATTERNS["charuco"]
    T = place(pattern, np.random.default_rng(2))
    T[0, 3] += 0.2
    uv = truth(pattern, T)
    inside = CAMERA.in_image(uv)
    assert 4 < inside.sum() < len(uv)
    found = find_target(picture(pattern, T), Target("t", pattern), CAMERA)
    seen = np.isfinite(found.uv[:, 0])
    assert 4 <= seen.sum() <= inside.sum()
    np.testing.assert_allclose(found.uv[seen], uv[seen], atol=0.1)


def test_a_small_board_is_found_enlarged() -> None:
    pattern = PATTERNS["charuco"]
    T = place(pattern, np.random.default_rng(3), distance=1.1)
    found = find_target(picture(pattern, T), Target("t", pattern), CAMERA)
    assert found.seen > 12
    np.testing.assert_allclose(found.uv, np.where(np.isnan(found.uv), np.nan, truth(pattern, T)), atol=0.15)


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ({"light": 0.02}, "the image is dark"),
        ({"light": 12.0}, "the image is overexposed"),
        ({"blur": 14.0}, "the image is blurred"),
    ],
)
def test_why_nothing_is_found_is_said(how: dict[str, float], reason: str) -> None:
    pattern = PATTERNS["charuco"]
    T = place(pattern, np.random.default_rng(4))
    found = find_target(picture(pattern, T, **how), Target("t", pattern), CAMERA)
    assert not found.seen
    assert reason in found.reason


@pytest.mark.parametrize(
    ("printed", "named", "what"),
    [
        (
            "charuco",
            CharucoPattern((5, 7), 0.03, 0.022, "DICT_4X4_50"),
            "markers of DICT_5X5 up to number 16 were found",
        ),
        ("charuco", CharucoPattern((7, 5), 0.03, 0.022, "DICT_5X5_100"), "markers as on a board 5 squares wide"),
        ("legacy", replace(PATTERNS["legacy"], legacy=False), "legacy: true"),
        ("chessboard", ChessboardPattern((6, 5), 0.03), "a board of 7 x 4 inner corners was found"),
        ("circles", CirclesPattern((5, 5), 0.03), " are found; is it that?"),
        ("bundle", ArucoPattern(0.08, {4: TagPlace()}, "DICT_4X4_50"), "markers 3, 7 of DICT_4X4_50 are seen, 4 of"),
        ("bundle", AprilTagPattern(0.08, {3: TagPlace()}, "tag36h11"), "markers 3, 7 of DICT_4X4_1000 are seen, 3 of"),
    ],
)
def test_another_print_is_named_by_what_is_seen(printed: str, named: Pattern, what: str) -> None:
    pattern, rng = PATTERNS[printed], np.random.default_rng(5)
    images = [(CAMERA, picture(pattern, place(pattern, rng), seed)) for seed in range(2)]
    seen = other_print(Target("t", named), images)
    assert what in seen.words
    assert seen.told


def test_three_pictures_of_another_board_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each takes seconds in which a chessboard is searched in vain; nothing that is recognized does not count."""
    none = Found(np.full((1, 2), np.nan), np.full(1, np.nan), "it is not found")
    monkeypatch.setattr("urdfcal.detection.targets.alternatives.find_target", lambda *_: none)
    rng, charuco, chess = np.random.default_rng(5), PATTERNS["charuco"], PATTERNS["chessboard"]
    markers, squares = (picture(of, place(of, rng)) for of in (charuco, chess))
    nothing, asked = np.full_like(markers, 90), Target("t", ChessboardPattern((5, 7), 0.03))

    def said(target: Target, *images: np.ndarray) -> tuple[str, int]:
        left = iter([(CAMERA, image) for image in images])
        return another_board(target, left), len(list(left))

    words = "markers of DICT_5X5 up to number 16 were found, a chessboard asked for"
    assert said(asked, markers, nothing, markers, markers, markers, markers) == (words, 2)
    smaller = Target("t", ChessboardPattern((6, 5), 0.03))
    assert said(smaller, squares, squares, squares)[0].startswith("a board of 7 x 4 inner corners was found")
    # What fits into the one that is asked for may be that, with a row or more out of view.
    assert said(asked, squares, squares, squares) == ("", 0)
    assert said(asked, markers, markers) == ("", 0)
    assert said(smaller, markers, squares, markers, markers) == ("", 2)
    # Other kinds are searched quickly, and may be out of view for long.
    assert said(Target("t", PATTERNS["circles"]), *[markers] * 4) == ("", 4)
    monkeypatch.undo()
    assert said(Target("t", chess), squares, markers) == ("", 1)


def test_points_that_are_not_the_target_s_are_refused() -> None:
    """Two tags of a bundle whose places are not as the session says."""
    pattern = PATTERNS["bundle"]
    moved = replace(pattern, tags={3: TagPlace(), 7: TagPlace(np.array([0.12, 0.08, 0.0]), np.zeros(3))})
    image = picture(pattern, place(pattern, np.random.default_rng(6)))
    assert "from where a target like this has its points" in find_target(image, Target("t", moved), CAMERA).reason


@pytest.mark.parametrize(
    ("pattern", "ambiguous"),
    [
        (ChessboardPattern((9, 6), 0.03), False),
        (ChessboardPattern((8, 6), 0.03), True),
        (ChessboardPattern((7, 5), 0.03), True),
        (PATTERNS["charuco"], False),
        (PATTERNS["circles"], True),
        (PATTERNS["acircles"], False),
        (AsymmetricCirclesPattern((4, 10), 0.02), True),
        (PATTERNS["apriltag"], False),
    ],
)
def test_what_looks_the_same_turned_around_is_known(pattern: Pattern, ambiguous: bool) -> None:
    assert (len(pattern.symmetries) > 1) == ambiguous
    for order in pattern.symmetries:  # each is the print turned
        at = np.array(list(pattern.points.values()))[:, :2]
        middle = at - at.mean(axis=0)
        turn = np.linalg.lstsq(middle, middle[order], rcond=None)[0]
        np.testing.assert_allclose(middle @ turn, middle[order], atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1.0)
    points = np.array(list(pattern.points.values()))[:, :2]
    turned = points.max(axis=0) + points.min(axis=0) - points
    alike = all(np.min(np.linalg.norm(points - p, axis=1)) < 1e-9 for p in turned)
    assert alike >= ambiguous  # colours and markers tell more than places do
