from __future__ import annotations

import pickle
import random
import tracemalloc
from math import inf

import numpy as np
import pinocchio as pin
import pytest

from urdfcal.errors import RobotError
from urdfcal.robot.urdf.markup import MAX_BYTES
from urdfcal.robot.urdf.urdf import Mimic, Urdf, package_roots

EXAMPLES = sorted((package_roots()[-1] / "example-robot-data" / "robots").rglob("*.urdf"))
V1_2 = 'name="r" version="1.2"'
LIMIT = '<limit lower="-1" upper="2" effort="3" velocity="4"/>'


def joint(inside: str = LIMIT, name: str = "j", kind: str = "revolute", parent: str = "a", child: str = "b") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def robot(inside: str, links: str = "ab", attributes: str = 'name="r"') -> str:
    bodies = "".join(f'<link name="{link}"/>' for link in links)
    return f"<robot {attributes}>{bodies}{inside}</robot>"


def read(text: str | bytes) -> Urdf:
    return Urdf.parse(text.encode() if isinstance(text, str) else text)


def pinocchio_refuses(text: str) -> bool:
    try:
        pin.buildModelFromXML(text)
    except ValueError:
        return True
    return False


# --- every robot of example-robot-data


def test_example_robot_data_is_all_there():
    assert len(EXAMPLES) == 69


def test_the_one_file_that_pinocchio_cannot_load_is_reported():
    broken = [path for path in EXAMPLES if path.name == "ur3.urdf"]
    with pytest.raises(RobotError, match=r"ur3\.urdf:6: <robot> has no name"):
        Urdf.read(broken[0])


@pytest.mark.parametrize("path", [path for path in EXAMPLES if path.name != "ur3.urdf"], ids=lambda path: path.stem)
def test_joints_are_where_pinocchio_has_them(path):
    urdf = Urdf.read(path)
    model = pin.buildModelFromUrdf(str(path))
    frames = {(frame.name, frame.type): frame for frame in model.frames}
    assert urdf.name == model.name
    assert urdf.data == path.read_bytes()
    movable = set()
    for joint in urdf.joints.values():
        parent = frames[joint.parent, pin.FrameType.BODY].placement.homogeneous
        if joint.type == "fixed":
            child = frames[joint.name, pin.FrameType.FIXED_JOINT].placement.homogeneous
        else:
            movable.add(joint.name)
            child = model.jointPlacements[model.getJointId(joint.name)].homogeneous
        assert np.allclose(parent @ joint.T_parent_joint, child, rtol=0, atol=2e-15)
    assert movable == set(model.names) - {"universe", "root_joint"}
    assert frames[urdf.root, pin.FrameType.BODY].parentJoint == 0


@pytest.mark.parametrize("name", ["ur5_robot", "panda", "tiago", "so101", "TwoDofs"])
def test_axes_and_limits_are_pinocchios(name):
    (path,) = [path for path in EXAMPLES if path.stem == name]
    urdf = Urdf.read(path)
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    for index in range(1, model.njoints):
        joint, kind = urdf.joints[model.names[index]], model.joints[index]
        subspace = np.asarray(data.joints[index].S).ravel()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        half = slice(0, 3) if joint.type == "prismatic" else slice(3, 6)
        assert np.allclose(subspace[half], joint.axis, rtol=0, atol=1e-15)
        if joint.type != "continuous":
            assert model.lowerPositionLimit[kind.idx_q] == joint.lower
            assert model.upperPositionLimit[kind.idx_q] == joint.upper


# --- what a joint says


def test_defaults():
    found = read(robot(joint('<axis/><limit effort="1" velocity="1"/><mimic joint="j"/>'))).joints["j"]
    assert np.array_equal(found.T_parent_joint, np.eye(4))
    assert np.array_equal(found.axis, [1, 0, 0])
    assert (found.lower, found.upper) == (0, 0)
    assert found.mimic == Mimic("j", 1.0, 0.0)


def test_everything_written_is_read():
    found = read(
        "\n"
        + robot(
            joint(
                '<origin rpy="0 0 1.5" xyz=" 1.  -.5 +2e-1 "/><axis xyz="0 -3 4"/>'
                f'<mimic joint="k" multiplier="-2" offset="0.1"/><safety_controller k_velocity="1"/>{LIMIT}',
                kind="prismatic",
            )
            + joint("", "k", "fixed", "b", "c"),
            "abc",
        )
    )
    j = found.joints["j"]
    assert (found.name, found.links, found.root, list(found.joints)) == (
        "r",
        ("a", "b", "c"),
        "a",
        ["j", "k"],
    )
    assert (j.name, j.type, j.parent, j.child, j.line) == ("j", "prismatic", "a", "b", 2)
    assert np.array_equal(j.T_parent_joint[:3, 3], [1, -0.5, 0.2])
    assert np.allclose(j.T_parent_joint[:2, :2], [[np.cos(1.5), -np.sin(1.5)], [np.sin(1.5), np.cos(1.5)]])
    assert np.allclose(j.axis, [0, -0.6, 0.8], rtol=0, atol=1e-16)
    assert (j.lower, j.upper, j.mimic) == (-1, 2, Mimic("k", -2, 0.1))
    assert (found.joints["k"].lower, found.joints["k"].upper) == (-inf, inf)


def test_a_continuous_joint_has_no_limits_even_if_some_are_written():
    found = read(robot(joint(kind="continuous"))).joints["j"]
    assert (found.lower, found.upper) == (-inf, inf)


@pytest.mark.parametrize("axis", ["0 0 1e-200", "0 0 1e200", "0 0 5"])
def test_an_axis_of_any_length_becomes_a_unit_vector(axis):
    assert np.array_equal(read(robot(joint(f'{LIMIT}<axis xyz="{axis}"/>'))).joints["j"].axis, [0, 0, 1])


def test_a_zero_axis_stays_zero():
    assert np.array_equal(read(robot(joint(f'{LIMIT}<axis xyz="0 0 -0.0"/>'))).joints["j"].axis, [0, 0, 0])


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_an_axis_that_means_nothing_is_not_read(kind):
    document = robot(joint('<axis xyz="up"/>', kind=kind))
    assert not pinocchio_refuses(document)
    assert np.array_equal(read(document).joints["j"].axis, [1, 0, 0])


def test_only_the_first_element_of_a_kind_counts_and_only_directly_below_the_joint():
    document = robot(
        joint(f'<sensor><origin xyz="9 9 9"/></sensor><origin xyz="1 2 3"/><origin xyz="4 5 6"/>{LIMIT}<limit/>')
    )
    assert np.array_equal(read(document).joints["j"].T_parent_joint[:3, 3], [1, 2, 3])
    assert np.array_equal(pin.buildModelFromXML(document).jointPlacements[1].translation, [1, 2, 3])


@pytest.mark.parametrize("version", ["1.1", "1.2"])
@pytest.mark.parametrize("quaternion", ["0 0 1 0", "0.1 -0.7 0.2 3"])
def test_a_quaternion_is_read_as_pinocchio_does(version, quaternion):
    document = robot(
        joint(f'<origin xyz="1 2 3" quat_xyzw="{quaternion}"/>{LIMIT}'),
        attributes=f'name="r" version="{version}"',
    )
    expected = pin.buildModelFromXML(document).jointPlacements[1].homogeneous
    assert np.allclose(read(document).joints["j"].T_parent_joint, expected, rtol=0, atol=1e-15)
    assert not np.allclose(expected[:3, :3], np.eye(3))


def test_white_space_and_character_references_in_numbers():
    found = read(robot(joint(f"<origin xyz='1&#32;2\n\t&#51;'/>{LIMIT}"))).joints["j"]
    assert np.array_equal(found.T_parent_joint[:3, 3], [1, 2, 3])


# --- what is no joint


@pytest.mark.parametrize(
    "decoy",
    [
        '<transmission name="t"><joint name="j"><hardwareInterface/></joint></transmission>',
        '<gazebo reference="b"><joint name="j" type="revolute"><origin xyz="9 9 9"/></joint></gazebo>',
        '<gazebo><plugin><joint>j</joint><link name="a"/></plugin></gazebo>',
        '<ros2_control name="c"><joint name="j"><command_interface name="p"/></joint></ros2_control>',
        '<!-- <joint name="j" type="fixed"><origin xyz="9 9 9"/></joint> -->',
        '<note><![CDATA[<joint name="j" type="fixed"><origin xyz="9 9 9"/></joint>]]></note>',
        '<sdf:joint name="j" xmlns:sdf="x"/>',
    ],
)
def test_joints_deeper_down_are_not_the_robots(decoy):
    document = robot(decoy + joint(f'{decoy}<origin xyz="1 2 3"/>{LIMIT}') + decoy)
    urdf = read(document)
    assert list(urdf.joints) == ["j"]
    assert urdf.links == ("a", "b")
    assert np.array_equal(urdf.joints["j"].T_parent_joint[:3, 3], [1, 2, 3])
    assert not pinocchio_refuses(document)


# --- encodings


@pytest.mark.parametrize(
    ("declaration", "encoding"),
    [
        ("", "utf-8"),
        ("", "utf-8-sig"),
        ('<?xml version="1.0" encoding="UTF-8"?>', "utf-8-sig"),
        ('<?xml version="1.0"?>', "utf-8"),
        ("<?xml version='1.0' encoding='ISO-8859-1'?>", "latin-1"),
        ('<?xml version="1.0" encoding="windows-1252"?>', "cp1252"),
        ('<?xml version="1.0"?><!DOCTYPE robot>', "utf-8"),
    ],
)
def test_names_come_out_right_in_every_encoding(declaration, encoding):
    urdf = read((declaration + robot(joint(name="épaule"))).encode(encoding))
    assert list(urdf.joints) == ["épaule"]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (robot("").encode("utf-16"), "UTF-16, UTF-32 or binary"),
        (robot("").encode("utf-16-le"), "UTF-16, UTF-32 or binary"),
        (robot("").encode("utf-32"), "UTF-16, UTF-32 or binary"),
        (b"\x7fELF\0\0\0", "UTF-16, UTF-32 or binary"),
        ('<?xml version="1.0" encoding="UTF-16"?>' + robot(""), "encoding"),
        ('<?xml version="1.0" encoding="Shift_JIS"?>' + robot(""), "declared encoding cannot be read"),
        ('<?xml version="1.0" encoding="klingon"?>' + robot(""), "declared encoding cannot be read"),
        ("<!--\n" + "é -->".encode().decode("latin-1") + robot(""), "no links|root links"),
        (b"<!--\n\n\xe9 -->" + robot("").encode(), "URDF:3: byte 0xe9 is not UTF-8"),
        (
            b'<?xml version="1.0" encoding="utf-8"?><!--\xe9 -->' + robot("").encode(),
            "byte 0xe9 is not UTF-8",
        ),
        (b"", "the file is empty"),
        (b" \n ", "the file is empty"),
        (b"a,b\n1,2\n", "not well-formed XML"),
        (b"<robot name='r'>\n<link>", "URDF:2, column 7"),
        (robot("") + "<more/>", "junk after document element"),
        (robot('<a x="1" x="2"/>'), "duplicate attribute"),
        (robot('<a x="&undefined;"/>'), "undefined entity"),
    ],
)
def test_bytes_that_are_no_urdf_are_refused(data, message):
    with pytest.raises(RobotError, match=message):
        read(data)


# --- attacks


LAUGHS = (
    '<!DOCTYPE robot [<!ENTITY a "' + "ha" * 50 + '">'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 50}">' for a, b in zip("abcdefg", "bcdefgh", strict=True))
    + "]>"
)  # fmt: skip


@pytest.mark.parametrize(
    "document_type",
    [
        LAUGHS,
        '<!DOCTYPE robot [<!ENTITY h SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE robot [<!ENTITY % h SYSTEM "file:///etc/passwd"> %h;]>',
        '<!DOCTYPE robot SYSTEM "robot.dtd">',
        '<!DOCTYPE robot PUBLIC "-//x" "http://localhost/robot.dtd">',
        '<!DOCTYPE robot [<!ATTLIST origin xyz CDATA "1 2 3">]>',
    ],
)
def test_document_types_with_content_are_refused_before_they_cost_anything(document_type):
    tracemalloc.start()
    with pytest.raises(RobotError, match=r"URDF:2: the document type .* declares entities or names an external"):
        read("\n" + document_type + robot("<x>&h;</x>"))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20


def test_absurd_nesting_is_refused():
    read(robot("<x>" * 90 + "</x>" * 90, "a"))
    with pytest.raises(RobotError, match="nested more than 100 deep"):
        read(robot("<x>" * 100_000, "a"))


def test_absurd_size_is_refused_unread(tmp_path):
    path = tmp_path / "huge.urdf"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(RobotError, match=r"huge\.urdf: the file has 16 MB, more than 16 MB"):
        Urdf.read(path)
    with pytest.raises(RobotError, match="more than 16 MB"):
        read(b" " * (MAX_BYTES + 1))


def test_whatever_the_bytes_there_is_a_robot_or_an_error_with_a_place():
    data = robot(joint(f'<origin xyz="1 2 3" rpy="0 0 1"/><axis xyz="0 0 1"/>{LIMIT}')).encode()
    rng = random.Random(7)  # noqa: S311
    places = []
    for _ in range(3000):
        broken = bytearray(data)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(broken))
            choice = rng.random()
            if choice < 0.4:
                broken[at] = rng.choice(b"<>/=\"' &;-019.abx\0\xe9\xff")
            elif choice < 0.7:
                del broken[at : at + rng.randint(1, 12)]
            else:
                broken[at:at] = data[at : at + rng.randint(1, 60)]
        try:
            Urdf.parse(bytes(broken))
        except RobotError as error:
            places.append(error.where)
    assert 1000 < len(places) < 3000
    assert all(place.startswith("URDF") for place in places)


# --- xacro


@pytest.mark.parametrize(
    "inside",
    [
        '<xacro:property name="x" value="1"/>' + joint(),
        '<link name="c"><xacro:box size="1"/></link>' + joint() + joint("", "k", "fixed", "b", "c"),
        joint(f'<origin xyz="${{x}} 0 0"/>{LIMIT}'),
        joint(f'<origin xyz="$(arg x) 0 0"/>{LIMIT}').replace("$(arg x)", "$(arg_x)"),
    ],
)
def test_a_xacro_file_must_be_expanded_first(inside):
    with pytest.raises(RobotError, match=r"xacro file, not a URDF.*Run xacro first"):
        read(robot(inside, attributes='name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"'))


def test_a_file_named_xacro_is_refused(tmp_path):
    path = tmp_path / "arm.urdf.xacro"
    path.write_text(robot(joint()))
    with pytest.raises(RobotError, match=r"arm\.urdf\.xacro: this is a xacro file"):
        Urdf.read(path)


def test_what_xacro_leaves_behind_is_harmless():
    read(
        "<!-- autogenerated by xacro from arm.urdf.xacro --><!-- <xacro:macro/> -->"
        + robot(joint() + "<x>${name}</x>", attributes='name="r" xmlns:xacro="http://wiki.ros.org/xacro"')
    )


# --- broken robots: what, where, and Pinocchio refuses them too


BROKEN = {
    "no robot": ("<sdf><link name='a'/></sdf>", "the root element is <sdf>, not <robot>"),
    "no name": (robot("", attributes=""), "<robot> has no name"),
    "version": (robot("", "a", 'name="r" version="2.0"'), "URDF version '2.0'"),
    "no links": (robot("", ""), "no links"),
    "nameless link": (robot("<link/>"), "<link> has no name"),
    "nameless joint": (robot("<joint/>"), "<joint> has no name"),
    "link twice": (robot("", "aa"), "there is a link 'a' already, in line 3"),
    "joint twice": (robot(joint() + joint(child="c"), "abc"), "there is a joint 'j' already"),
    "no type": (robot('<joint name="j"/>'), "'j': it has no type"),
    "unknown type": (robot(joint(kind="ball")), "its type 'ball' is not known. URDF has: revolute, cont"),
    "no parent": (robot(joint().replace('<parent link="a"/>', "")), "it has no parent link"),
    "no child": (robot(joint().replace('<child link="b"/>', "<child/>")), "it has no child link"),
    "unknown parent": (robot(joint(parent="base")), "no parent link 'base'. The links are: a, b."),
    "unknown child": (robot(joint(child="tool")), "no child link 'tool'. The links are: a, b."),
    "two parents": (
        robot(joint(child="c") + joint(name="k", parent="b", child="c"), "abc"),
        "'k': link 'c' hangs on joint 'j' already",
    ),
    "two roots": (robot("", "abc"), "3 root links: a, b, c"),
    "revolute without limit": (robot(joint("")), "revolute joint needs a <limit>.*or make it continuous"),
    "prismatic without limit": (robot(joint("", kind="prismatic")), "prismatic joint needs a <limit>"),
    "limit without effort": (robot(joint('<limit velocity="1"/>')), "no effort"),
    "limit without velocity": (robot(joint('<limit effort="1"/>', kind="fixed")), "no velocity"),
    "endless limit": (robot(joint(LIMIT.replace("-1", "-inf"))), "lower of <limit> is '-inf', not a finite"),
    "limit in words": (robot(joint(LIMIT.replace("-1", "low"))), "lower of <limit> is 'low'"),
    "mimic nothing": (robot(joint(f"{LIMIT}<mimic/>")), "names no joint"),
    "mimic in words": (robot(joint(f'{LIMIT}<mimic joint="j" offset="x"/>')), "offset of <mimic> is 'x'"),
    "axis in words": (robot(joint(f'{LIMIT}<axis xyz="0 0 z"/>')), "xyz of <axis> is 'z'"),
    "axis too short": (robot(joint(f'{LIMIT}<axis xyz="0 1"/>')), "xyz of <axis> has 2 numbers, not 3"),
    "both rotations": (
        robot(joint(f'{LIMIT}<origin rpy="0 0 0" quat_xyzw="0 0 0 1"/>'), attributes=V1_2),
        "both rpy and quat_xyzw",
    ),
}
NUMBERS = [
    "",
    "1 2",
    "1 2 3 4",
    "nan 0 0",
    "0 inf 0",
    "0 0 1e999",
    "1,2,3",
    "1_0 0 0",
    "0x1 0 0",
    "1 2 3m",
    "\u0661 0 0",
]
BROKEN |= {
    f"{attribute} {value}": (
        robot(joint(f'{LIMIT}<origin {attribute}="{value}"/>')),
        f"{attribute} of <origin>",
    )
    for attribute in ("xyz", "rpy")
    for value in NUMBERS
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_robots_are_refused_as_pinocchio_does_but_with_reasons(name):
    document, message = BROKEN[name]
    with pytest.raises(RobotError, match=message) as caught:
        read("\n\n" + document)
    assert caught.value.where.startswith("URDF:3") or name in ("no links", "two roots")
    assert pinocchio_refuses(document)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (robot(joint(parent="b", child="b")), "'j': its links form a loop: b -> b"),
        (
            robot(joint(parent="c") + joint("", "k", "fixed", "b", "c"), "abc"),
            "loop: b -> c -> b",
        ),
        (robot(joint(parent="b", child="a") + joint(name="k"), "ab"), "loop: a -> b -> a"),
        (robot(joint(f'{LIMIT}<origin quat_xyzw="0 0 1 0"/>')), "quat_xyzw is not part of URDF 1.0"),
        (
            robot(joint(f'{LIMIT}<origin quat_xyzw="0 0 0 0"/>'), attributes=V1_2),
            "quat_xyzw is zero",
        ),
    ],
)
def test_what_pinocchio_lets_pass_in_silence_is_refused(document, message):
    with pytest.raises(RobotError, match=message):
        read(document)


def test_the_place_of_an_error_is_the_offending_element(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(robot("\n" + joint(f'\n\n<origin xyz="1 2"/>{LIMIT}')))
    with pytest.raises(RobotError) as caught:
        Urdf.read(path)
    assert str(caught.value) == (
        f"{path}:4, joint 'j': xyz of <origin> has 2 numbers, not 3: '1 2'. Write them with spaces in between."
    )


def test_of_many_names_the_likeliest_are_listed_first():
    links = [f"finger_{i}" for i in range(60)] + ["tool0"]
    document = f'<robot name="r">{"".join(f"<link name={n!r}/>" for n in links)}{joint(parent="tool_0")}</robot>'
    with pytest.raises(
        RobotError, match=r"Did you mean 'tool0'\? The links are: tool0, .*, \.\.\. \(61 in all\)\."
    ) as caught:
        read(document)
    assert len(str(caught.value)) < 250


def test_a_long_value_does_not_fill_the_screen():
    with pytest.raises(RobotError) as caught:
        read(robot(joint(f'{LIMIT}<origin xyz="{"1 " * 100_000}"/>')))
    assert len(str(caught.value)) < 200


# --- the value itself


def test_a_description_is_read_only_and_travels_to_other_processes(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(robot(joint(f'{LIMIT}<origin xyz="1 2 3"/>')))
    urdf = Urdf.read(str(path))
    with pytest.raises(TypeError):
        urdf.joints["k"] = urdf.joints["j"]
    with pytest.raises(ValueError, match="read-only"):
        urdf.joints["j"].T_parent_joint[0, 3] = 0.0
    copy = pickle.loads(pickle.dumps(urdf))  # noqa: S301
    assert (copy.path, copy.data) == (path, urdf.data)
    assert np.array_equal(copy.joints["j"].T_parent_joint, urdf.joints["j"].T_parent_joint)


def test_a_package_reference_is_read():
    urdf = Urdf.read("package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf")
    assert urdf.name == "ur5"


def test_a_file_that_may_not_be_read_is_reported(tmp_path, monkeypatch):
    path = tmp_path / "arm.urdf"
    path.write_text(robot(joint()))

    def forbidden(_path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "read_bytes", forbidden)
    with pytest.raises(RobotError, match=r"arm\.urdf: cannot be read: Permission denied"):
        Urdf.read(path)
