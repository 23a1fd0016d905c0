from __future__ import annotations

import re
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from urdfcal.errors import RobotError
from urdfcal.robot.urdf.origins import rewrite_origins
from urdfcal.robot.urdf.urdf import Urdf, package_roots
from urdfcal.rotations import rpy_to_matrix

EXAMPLES = [
    path
    for path in sorted((package_roots()[-1] / "example-robot-data" / "robots").rglob("*.urdf"))
    if path.name != "ur3.urdf"  # has no robot in it
]
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
ROUNDING = 5e-15


def placement(xyz=(0.0, 0.0, 0.0), rpy=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, 3] = xyz
    T[:3, :3] = rpy_to_matrix(rpy)
    return T


def own_placements(urdf):
    return {name: joint.T_parent_joint for name, joint in urdf.joints.items()}


def corrected(urdf, size, seed):
    rng = np.random.default_rng(seed)
    return {
        name: T @ placement(rng.normal(0, size, 3), rng.normal(0, size, 3)) for name, T in own_placements(urdf).items()
    }


def largest_difference(urdf, placements):
    return max(
        (np.abs(joint.T_parent_joint - placements[name]).max() for name, joint in urdf.joints.items()), default=0.0
    )


def one_joint(inside, before="", after=""):
    return f"""{before}<robot name="r">
  <link name="a"/><link name="b"/>
  <joint name="j" type="revolute">{inside}
    <parent link="a"/><child link="b"/>{LIMIT}
  </joint>{after}
</robot>"""


def rewrite(text, T, encoding="utf-8"):
    urdf = Urdf.parse(text.encode(encoding))
    return rewrite_origins(urdf, {"j": T}).decode(encoding)


# --- every robot of example-robot-data


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_their_own_placements_leave_files_untouched(path):
    urdf = Urdf.read(path)
    assert rewrite_origins(urdf, own_placements(urdf)) == path.read_bytes()
    assert rewrite_origins(urdf, {}) == path.read_bytes()


def everything_but_joint_origins(data):
    """Flatten a document, by another parser: comments, texts, order, attributes; joints' first origins left out."""
    root = ET.XML(data, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True, insert_pis=True)))  # noqa: S314
    seen = []

    def walk(element, path):
        origin = element.find("origin") if element.tag == "joint" and path == ("robot",) else None
        seen.append((path, element.tag, list(element.attrib.items()), (element.text or "").strip()))
        for child in element:
            if child is not origin:
                walk(child, (*path, element.tag))
            seen.extend(filter(None, [(child.tail or "").strip()]))

    walk(root, ())
    return seen


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
@pytest.mark.parametrize("size", [1e-3, 1e-2])
def test_corrections_change_nothing_but_joint_origins(path, size):
    urdf = Urdf.read(path)
    placements = corrected(urdf, size, seed=len(urdf.data))
    data = rewrite_origins(urdf, placements)
    assert largest_difference(Urdf.parse(data), placements) < ROUNDING
    # Inserted origins bring the white space before them along: cut it on both sides.
    cut = re.compile(rb"\s*<origin\b[^>]*>")
    assert cut.sub(b"", data) == cut.sub(b"", urdf.data)
    assert everything_but_joint_origins(data) == everything_but_joint_origins(urdf.data)
    # And what was put back is where it was.
    back = Urdf.parse(rewrite_origins(Urdf.parse(data), own_placements(urdf)))
    assert largest_difference(back, own_placements(urdf)) < ROUNDING


@pytest.mark.parametrize("name", ["ur5_robot", "tiago_dual", "TwoDofs", "pr2", "so100"])
def test_pinocchio_reads_what_was_written(name):
    (path,) = [path for path in EXAMPLES if path.stem == name]
    urdf = Urdf.read(path)
    placements = corrected(urdf, 0.1, seed=1)
    model = pin.buildModelFromXML(rewrite_origins(urdf, placements).decode())
    for joint in urdf.joints.values():
        if joint.type != "fixed":
            parent = model.frames[model.getFrameId(joint.parent, pin.FrameType.BODY)].placement.homogeneous
            found = model.jointPlacements[model.getJointId(joint.name)].homogeneous
            assert np.allclose(found, parent @ placements[joint.name], rtol=0, atol=1e-14)


# --- only what changes


ORIGIN = '<origin xyz="0.1 0.20 3e-1" rpy="1.5708 0 0"/>'


@pytest.mark.parametrize(
    ("T", "expected"),
    [
        (placement((0.1, 0.2, 0.3), (1.5708, 0, 0)), ORIGIN),
        (placement((0.1, 0.2, 0.3 + 5e-16), (1.5708, 0, 0)), ORIGIN),
        (placement((0.1, 0.2, 0.3 + 5e-15), (1.5708, 0, 0)), ORIGIN.replace("0.20 3e-1", "0.2 0.300000000000005")),
        (placement((0.1, 0.2, 0.25), (1.5708, 0, 0)), ORIGIN.replace("0.20 3e-1", "0.2 0.25")),
        (placement((0.1, 0.2, 0.3), (0, 0, 0.5)), ORIGIN.replace("1.5708 0 0", "0.0 0.0 0.5")),
        (placement((-0.0, -1.0, 1e-20), (0, 0, 0.5)), '<origin xyz="0.0 -1.0 1e-20" rpy="0.0 0.0 0.5"/>'),
    ],
)
def test_only_the_attribute_that_changes_is_written(T, expected):
    assert rewrite(one_joint(ORIGIN), T) == one_joint(expected)


NEW = placement((1, 2, 3), (0, 0, 0.5))
XYZ, RPY = "1.0 2.0 3.0", "0.0 0.0 0.5"
TURNED = placement((0, 0, 0), (0, 0, 0.5))


@pytest.mark.parametrize(
    ("before", "T", "after"),
    [
        ("<origin/>", NEW, f'<origin xyz="{XYZ}" rpy="{RPY}"/>'),
        ("<origin />", NEW, f'<origin xyz="{XYZ}" rpy="{RPY}" />'),
        ("<origin></origin>", NEW, f'<origin xyz="{XYZ}" rpy="{RPY}"></origin>'),
        ("<origin\n>\n</origin >", NEW, f'<origin xyz="{XYZ}" rpy="{RPY}"\n>\n</origin >'),
        ("<origin/>", TURNED, f'<origin rpy="{RPY}"/>'),
        ("<origin xyz='0 0 0'/>", NEW, f"<origin xyz='{XYZ}' rpy='{RPY}'/>"),
        ("<origin xyz='0 0 0'/>", TURNED, f"<origin xyz='0 0 0' rpy='{RPY}'/>"),
        ('<origin rpy="0 0 0" />', NEW, f'<origin rpy="{RPY}" xyz="{XYZ}" />'),
        ('<origin rpy="0 0 0.5"/>', NEW, f'<origin rpy="0 0 0.5" xyz="{XYZ}"/>'),
        ('<origin\n\trpy="0 0 0"\n/>', NEW, f'<origin\n\trpy="{RPY}"\n\txyz="{XYZ}"\n/>'),
        ("<origin xyz = '0 0 0' rpy= \"1 0 0\"  />", NEW, f"<origin xyz = '{XYZ}' rpy= \"{RPY}\"  />"),
        ('<origin xyz="0&#32;0\n&#48;" rpy="1 0 0"/>', NEW, f'<origin xyz="{XYZ}" rpy="{RPY}"/>'),
        (
            """<origin note='<>"/> xyz="7"' xyz="0 0 0" rpy="1 0 0" also="it's > xyz='8'"/>""".replace("<>", "&lt;>"),
            NEW,
            f"""<origin note='&lt;>"/> xyz="7"' xyz="{XYZ}" rpy="{RPY}" also="it's > xyz='8'"/>""",
        ),
        ('<origin xyz="0 0 0"/><origin xyz="5 5 5"/>', NEW, f'<origin xyz="{XYZ}" rpy="{RPY}"/><origin xyz="5 5 5"/>'),
        (
            '<!-- <origin xyz="1 1 1"/> --><x><![CDATA[<origin/>]]><origin/></x><origin rpy="0 0 .5"/>',
            NEW,
            f'<!-- <origin xyz="1 1 1"/> --><x><![CDATA[<origin/>]]><origin/></x><origin rpy="0 0 .5" xyz="{XYZ}"/>',
        ),
    ],
)  # fmt: skip
def test_origins_of_every_shape_are_edited_in_place(before, T, after):
    assert rewrite(one_joint(before), T) == one_joint(after)


# --- a missing origin


def joint_without_origin(opening, rest, origin=""):
    return f'<robot name="r"><link name="a"/><link name="b"/>{opening}{origin}{rest}</joint></robot>'


INSERTED = f'<origin xyz="{XYZ}" rpy="{RPY}"/>'


@pytest.mark.parametrize(
    ("opening", "origin", "rest"),
    [
        ('\n  <joint name="j" type="fixed">', f"\n    {INSERTED}", '\n    <parent link="a"/><child link="b"/>\n  '),
        ('\r\n\t<joint name="j" type="fixed">', f"\r\n\t\t{INSERTED}", '\r\n\t\t<parent link="a"/><child link="b"/>'),
        ('\r<joint name="j" type="fixed">', f"\r {INSERTED}", '\r <parent link="a"/><child link="b"/>\r'),
        ('<joint name="j" type="fixed">', INSERTED, '<parent link="a"/><child link="b"/>'),
        ("\n<joint type='fixed'\n  name='j'\n >", f"\n\n{INSERTED}"[1:], "\n\n\n<parent link='a'/><child link='b'/>\n"),
        (
            '\n  <joint name="j" type="fixed"> <!-- the -> shoulder -->',
            f"\n    {INSERTED}",
            '  \n    <parent link="a"/>\n    <child link="b"/>\n  ',
        ),
        (
            '\n  <joint name="j" type="fixed">',
            f"\n    {INSERTED}",
            '\n    <!-- <origin/> -->\n    <parent link="a"/>\n    <child link="b"/>\n  ',
        ),
        (
            '\n  <joint note="a > b" name="j" type="fixed">',
            f"\n    {INSERTED}",
            '<!-- two\n lines -->\n    <parent link="a"/>\n    <child link="b"/>\n  ',
        ),
    ],
)  # fmt: skip
def test_a_missing_origin_is_inserted_below_the_opening_tag_in_the_files_own_style(opening, origin, rest):
    before = joint_without_origin(opening, rest)
    assert rewrite(before, NEW) == joint_without_origin(opening, rest, origin)
    assert rewrite(before, np.eye(4)) == before


# --- encodings


@pytest.mark.parametrize(
    ("declaration", "encoding"),
    [
        ("", "utf-8"),
        ("", "utf-8-sig"),
        ('<?xml version="1.0" encoding="utf-8"?>\r\n', "utf-8-sig"),
        ("<?xml version='1.0' encoding='ISO-8859-1'?>\n", "latin-1"),
        ('<?xml version="1.0" encoding="windows-1252"?>\n', "cp1252"),
        ("<!DOCTYPE robot>\n", "utf-8"),
    ],
)
def test_every_encoding_stays_byte_for_byte(declaration, encoding):
    euro = "€" if encoding != "latin-1" else "£"
    before = one_joint(f"<!-- épaule {euro} --><origin note='ü' rpy='0 0 1'/>", declaration, f"<!-- {euro} -->")
    after = before.replace("rpy='0 0 1'", f"rpy='{RPY}' xyz='{XYZ}'")
    assert rewrite_origins(Urdf.parse(before.encode(encoding)), {"j": NEW}) == after.encode(encoding)


def test_a_joint_with_a_name_in_latin_1_is_rewritten():
    text = one_joint("").replace('"j"', '"épaule"')
    data = ('<?xml version="1.0" encoding="ISO-8859-1"?>' + text).encode("latin-1")
    new = Urdf.parse(rewrite_origins(Urdf.parse(data), {"épaule": NEW}))
    assert largest_difference(new, {"épaule": NEW}) < ROUNDING


def test_megabytes_before_a_joint_do_not_shift_it():
    # Python hands expat a file in pieces of 1 MB.
    before = one_joint("<origin/>", before="<!-- é" + "x" * 2_500_000 + " -->")
    assert rewrite(before, NEW) == before.replace("<origin/>", INSERTED)


# --- any placement, any spelling


lengths = st.floats(-10, 10) | st.sampled_from([0.0, -0.0, 1e-300, 0.1 + 0.2, 1e16])
angles = st.floats(-4, 4)
pitches = angles | st.sampled_from([np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, 1.5708])
placements = st.builds(placement, st.tuples(lengths, lengths, lengths), st.tuples(angles, pitches, angles))
gaps = st.sampled_from([" ", "  ", "\n      ", "\t", "\r\n\t"])
equals = st.sampled_from(["=", " = ", "=\n"])
separators = st.sampled_from([" ", "   ", "\n", "\t", "&#32;", "&#x20; "])


@st.composite
def spelled_origins(draw):
    """Draw an origin tag as a function of its two values, and the values it starts with."""
    names = draw(st.permutations(["xyz", "rpy", "note"]))
    gap, equal = {n: draw(gaps) for n in names}, {n: draw(equals) for n in names}
    quote = {n: draw(st.sampled_from("\"'")) for n in names}
    end = draw(st.sampled_from(["/>", " />", "></origin>", "\n><!-- > --></origin>"]))
    numbers = [repr(draw(st.floats(-3, 3))) for _ in range(6)]
    old = {"xyz": draw(separators).join(numbers[:3]), "rpy": draw(separators).join(numbers[3:])}

    def spell(values):
        texts = {"note": "xyz=&apos;0 0 0&apos; > " + {"'": '"', '"': "'"}[quote["note"]], **values}
        return "<origin" + "".join(f"{gap[n]}{n}{equal[n]}{quote[n]}{texts[n]}{quote[n]}" for n in names) + end

    return spell, old


@pytest.mark.no_cover
@settings(max_examples=300, deadline=None)
@given(spelled_origins(), placements)
def test_in_any_spelling_just_the_values_are_replaced(origin, T):
    spell, old = origin
    urdf = Urdf.parse(one_joint(spell(old)).encode())
    first = urdf.joints["j"].T_parent_joint
    data = rewrite_origins(urdf, {"j": T})
    new = Urdf.parse(data).joints["j"].T_parent_joint
    assert np.abs(new[:3, 3] - T[:3, 3]).max() <= 1e-15
    assert np.abs(new[:3, :3] - T[:3, :3]).max() < ROUNDING
    written = {
        match[1]: match[3] for match in re.finditer(r"""\b(xyz|rpy)\s*=\s*(["'])([-+.e\d\s&#;x]*)\2""", data.decode())
    }
    assert data.decode() == one_joint(spell(written))
    assert rewrite_origins(Urdf.parse(data), {"j": new}) == data
    restored = Urdf.parse(rewrite_origins(Urdf.parse(data), {"j": first})).joints["j"].T_parent_joint
    assert np.abs(restored - first).max() < ROUNDING


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
def test_an_origin_at_gimbal_lock_survives(pitch):
    T = placement((1, 2, 3), (0.3, pitch, -0.4))
    new = Urdf.parse(rewrite(one_joint(""), T).encode()).joints["j"].T_parent_joint
    assert np.abs(new - T).max() < ROUNDING


# --- refused


def test_an_unknown_joint_is_reported_with_those_that_exist():
    urdf = Urdf.parse(one_joint("").encode())
    with pytest.raises(RobotError, match=r"there is no joint 'joint_1'. The joints are: j\."):
        rewrite_origins(urdf, {"joint_1": NEW})


@pytest.mark.parametrize(
    "T",
    [
        np.diag([1.0, 1.0, 2.0, 1.0]),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.full((4, 4), np.nan),
        np.eye(3),
    ],
)
def test_what_is_no_rigid_transform_is_refused(T):
    with pytest.raises(RobotError, match=r"no rigid transform|not a finite 4x4 matrix"):
        rewrite_origins(Urdf.parse(one_joint("").encode()), {"j": T})


def test_a_quaternion_stays_and_only_the_translation_beside_it_is_rewritten():
    before = one_joint('<origin xyz="0 0 0" quat_xyzw="0 0 1 0"/>').replace('"r"', '"r" version="1.2"')
    turned = Urdf.parse(before.encode()).joints["j"].T_parent_joint.copy()
    turned[:3, 3] = 1, 2, 3
    assert rewrite(before, turned) == before.replace("0 0 0", XYZ)
    with pytest.raises(RobotError, match=r"URDF:3, joint 'j': its rotation is written as quat_xyzw.*by rpy"):
        rewrite(before, NEW)


def test_nothing_leaves_that_does_not_read_back_as_asked(monkeypatch):
    monkeypatch.setattr("urdfcal.robot.urdf.origins.matrix_to_rpy", lambda _R: np.zeros(3))
    with pytest.raises(RobotError, match="does not read back as asked: j"):
        rewrite(one_joint(""), NEW)
