"""The robot's collision geometry, each solid by its convex hull."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import pinocchio as pin
from pinocchio import coal

from urdfcal.errors import RobotError
from urdfcal.robot.urdf.urdf import package_roots

if TYPE_CHECKING:
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.robot.urdf.urdf import Urdf

# Robots whose hulls are kept: those of an SO-101 take 1.5 s to make, and a plan asks for them three times.
_KEPT = 4


def hulls_of(mechanism: Mechanism, urdf: Urdf) -> list[pin.GeometryObject]:
    """Load the solids of a robot as convex hulls; joint i is the mechanism's i-th, 0 the base link.

    They are kept as long as URDF and meshes stay as they are. Joints that are none of the mechanism's stay at zero.

    Args:
        mechanism: the arm.
        urdf: the description that it was read from.

    Raises:
        RobotError: a mesh cannot be found or read.
    """
    folders = [*package_roots(), *([urdf.path.parent] if urdf.path else [])]
    try:
        loaded, changed = _load(urdf.text, tuple(map(str, folders)))
        if changed != _changed(loaded):
            _load.cache_clear()
            loaded, _ = _load(urdf.text, tuple(map(str, folders)))
    except (ValueError, RuntimeError) as error:
        reason = " ".join(str(error).rpartition("message: ")[2].split())
        raise RobotError(
            f"its collision geometry cannot be loaded: {reason}", where=str(urdf.path or "URDF")
        ) from error
    whole = pin.buildModelFromXML(urdf.text)
    # Not by pin.buildReducedModel, which fails where a joint and a link have the same name.
    data = whole.createData()
    pin.forwardKinematics(whole, data, pin.neutral(whole))
    base = whole.frames[whole.getFrameId(mechanism.base_link, pin.FrameType.BODY)]
    frames = {0: data.oMi[base.parentJoint] * base.placement}
    numbers = {0: 0}
    for i, name in enumerate(mechanism.names, start=1):
        joint = whole.getJointId(name)
        frames[joint], numbers[joint] = data.oMi[joint], i
    solids = []
    for solid in loaded.geometryObjects:
        carrier = joint = solid.parentJoint
        while carrier not in numbers:
            carrier = whole.parents[carrier]
        placement = frames[carrier].actInv(data.oMi[joint] * solid.placement)
        solids.append(pin.GeometryObject(solid.name, numbers[carrier], placement, solid.geometry))
    return solids


@lru_cache(maxsize=_KEPT)
def _load(text: str, folders: tuple[str, ...]) -> tuple[pin.GeometryModel, tuple[int, ...]]:
    """The hulls of a description's solids, and when their meshes were last changed."""
    loaded = pin.buildGeomFromUrdfString(
        pin.buildModelFromXML(text),
        text,
        pin.GeometryType.COLLISION,
        package_dirs=list(folders),
        # Oriented boxes are the quickest to build; the hull needs none.
        mesh_loader=coal.CachedMeshLoader(coal.NODE_TYPE.BV_OBB),
    )
    for solid in loaded.geometryObjects:
        if isinstance(solid.geometry, coal.BVHModelBase):
            solid.geometry.buildConvexHull(True, "Qt")
            solid.geometry = solid.geometry.convex
    return loaded, _changed(loaded)


def _changed(loaded: pin.GeometryModel) -> tuple[int, ...]:
    """When the meshes were last changed, [ns]; 0 where one is gone."""
    meshes = [Path(solid.meshPath) for solid in loaded.geometryObjects]
    return tuple(mesh.stat().st_mtime_ns if mesh.is_file() else 0 for mesh in meshes)
