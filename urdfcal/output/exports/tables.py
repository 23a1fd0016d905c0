"""The calibrated joints as tables: origins as YAML for ROS and xacro, DH rows and zero offsets as CSV."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

import numpy as np
import yaml

from urdfcal.arrays import inverse
from urdfcal.errors import OutputError
from urdfcal.output.trajectory import csv_text
from urdfcal.result.calibration import Calibration, corrected_name
from urdfcal.robot.chain import Chain, read_mechanism
from urdfcal.robot.dh import PARAMETERS, DHTable
from urdfcal.robot.kinematics import joint_motion
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.origins import rewrite_origins
from urdfcal.robot.urdf.urdf import Urdf
from urdfcal.rotations import matrix_to_rpy

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from urdfcal.arrays import Floats

ROWS, FRAMES, OFFSETS = "dh.csv", "dh_frames.csv", "joint_offsets.csv"
POSE = ("x", "y", "z", "roll", "pitch", "yaw")
KINEMATICS, ORIGINS, TRANSMISSIONS = "kinematics.yaml", "origins.yaml", "joint_offsets.ros2_control.xml"
# The URDF's angles round by less; an edited origin differs by more. [m, entries of the rotation]
_SAME = 1e-9
# What ros2_control's SimpleTransmission makes of a position: joint = actuator / reduction + offset.
_TRANSMISSION = """\
  <transmission name="{joint}_offset">
    <plugin>transmission_interface/SimpleTransmission</plugin>
    <actuator name="{joint}_reading" role="actuator1"/>
    <joint name="{joint}" role="joint1">
      <mechanical_reduction>1.0</mechanical_reduction>
      <offset>{offset!r}</offset>
    </joint>
  </transmission>
"""
_INSTRUCTION = """\
# Calibrated joint origins, m and rad; calibration.json has sha256 {sha256}.
# In the xacro file, once:
#   <xacro:property name="calibrated" value="${{xacro.load_yaml('{file}')}}"/>
# In each joint below, instead of its <origin>:
#   <origin xyz="${{calibrated['{joint}']['xyz']}}" rpy="${{calibrated['{joint}']['rpy']}}"/>
# Or leave the xacro file alone, and correct what it expands to: urdfcal apply OUT robot.urdf
"""


def corrected_urdf(calibration: Calibration, folder: Path) -> Urdf:
    """Read the corrected URDF that was written with a calibration.

    Args:
        calibration: as loaded.
        folder: of the results.

    Raises:
        OutputError: it is not there, or its origins are not the calibration's.
        RobotError: it is no valid URDF.
    """
    path = folder / corrected_name(calibration.document.robot.urdf)
    if not path.is_file():
        raise OutputError(
            "the corrected URDF is not beside calibration.json",
            where=str(path),
            remedy="Name the folder that `urdfcal calibrate` wrote.",
        )
    urdf, chain = Urdf.read(path), calibration.chain
    found = read_mechanism(urdf, [tip.link for tip in chain.tips], chain.base_link)
    placed = dict(zip(found.names, found.placements, strict=True))
    for name, calibrated in zip(chain.names, calibration.placements, strict=True):
        if name not in placed or not np.allclose(placed[name], calibrated, rtol=0.0, atol=_SAME):
            raise OutputError(
                f"joint {name!r} is not placed as calibration.json says",
                where=str(path),
                remedy="One of the two files was edited: calibrate again.",
            )
    return urdf


def ros_kinematics(calibration: Calibration, keys: Mapping[str, str]) -> dict[str, str]:
    """Write ``kinematics: {key: {x, y, z, roll, pitch, yaw}, hash: ...}``, as ur_description's default_kinematics.yaml.

    Args:
        calibration: the result.
        keys: what the description calls each joint's origin, by joint.

    Returns:
        The file, by name; origins in the parent link's frame [m, rad], the hash of calibration.json.
    """
    origins: dict[str, Any] = {
        keys[joint]: dict(zip(POSE, [*T.xyz, *T.rpy], strict=True))
        for joint, T in calibration.document.placements.items()
    }
    document = {"kinematics": {**origins, "hash": f"urdfcal_{calibration.sha256}"}}
    return {KINEMATICS: yaml.safe_dump(document, sort_keys=False, allow_unicode=True)}


def joint_keys(calibration: Calibration) -> dict[str, str]:
    """Origins named by their joints."""
    return {name: name for name in calibration.chain.names}


def link_keys(calibration: Calibration, urdf: Urdf) -> dict[str, str]:
    """Origins named by the links that they place, without ``_link``: as Universal Robots' description names them."""
    return {name: urdf.joints[name].child.removesuffix("_link") for name in calibration.chain.names}


def xacro_patch(calibration: Calibration) -> dict[str, str]:
    """Write the origins, in the parent link's frame, with the instruction how to use them above.

    Args:
        calibration: the result.

    Returns:
        The file, by name.
    """
    placements = calibration.document.placements
    origins = {joint: {key: " ".join(map(repr, values)) for key, values in T} for joint, T in placements.items()}
    instruction = _INSTRUCTION.format(sha256=calibration.sha256, file=ORIGINS, joint=calibration.chain.names[-1])
    return {ORIGINS: instruction + yaml.safe_dump(origins, sort_keys=False, allow_unicode=True, width=200)}


def dh_csv(calibration: Calibration) -> dict[str, str]:
    """Write the calibrated standard DH rows, and the constant frames before and after them.

    FK = base * prod(Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)) * tool, with q added to theta, for a prismatic joint to
    d. The rows are the nominal ones and their offsets: derived anew from the calibrated arm, common normals of almost
    parallel axes would jump.

    Args:
        calibration: the result.

    Returns:
        The rows in m and rad, each with its offset from the nominal one and its standard deviation (none where a
        parameter was fixed), and base and tool as x y z roll pitch yaw; by file name.

    Raises:
        OutputError: whole placements were estimated, which are no DH rows, or the joints branch.
    """
    table, offsets = dh_rows(calibration)
    sigmas = _sigmas(calibration)
    header = ["joint", "type", *PARAMETERS, *(f"{n}_offset" for n in PARAMETERS), *(f"{n}_sigma" for n in PARAMETERS)]
    rows = [
        [row.joint, row.type, *values, *offset, *(sigmas.get((row.joint, name), "") for name in PARAMETERS)]
        for row, values, offset in zip(
            table.rows, (table.nominal + offsets + 0.0).tolist(), offsets.tolist(), strict=True
        )
    ]
    frames = [
        [name, *(np.concatenate([T[:3, 3], matrix_to_rpy(T[:3, :3])]) + 0.0).tolist()]
        for name, T in (("base", table.base), ("tool", table.tool))
    ]
    return {ROWS: csv_text(header, rows), FRAMES: csv_text(["frame", *POSE], frames)}


def dh_rows(calibration: Calibration) -> tuple[DHTable, Floats]:
    """The nominal DH rows of a calibrated chain, and what is added to them (n, 5). [rad, m].

    Raises:
        OutputError: whole placements were estimated, which are no DH rows, or the joints branch.
    """
    offsets = calibration.dh_offsets
    if offsets is None:
        raise OutputError(
            "whole placements were estimated, which no DH rows can express",
            remedy="Calibrate with `estimate: {geometry: dh}`, or export origins: --to ros-kinematics.",
        )
    chain = calibration.chain
    if not isinstance(chain, Chain):
        raise OutputError(
            "a tree of joints is no table of DH rows",
            remedy="calibration.json has its rows; export origins: --to ros-kinematics.",
        )
    return DHTable.from_chain(chain), offsets


def joint_offsets(calibration: Calibration, urdf: Urdf) -> dict[str, bytes]:
    """Take the joints' zero offsets out of the corrected URDF, and write them down.

    A controller in which they are entered reads ``reading + offset``; with such readings the second file moves as the
    corrected URDF does with the old ones. A joint that mimics another follows the new reading: its origin makes up
    for that.

    Args:
        calibration: the result.
        urdf: the corrected one, with the offsets in its origins.

    Returns:
        Table of offsets (rad or m) and URDF without them, by file name.

    Raises:
        OutputError: whole placements were estimated, which have no zero offsets of their own.
    """
    chain, offsets = calibration.chain, zero_offsets(calibration)
    # What every joint's value grows by when the readings do.
    growth = chain.reading_jacobian @ offsets
    origins = {
        joint.name: urdf.joints[joint.name].T_parent_joint @ joint_motion(joint, -value)
        for joint, value in zip(chain.joints, growth, strict=True)
        if value
    }
    sigmas, rows = _sigmas(calibration), []
    sliding = {joint.name for joint in chain.joints if joint.prismatic}
    for name, value in zip(chain.actuated, offsets.tolist(), strict=True):
        unit, variable = ("m", "d") if name in sliding else ("rad", "theta")
        rows.append([name, unit, value, sigmas.get((name, variable), "")])
    stem = urdf.path.stem if urdf.path else urdf.name
    return {
        OFFSETS: csv_text(["joint", "unit", "offset", "sigma"], rows).encode(),
        TRANSMISSIONS: _transmissions({name: offset for name, _, offset, _ in rows}),
        f"{stem}_without_offsets.urdf": rewrite_origins(urdf, origins),
    }


def _transmissions(offsets: Mapping[str, float]) -> bytes:
    """Zero offsets (rad, m) as ros2_control takes them: for the <ros2_control> element of a robot's description."""
    each = (_TRANSMISSION.format(joint=escape(name, {'"': "&quot;"}), offset=of) for name, of in offsets.items() if of)
    return f"<transmissions>\n{''.join(each)}</transmissions>\n".encode()


def region_urdf(calibration: Calibration, urdf: Urdf, placements: Floats) -> dict[str, str | bytes]:
    """Write other placements than the calibrated ones into the corrected URDF: of the best rigid arm for a region.

    Args:
        calibration: the result.
        urdf: the corrected one.
        placements: (n, 4, 4) of the calibrated joints. [m]

    Returns:
        The URDF by its file name; that of the whole result where nothing differs.
    """
    each = zip(calibration.chain.names, calibration.placements, placements, strict=True)
    origins = {
        name: urdf.joints[name].T_parent_joint @ inverse(old) @ new for name, old, new in each if np.any(old != new)
    }
    stem = urdf.path.stem if urdf.path else urdf.name
    return {f"{stem}_region.urdf": rewrite_origins(urdf, origins)}


def zero_offsets(calibration: Calibration) -> Floats:
    """(k,) zero offset of each actuated joint: the real value is the reading and it. [rad or m].

    Raises:
        OutputError: whole placements were estimated.
    """
    offsets = calibration.dh_offsets
    if offsets is None:
        raise OutputError(
            "whole placements were estimated, in which zero offsets are no parameters of their own",
            remedy="Calibrate with `estimate: {geometry: dh}` or `offsets`.",
        )
    table = rows_of(calibration.chain)
    own = {table.labels[row]: offsets[row, PARAMETERS.index(name)] for row, name in table.zeros}
    return np.array([own[name] for name in calibration.chain.actuated])


def _sigmas(calibration: Calibration) -> dict[tuple[str, str], float]:
    """Standard deviations by joint and parameter, of those that were estimated."""
    return {(entry.joint, entry.parameter): entry.sigma for entry in calibration.document.dh if entry.sigma is not None}
