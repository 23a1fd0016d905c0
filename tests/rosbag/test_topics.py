from __future__ import annotations

from typing import Any

import pytest

from urdfcal.errors import SessionError
from urdfcal.rosbag.bag import CAMERA_INFO, COMPRESSED, IMAGE, JOINT_STATE, TRANSFORMS, Topic
from urdfcal.rosbag.topics import choose_topics

NOTHING: dict[str, Any] = {}
PAIR = {
    "/joint_states": JOINT_STATE,
    "/left/image_raw": IMAGE,
    "/left/camera_info": CAMERA_INFO,
    "/right/image_raw/compressed": COMPRESSED,
    "/right/camera_info": CAMERA_INFO,
    "/tf": TRANSFORMS,
}


def topics(of: dict[str, str], empty: tuple[str, ...] = ()) -> list[Topic]:
    return [Topic(name, type_, 0 if name in empty else 10) for name, type_ in sorted(of.items())]


def test_a_pair_is_found_by_its_types() -> None:
    chosen = choose_topics(topics(PAIR), **NOTHING)
    assert chosen.joints == "/joint_states"
    assert list(chosen.cameras.items()) == [
        ("left", ("/left/image_raw", "/left/camera_info")),
        ("right", ("/right/image_raw/compressed", "/right/camera_info")),
    ]
    assert set(chosen.names) == PAIR.keys() - {"/tf"}


@pytest.mark.parametrize(
    ("spaces", "names"),
    [
        (["/cam10", "/cam2"], ["cam2", "cam10"]),
        (["/stereo/left", "/stereo/right"], ["left", "right"]),
        (["/a/camera", "/b/camera"], ["a_camera", "b_camera"]),
        ([""], ["camera"]),
    ],
)
def test_cameras_are_called_by_their_namespaces(spaces: list[str], names: list[str]) -> None:
    of = {"/j": JOINT_STATE}
    for space in spaces:
        of |= {f"{space}/image": IMAGE, f"{space}/camera_info": CAMERA_INFO}
    assert list(choose_topics(topics(of), **NOTHING).cameras) == names


def test_what_is_named_is_used_and_nothing_else() -> None:
    of = PAIR | {"/other/joint_states": JOINT_STATE, "/left/image_mono": IMAGE, "/my_info": CAMERA_INFO}
    cameras = {"b": ("/right/image_raw/compressed", None), "a": ("/left/image_raw", "/my_info")}
    chosen = choose_topics(topics(of), "/joint_states", cameras)
    assert chosen.joints == "/joint_states"
    assert list(chosen.cameras.items()) == [
        ("b", ("/right/image_raw/compressed", "/right/camera_info")),
        ("a", ("/left/image_raw", "/my_info")),
    ]


def test_cameras_described_elsewhere_need_no_info() -> None:
    of = {name: type_ for name, type_ in PAIR.items() if type_ != CAMERA_INFO} | {"/third/image_rect": IMAGE}
    chosen = choose_topics(topics(of), infos=False)
    assert [(name, info) for name, (_, info) in chosen.cameras.items()] == [
        ("left", None),
        ("right", None),
        ("third", None),
    ]


@pytest.mark.parametrize(
    ("more", "without", "options", "message"),
    [
        (
            {},
            ["/joint_states"],
            NOTHING,
            r"no joint states.*The topics are: /left/camera_info \(sensor_msgs/msg/Cam",
        ),
        ({"/b": JOINT_STATE}, [], NOTHING, "2 topics with joint states: /b, /joint_states. Use --joints /b"),
        ({}, [], {"joints": "/joint_state"}, "no topic '/joint_state'. Did you mean '/joint_states'"),
        ({}, [], {"joints": "/tf"}, "'/tf' is tf2_msgs/msg/TFMessage, not JointState"),
        (
            {"/left/image_raw/compressed": COMPRESSED},
            [],
            NOTHING,
            r"2 topics with images in /left.*--camera NAME=",
        ),
        (
            {},
            ["/left/camera_info"],
            NOTHING,
            r"/left/image_raw has no /left/camera_info.*--cameras FILE.*left=/left",
        ),
        (
            {"/left/image_rect": IMAGE},
            ["/left/image_raw"],
            NOTHING,
            "/left/image_rect is rectified, /left/camera_info describes",
        ),
        ({}, ["/left/image_raw", "/right/image_raw/compressed"], NOTHING, "there are no images"),
        (
            {"/left/image_rect": IMAGE},
            [],
            {"cameras": {"a": ("/left/image_rect", "/left/camera_info")}},
            "/left/image_rect is rectified",
        ),
        (
            {},
            [],
            {"cameras": {"a": ("/left/image_raw", None), "b": ("/left/image_raw", None)}},
            "two cameras have the same images",
        ),
        (
            {"/camera/image": IMAGE, "/image": IMAGE},
            [],
            {"infos": False},
            "cannot be named after their namespaces.*--camera NAME=",
        ),
        (
            {},
            [],
            {"cameras": {"x": ("/tf", None)}},
            "'/tf' is tf2_msgs/msg/TFMessage, not Image or CompressedImage",
        ),
        ({}, [], {"cameras": {"x": ("/left/image_raw", "/tf")}}, "'/tf' is .*, not CameraInfo"),
    ],
)
def test_an_open_choice_is_left_to_the_user(
    more: dict[str, str], without: list[str], options: dict[str, Any], message: str
) -> None:
    of = {name: type_ for name, type_ in (PAIR | more).items() if name not in without}
    with pytest.raises(SessionError, match=message):
        choose_topics(topics(of), **options)


def test_topics_without_messages_are_not_there() -> None:
    of = PAIR | {"/b": JOINT_STATE, "/left/image_mono": IMAGE}
    assert choose_topics(topics(of, ("/b", "/left/image_mono")), **NOTHING).joints == "/joint_states"


@pytest.mark.parametrize("name", ["..", ".", ".hidden", "a/b", "a\\b", "/etc", "", "a\n", "-o", "a\0b"])
def test_a_camera_is_never_called_by_a_path(name: str) -> None:
    with pytest.raises(SessionError, match="cannot be that of a folder"):
        choose_topics(topics(PAIR), cameras={name: ("/left/image_raw", None)})


def test_a_namespace_is_never_a_path() -> None:
    of = {"/j": JOINT_STATE, "/a/../image": IMAGE, "/a/../camera_info": CAMERA_INFO}
    with pytest.raises(SessionError, match=r"'\.\.' cannot be that of a folder.*--camera NAME=/a/\.\./image"):
        choose_topics(topics(of), **NOTHING)
