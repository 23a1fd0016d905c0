from __future__ import annotations

import numpy as np
import pytest

from urdfcal.output.arms import visible_links
from urdfcal.robot.chain import Chain
from urdfcal.robot.urdf.urdf import Urdf

ROBOTS = "package://example-robot-data/robots"

ARM = """<robot name="arm" xmlns:x="http://x">
  <material name="blue"><color rgba="0 0 1 1"/></material>
  <link name="base"><visual><geometry><box size="1 2 3"/></geometry><material name="blue"/></visual></link>
  <link name="upper">
    <visual><origin xyz="0 0 0.5" rpy="0 1.5 0"/><geometry><cylinder radius="0.1" length="1"/></geometry></visual>
    <visual><geometry>{shape}</geometry><material name="own"><color rgba="1 0 0 0.5"/></material></visual>
  </link>
  <link name="cover"><visual><geometry><sphere radius="0.2"/></geometry><material name="own"/></visual></link>
  <link name="other arm"><visual><geometry><sphere radius="0.3"/></geometry></visual></link>
  <link name="hand"/>
  <link name="finger"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/></joint>
  <joint name="screws" type="fixed"><parent link="upper"/><child link="cover"/><origin xyz="0.1 0 0"/></joint>
  <joint name="side" type="continuous"><parent link="base"/><child link="other arm"/></joint>
  <joint name="wrist" type="continuous">
    <parent link="cover"/><child link="hand"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="grip" type="prismatic">
    <parent link="hand"/><child link="finger"/><origin xyz="0 0 0.2"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.04" effort="1" velocity="1"/>
  </joint>
</robot>"""


def bodies(shape='<sphere radius="0.2"/>', path=None):
    urdf = Urdf.parse(ARM.format(shape=shape).encode(), path)
    found, warnings = visible_links(urdf, Chain.from_urdf(urdf, "hand"))
    return {body.link: body for body in found}, warnings


def test_links_hang_on_the_frame_that_carries_them():
    found, warnings = bodies()
    assert warnings == ()
    assert {link: body.frame for link, body in found.items()} == {"base": 0, "upper": 1, "cover": 1, "finger": 2}
    np.testing.assert_allclose(found["cover"].T_frame_link[:3, 3], [0.1, 0, 0])
    np.testing.assert_allclose(found["finger"].T_frame_link[:3, 3], [0, 0, 0.2])


def test_every_shape_of_a_link_is_read_with_its_place_and_colour():
    found, _ = bodies()
    cylinder, sphere = found["upper"].shapes
    assert (cylinder.kind, cylinder.size, cylinder.color) == ("cylinder", (0.1, 1.0), None)
    np.testing.assert_allclose(cylinder.T_link_shape[:3, 3], [0, 0, 0.5])
    np.testing.assert_allclose(cylinder.T_link_shape[0, :3], [np.cos(1.5), 0, np.sin(1.5)])
    assert (sphere.kind, sphere.size, sphere.color) == ("sphere", (0.2,), (1.0, 0.0, 0.0, 0.5))
    assert found["base"].shapes[0].color == (0.0, 0.0, 1.0, 1.0)
    assert found["cover"].shapes[0].color == (1.0, 0.0, 0.0, 0.5)  # a material is known by its name everywhere


def test_a_relative_mesh_lies_beside_the_urdf(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "upper.STL").write_bytes(b"solid")
    shape = '<mesh filename="meshes/upper.STL" scale="0.001 0.001 0.001"/>'
    found, warnings = bodies(shape, tmp_path / "arm.urdf")
    mesh = found["upper"].shapes[1]
    assert warnings == ()
    assert (mesh.mesh, mesh.size) == (tmp_path / "meshes" / "upper.STL", (0.001, 0.001, 0.001))
    found, _ = bodies(f'<mesh filename="file://{tmp_path}/meshes/upper.STL"/>')
    assert found["upper"].shapes[1].mesh == tmp_path / "meshes" / "upper.STL"


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ('<mesh filename="package://nowhere/a.stl"/>', "nowhere"),
        ('<mesh filename="gone.stl"/>', "gone.stl"),
        ('<mesh filename="/etc/hostname"/>', "hostname is not one of .stl"),
        ('<box size="1 2"/>', "not 3 numbers"),
    ],
)
def test_what_cannot_be_shown_is_left_out_and_named(shape, message):
    found, (warning,) = bodies(shape)
    assert message in warning
    assert len(found["upper"].shapes) == 1


@pytest.mark.parametrize("shape", ['<cylinder radius="thick" length="1"/>', '<cone radius="1"/>'])
def test_a_urdf_whose_shapes_cannot_be_read_shows_none_and_says_why(shape):
    found, (warning,) = bodies(shape)
    assert found == {}
    assert "thick" in warning or "cone" in warning


@pytest.mark.parametrize(
    ("urdf", "tip", "meshes"),
    [
        ("ur_description/urdf/ur5_robot.urdf", "tool0", 7),
        ("panda_description/urdf/panda.urdf", "panda_link8", 11),
        ("so_arm_description/urdf/so101.urdf", "gripper", 17),
    ],
)
def test_all_meshes_of_well_known_arms_are_found(urdf, tip, meshes):
    robot = Urdf.read(f"{ROBOTS}/{urdf}")
    found, warnings = visible_links(robot, Chain.from_urdf(robot, next(n for n in robot.links if tip in n)))
    assert warnings == ()
    assert sum(shape.mesh is not None for body in found for shape in body.shapes) == meshes
