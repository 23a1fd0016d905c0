from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml

from urdfcal.errors import OutputError, SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_positions, read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.writing import write_session
from urdfcal.simulation.simulate import write_simulated

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.session.rig_description import RigDescription

TARGETS = """
board: {kind: charuco, size: [5, 7], square: 0.036, marker: 0.018, dictionary: DICT_6X6_250, legacy: true, link: tool0}
chess: {kind: chessboard, size: [9, 6], square: 0.03, link: world, scale: {sigma: 0.002}, flatness: 0.0005}
dots: {kind: circles, size: [4, 3], spacing: 0.02}
shifted: {kind: acircles, size: [4, 11], spacing: 0.02, position: [0.1, 0, 0], rpy: [0, 0.1, 3.0]}
tags: {kind: apriltag, family: tag36h11, size: 0.04, tags: {0: , 7: {position: [0.1, 0, 0.02], rpy: [0, 1.5, 0]}}}
one: {kind: aruco, dictionary: DICT_4X4_50, size: 0.05, tags: {3: }, position: [0, 0, 0], rpy: [0, 0, 0], sigma: [0, 0]}
body: {kind: dots, dots: [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.05]]}
probe: {kind: frame, link: forearm_link}
"""


def rig_with(tmp_path: Path, targets: str, **changes: object) -> Path:
    source = find_rig("ur5")
    (tmp_path / "cameras.yaml").write_bytes((source / "cameras.yaml").read_bytes())
    content = yaml.safe_load((source / "rig.yaml").read_text())
    content |= {"targets": yaml.safe_load(targets), **changes}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return tmp_path


def test_every_kind_is_read_with_its_points(tmp_path: Path) -> None:
    rig = read_rig(rig_with(tmp_path, TARGETS))
    by_name = {target.name: target for target in rig.targets}
    counts = {"board": 24, "chess": 54, "dots": 12, "shifted": 44, "tags": 8, "one": 4, "body": 3, "probe": 0}
    assert {name: len(target.points) for name, target in by_name.items()} == counts
    assert rig.led_names[:3] == ("led", "board:0", "board:1")
    assert by_name["tags"].point_names == tuple(f"tags:{tag}.{corner}" for tag in (0, 7) for corner in range(4))
    np.testing.assert_allclose(by_name["board"].points[5], [0.036, 0.036, 0.0])
    np.testing.assert_allclose(by_name["shifted"].points[[1, 4]], [[0.04, 0.0, 0.0], [0.02, 0.02, 0.0]])
    # Clockwise from the top left, as the print is looked at: x right, y down.
    np.testing.assert_allclose(by_name["one"].points[:, :2], 0.025 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))
    np.testing.assert_allclose(np.linalg.norm(by_name["tags"].points[4:] - [0.1, 0, 0.02], axis=1), 0.02 * np.sqrt(2))
    frames = rig.attachments
    assert frames.frames[:3] == ("world", "tool0", "forearm_link")
    assert [frames.frames[carrier] for _, carrier in frames.carried] == [
        "tool0", "world", "tool0", "tool0", "tool0", "tool0", "tool0", "forearm_link",
    ]  # fmt: skip
    assert np.bincount(frames.led).tolist() == [0, 1, 0, 24, 54, 12, 44, 8, 4, 3]
    np.testing.assert_array_equal(by_name["one"].sigma, np.zeros(6))


def same_targets(a: RigDescription, b: RigDescription) -> None:
    for one, other in zip(a.targets, b.targets, strict=True):
        assert (one.name, one.link, one.scale_sigma) == (other.name, other.link, other.scale_sigma)
        assert one.flatness == other.flatness
        assert one.point_names == other.point_names
        np.testing.assert_array_equal(one.points, other.points)
        for name in ("T_link_target", "sigma"):
            value, written = getattr(one, name), getattr(other, name)
            assert (value is None) == (written is None), name
            if value is not None:
                np.testing.assert_allclose(value, written, rtol=0.0, atol=1e-15)


def test_a_session_of_every_kind_reads_back_as_it_was_written(tmp_path: Path, simulated: Callable) -> None:
    rig = read_rig(rig_with(tmp_path, TARGETS))
    session = simulated("ur5", poses=5).session
    full = replace(session, chain=rig.chain, targets=rig.targets)
    write_session(tmp_path / "out", full)
    same_targets(read_positions(tmp_path / "out"), rig)


def test_a_session_of_a_target_alone_reads_back(tmp_path: Path, simulated: Callable) -> None:
    data = simulated("panda_handeye", poses=6)
    write_simulated(tmp_path / "s", data)
    found = read_session(tmp_path / "s")
    assert not found.leds
    same_targets(found, data.session)
    for name in ("uv", "led", "sigma"):
        np.testing.assert_array_equal(
            getattr(found.find(Detections), name), getattr(data.session.find(Detections), name), name
        )


def test_a_pose_known_unevenly_cannot_be_written(tmp_path: Path, simulated: Callable) -> None:
    session = simulated("ur5_charuco", poses=5).session
    (target,) = session.targets
    with pytest.raises(OutputError, match="target 'board': the standard deviations of its place differ by direction"):
        write_session(tmp_path / "s", replace(session, targets=(replace(target, sigma=np.arange(1.0, 7.0)),)))


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (
            "{kind: charucco, size: [5, 7]}",
            r"rig\.yaml:\d+:\d+, key 'targets\.x': the key 'kind' is missing, or none of",
        ),
        ("{size: [5, 7]}", "the key 'kind' is missing, or none of charuco, chessboard"),
        ("{kind: chessboard, size: [9, 6], square: 0.03, marker: 0.02}", r"'targets\.x\.marker': unknown key 'marker'"),
        ("{kind: chessboard, size: [9, 6]}", r"'targets\.x\.square': the key 'square' is missing.*kind, link.*square"),
        ("{kind: chessboard, size: [9, 6.5], square: 0.03}", r"'targets\.x\.size\.1'"),
        ("{kind: chessboard, size: [9, 6], square: 30}", "a square of 30 m is no board's.*in metres"),
        ("{kind: chessboard, size: [2, 6], square: 0.03}", r"'targets\.x': .*has 2 x 6 inner corners"),
        ("{kind: circles, size: [9, 6], spacing: 30}", "spacing is 30 m.*in metres"),
        ("{kind: circles, size: [9, 1], spacing: 0.03}", "a grid of 9 x 1 dots is a line"),
        ("{kind: charuco, size: [5, 7], square: 0.03, marker: 0.02, dictionary: DICT_X}", "dictionary 'DICT_X' is not"),
        ("{kind: aruco, size: 0.03, tags: {0: {}}, dictionary: DICT_X}", "no dictionary 'DICT_X'.*DICT_4X4_50"),
        ("{kind: aruco, size: 0.03, tags: {50: {}}, dictionary: DICT_4X4_50}", "no tag 50.*holds 0 to 49"),
        ("{kind: aruco, size: 0.03, tags: {a: {}}, dictionary: DICT_4X4_50}", "'a' is no number of a tag"),
        ("{kind: aruco, size: 0.03, tags: {}, dictionary: DICT_4X4_50}", "it names no tag"),
        ("{kind: apriltag, size: 0.03, tags: {0: {}}, family: 36h11}", "family is '36h11'.*tag36h11"),
        ("{kind: frame, sigma: [0.1, 0.1]}", "sigma is given without a position"),
        ("{kind: frame, position: [0, 0, 0]}", "position and rpy are given together"),
        ("{kind: frame, flatness: 0.001}", "a body without points cannot be bent.*Leave flatness out"),
        ("{kind: frame, link: nose}", r"'targets\.x'.*no link 'nose'"),
        ("{kind: dots, dots: []}", r"'targets\.x\.dots'"),
    ],
)
def test_what_is_wrong_with_a_target_is_said_where_it_stands(tmp_path: Path, target: str, message: str) -> None:
    with pytest.raises(SessionError, match=message):
        read_rig(rig_with(tmp_path, f"x: {target}"))


def test_there_must_be_something_to_see(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="there is neither an LED nor a target"):
        read_rig(rig_with(tmp_path, "{}", leds={}))


def test_the_session_s_scale_is_that_of_prints_that_say_none(tmp_path: Path) -> None:
    own = "{kind: chessboard, size: [9, 6], square: 0.03, scale: {sigma: 0.001}}"
    rig = read_rig(rig_with(tmp_path, f"a: {own}\nb: {{kind: frame}}", scale={"sigma": 0.004}))
    assert [target.scale_sigma for target in rig.targets] == [0.001, 0.004]


def test_millimetres_are_told(tmp_path: Path, simulated: Callable) -> None:
    write_simulated(tmp_path / "s", simulated("ur5_charuco", poses=5))
    text = (tmp_path / "s" / "session.yaml").read_text()
    content = yaml.safe_load(text)
    content["targets"]["board"]["position"] = [-54.0, 90.0, 12.0]
    (tmp_path / "s" / "session.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(SessionError, match=r"'targets\.board\.position'.*from the tip looks like millimetres"):
        read_session(tmp_path / "s")
