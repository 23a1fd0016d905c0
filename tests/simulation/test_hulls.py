from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
import pytest
from pinocchio import coal

from urdfcal.errors import RobotError
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.robot.chain import Chain
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.simulation import hulls
from urdfcal.simulation.hulls import hulls_of

if TYPE_CHECKING:
    from pathlib import Path

STL = """solid box
facet normal 0 0 1 outer loop vertex 0 0 0 vertex 0.1 0 0 vertex 0 0.1 0 endloop endfacet
facet normal 0 0 1 outer loop vertex 0 0 0 vertex 0.1 0 0 vertex 0 0 0.1 endloop endfacet
facet normal 0 0 1 outer loop vertex 0 0 0 vertex 0 0.1 0 vertex 0 0 0.1 endloop endfacet
facet normal 0 0 1 outer loop vertex 0.1 0 0 vertex 0 0.1 0 vertex 0 0 0.1 endloop endfacet
endsolid box
"""
ARM = """<robot name="arm">
<link name="base"/>
<link name="hand"><collision><origin xyz="0 0 0.2"/><geometry><mesh filename="package://box.stl"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="hand"/><axis xyz="0 0 1"/>
<origin xyz="0 0 0.3"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""


@pytest.fixture
def arm(tmp_path: Path) -> tuple[Chain, Urdf]:
    (tmp_path / "box.stl").write_text(STL)
    (tmp_path / "arm.urdf").write_text(ARM)
    urdf = Urdf.read(tmp_path / "arm.urdf")
    return Chain.from_urdf(urdf, "hand", "base"), urdf


def size(shape: coal.CollisionGeometry) -> np.ndarray:
    shape.computeLocalAABB()
    return np.asarray(shape.aabb_local.max_ - shape.aabb_local.min_)


def test_a_mesh_is_replaced_by_its_hull_where_the_link_has_it(arm: tuple[Chain, Urdf]) -> None:
    (solid,) = hulls_of(*arm)
    assert isinstance(solid.geometry, coal.ConvexBase)
    assert solid.parentJoint == 1
    np.testing.assert_allclose(solid.placement.translation, [0.0, 0.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(size(solid.geometry), 0.1, atol=1e-6)


def test_hulls_are_made_once_as_long_as_the_meshes_stay_as_they_are(arm: tuple[Chain, Urdf], tmp_path: Path) -> None:
    hulls_of(*arm)
    made = hulls._load.cache_info().misses
    hulls_of(arm[0], Urdf.read(tmp_path / "arm.urdf"))
    assert hulls._load.cache_info().misses == made
    (tmp_path / "box.stl").write_text(STL.replace("0.1", "0.3"))
    os.utime(tmp_path / "box.stl", ns=(0, 1))
    np.testing.assert_allclose(size(hulls_of(*arm)[0].geometry), 0.3, atol=1e-6)
    (tmp_path / "box.stl").unlink()
    with pytest.raises(RobotError, match=r"arm\.urdf: its collision geometry cannot be loaded: .*box\.stl"):
        hulls_of(*arm)


def test_who_asks_twice_does_not_change_what_the_other_has() -> None:
    rig = read_rig(find_rig("so101"))
    assert rig.urdf is not None
    first, second = hulls_of(rig.chain, rig.urdf), hulls_of(rig.chain, rig.urdf)
    second[3].placement = second[0].placement
    assert first[3].placement != second[3].placement
    assert len({solid.name for solid in first}) == len(first)
