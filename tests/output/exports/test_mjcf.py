from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from urdfcal.arrays import inverse
from urdfcal.errors import OutputError, RobotError
from urdfcal.output.exports.mjcf import mjcf
from urdfcal.result.calibration import Calibration
from urdfcal.robot.chain import Tree
from urdfcal.robot.kinematics import joint_motion, tip_poses
from urdfcal.robot.mechanism import BASE, Tip
from urdfcal.robot.urdf.origins import origins_of, rewrite_origins

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.output.exports.conftest import Result
    from urdfcal.robot.chain import Chain


def numbers(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def quaternion(R: np.ndarray) -> np.ndarray:
    x, y, z, w = pin.Quaternion(R).coeffs()
    return np.array([w, x, y, z])


def euler_xyz(R: np.ndarray) -> np.ndarray:
    """Angles of MuJoCo's default sequence, R = Rx Ry Rz, in degrees."""
    return np.degrees(
        [np.arctan2(-R[1, 2], R[2, 2]), np.arcsin(np.clip(R[0, 2], -1, 1)), np.arctan2(-R[0, 1], R[0, 0])]
    )


def as_quat(R: np.ndarray) -> str:
    return f'quat="{numbers(quaternion(R))}"'


def as_euler(R: np.ndarray) -> str:
    return f"euler='{numbers(euler_xyz(R))}'" if np.abs(R[0, 2]) < 0.999 else as_quat(R)


def as_axes(R: np.ndarray) -> str:
    return f'xyaxes="{numbers(R[:, 0])}  {numbers(R[:, 1])}"'


def as_axis_angle(R: np.ndarray) -> str:
    v = pin.log3(R)
    angle = np.linalg.norm(v)
    return f'axisangle="{numbers(v / angle)} {float(np.degrees(angle))!r}"' if angle > 1e-9 else ""


class Model:
    """A MuJoCo model of a chain, written by hand with what such files may have."""

    def __init__(self, chain: Chain, rng: np.random.Generator, orientation: Callable, *, plain: bool = False) -> None:
        n = len(chain.joints)
        self.chain = chain
        # Frames of bodies lie anywhere in their link, axes anywhere along the line, zeros anywhere.
        self.C = [np.eye(4) if plain else pin.SE3.Random().homogeneous for _ in range(n)]
        self.ref = np.zeros(n) if plain else rng.uniform(-1.0, 1.0, n)
        lines, close = [], []
        for i, (joint, T) in enumerate(zip(chain.joints, chain.placements, strict=True)):
            T_previous_link = np.eye(4) if i == 0 else self.C[i - 1]
            place = T_previous_link @ T @ joint_motion(joint, self.ref[i]) @ inverse(self.C[i])
            axis = self.C[i][:3, :3] @ joint.axis
            anchor = self.C[i][:3, 3] + (0.0 if plain else 0.1) * axis
            pad = "  " * (i + 2)
            if i == 1 and not plain:
                # What a fixed joint holds may be a body of its own.
                lines.append(f'{pad}<body name="flange" pos="0 0 0.1"><geom size="0.01"/>')
                place = inverse(pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1])).homogeneous) @ place
                close.append(f"{pad}</body>")
            kind = "slide" if joint.prismatic else "hinge"
            ref = self.ref[i] if joint.prismatic else np.degrees(self.ref[i])
            where = f'pos="{numbers(place[:3, 3])}" {orientation(place[:3, :3])}'
            moves = f'type="{kind}" axis="{numbers(axis)}" pos="{numbers(anchor)}" ref="{float(ref)!r}"'
            lines += [
                f'{pad}<body name="body_{i}" {where}> <!-- {i} -->',
                f'{pad}  <joint name="{joint.name}" {moves}/>',
                f'{pad}  <geom size="0.01"/>',
            ]
            close.append(f"{pad}</body>")
        last = self.C[-1] @ chain.T_last_tip
        site = f'<site name="tip" pos="{numbers(last[:3, 3])}" {as_quat(last[:3, :3])}/>'
        self.text = "\n".join(
            [
                "<?xml version='1.0'?>",
                '<mujoco model="arm">',
                "  <!-- pos and quat: <body pos='1 2 3'/> -->",
                '  <default><joint damping="1"/></default>',
                '  <worldbody>',
                f'  <body name="{chain.base_link}" pos="0.3 -0.2 0.1" euler="10 20 30">',
                *lines,
                site,
                *reversed(close),
                "  </body>",
                "  </worldbody>",
                f'  <actuator><motor joint="{chain.joints[0].name}"/></actuator>',
                "</mujoco>",
                "",
            ]
        )  # fmt: skip


def tips(text: bytes, chain: Chain, q: np.ndarray) -> np.ndarray:
    """T_base_tip by MuJoCo."""
    model = mujoco.MjModel.from_xml_string(text.decode())
    data = mujoco.MjData(model)
    result = np.tile(np.eye(4), (len(q), 1, 1))
    for k, q_k in enumerate(q):
        for name, value in zip(chain.names, q_k, strict=True):
            data.joint(name).qpos[0] = value
        mujoco.mj_kinematics(model, data)
        T_world_base, T_world_tip = np.eye(4), np.eye(4)
        base, tip = data.body(chain.base_link), data.site("tip")
        T_world_base[:3, :3], T_world_base[:3, 3] = base.xmat.reshape(3, 3), base.xpos
        T_world_tip[:3, :3], T_world_tip[:3, 3] = tip.xmat.reshape(3, 3), tip.xpos
        result[k] = inverse(T_world_base) @ T_world_tip
    return result


def written(result: Result, folder: Path, text: str) -> bytes:
    path = folder / "arm.xml"
    path.write_text(text)
    ((name, data),) = mjcf(result.calibration, result.urdf, path).items()
    assert name == "arm_calibrated.xml"
    return data


@pytest.mark.parametrize("orientation", [as_quat, as_euler, as_axes, as_axis_angle])
def test_mujoco_moves_the_edited_model_as_the_calibrated_arm(
    orientation: Callable, result: Result, tmp_path: Path
) -> None:
    chain = result.calibration.chain
    q = chain.random_values(20, np.random.default_rng(3))
    for plain in (True, False):
        pin.seed(5)
        model = Model(chain, np.random.default_rng(4), orientation, plain=plain)
        np.testing.assert_allclose(tips(model.text.encode(), chain, q), tip_poses(chain, q), rtol=0, atol=1e-9)
        data = written(result, tmp_path, model.text)
        expected = tip_poses(result.calibration.calibrated, q)
        np.testing.assert_allclose(tips(data, chain, q), expected, rtol=0, atol=1e-9)


def test_nothing_but_pos_and_orientation_of_the_joints_bodies_changes(results: Callable, tmp_path: Path) -> None:
    model = Model(results("ur5").calibration.chain, np.random.default_rng(4), as_euler)
    data = written(results("ur5"), tmp_path, model.text).decode()
    place = re.compile(r' (pos|quat|euler)=(["\']).*?\2')
    before, after = (text.splitlines() for text in (model.text, data))
    assert len(before) == len(after)
    changed = {i for i, (a, b) in enumerate(zip(before, after, strict=True)) if a != b}
    assert len(changed) == 5  # the first joint is as drawn
    for i in changed:
        assert 'name="body_' in before[i]
        assert place.sub("", before[i]) == place.sub("", after[i])


def test_base_frames_of_links_that_are_fixed_to_the_base_are_found(results: Callable, tmp_path: Path) -> None:
    # UR's `base` is turned by half a turn against `base_link`.
    result = results("ur5")
    chain = result.calibration.chain
    model = Model(chain, np.random.default_rng(0), as_quat, plain=True)
    T_base = result.urdf.joints["base_link-base_fixed_joint"].T_parent_joint
    first = inverse(T_base) @ chain.placements[0]
    text = model.text.replace(f'<body name="{chain.base_link}"', '<body name="base"')
    text = text.replace(
        next(line for line in text.splitlines() if 'name="body_0"' in line),
        f'<body name="body_0" pos="{numbers(first[:3, 3])}" {as_quat(first[:3, :3])}>',
    )
    q = chain.random_values(5, np.random.default_rng(3))
    data = written(result, tmp_path, text).replace(b'name="base"', b'name="base_link"')
    np.testing.assert_allclose(
        tips(data, chain, q), inverse(T_base) @ tip_poses(result.calibration.calibrated, q), rtol=0, atol=1e-9
    )


def test_a_model_that_mujoco_made_from_the_urdf_is_edited(results: Callable, tmp_path: Path) -> None:
    # It fuses fixed links, puts the base into the world, and writes six digits.
    result = results("elbow3r")
    chain = result.calibration.chain
    drawn = rewrite_origins(result.urdf, origins_of(result.urdf, result.calibration.calibrated, chain.placements))
    urdf = tmp_path / "drawn.urdf"
    urdf.write_bytes(drawn)
    text = mujoco.MjSpec.from_file(str(urdf)).to_xml()
    data = written(result, tmp_path, text)
    model = mujoco.MjModel.from_xml_string(data.decode())
    state = mujoco.MjData(model)
    last, q = model.joint(chain.names[-1]).bodyid[0], chain.random_values(5, np.random.default_rng(3))
    for q_k, T in zip(q, tip_poses(result.calibration.calibrated, q), strict=True):
        state.qpos[:] = q_k
        mujoco.mj_kinematics(model, state)
        T_link = T @ inverse(chain.T_last_tip)
        np.testing.assert_allclose(state.xpos[last], T_link[:3, 3], atol=1e-5)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda t: t.replace('<joint name="elbow_joint"', '<joint name="elbow"'), "no joint 'elbow_joint'.*elbow"),
        (lambda t: t.replace('name="elbow_joint" type="hinge"', 'name="elbow_joint" type="slide"'), "not a revolute"),
        (lambda t: t.replace('<geom size="0.01"/>', '<joint name="x"/><geom size="0.01"/>', 1), "has 2 joints"),
        (lambda t: t.replace('name="body_2" pos="', 'name="body_2" pos="1 0 0" user="'), "axis of joint 'elbow_joint'"),
        (lambda t: t.replace("<worldbody>", '<include file="other.xml"/><worldbody>'), ":5: it includes another file"),
        (lambda t: t.replace("<default>", '<compiler fusestatic="true"/><default>'), ":4: fusestatic"),
        (lambda t: t.replace("mujoco", "robot"), "root element is <robot>"),
        (lambda t: t.replace("</mujoco>", ""), "not well-formed"),
        (lambda t: t.replace("<mujoco", '<!DOCTYPE a [<!ENTITY e "x">]><mujoco'), "document type"),
        (lambda t: t.replace("<actuator>", "<actuators>").replace("</actuator>", "</actuators>"), "MuJoCo cannot load"),
        (
            lambda t: t.replace('<body name="body_5"', '<frame><body name="body_5"').replace(
                "</body>", "</body></frame>", 1
            ),
            "body of joint 'wrist_3_joint' is inside <frame>",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_edited_truthfully_is_refused(
    edit: Callable[[str], str], message: str, results: Callable, tmp_path: Path
) -> None:
    model = Model(results("ur5").calibration.chain, np.random.default_rng(4), as_quat)
    text = edit(model.text)
    assert text != model.text
    with pytest.raises(RobotError, match=message):
        written(results("ur5"), tmp_path, text)


def test_meshes_are_found_from_the_models_folder(results: Callable, tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "m.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    model = Model(results("ur5").calibration.chain, np.random.default_rng(4), as_quat)
    text = model.text.replace("<default>", '<compiler meshdir="assets"/><asset><mesh file="m.obj"/></asset><default>')
    text = text.replace("<site", '<geom type="mesh" mesh="m"/><site')
    assert b'mesh="m"' in written(results("ur5"), tmp_path, text)
    (tmp_path / "assets" / "m.obj").unlink()
    with pytest.raises(RobotError, match=r"MuJoCo cannot load it.*m\.obj"):
        written(results("ur5"), tmp_path, text)


def test_a_model_is_not_calibrated_twice(results: Callable, tmp_path: Path) -> None:
    result = results("ur5")
    model = Model(result.calibration.chain, np.random.default_rng(4), as_quat)
    once = written(result, tmp_path, model.text).decode()
    with pytest.raises(RobotError, match="as calibrated already"):
        written(result, tmp_path, once)


def test_an_axis_that_points_the_other_way_is_another_robot(results: Callable, tmp_path: Path) -> None:
    result = results("ur5")
    chain = result.calibration.chain
    joints = (*chain.joints[:3], replace(chain.joints[3], axis=-chain.joints[3].axis), *chain.joints[4:])
    model = Model(replace(chain, joints=joints), np.random.default_rng(4), as_quat)
    with pytest.raises(RobotError, match=r"'wrist_1_joint' is not where it was when.*3.14e"):
        written(result, tmp_path, model.text)


def test_a_defect_shows_where_something_is_fixed_to_the_base_link(
    results: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What no body carries must not stand for the last joint's: nothing would be found wrong beside its error.
    result = results("ur5")
    chain = result.calibration.chain
    tree = Tree(
        chain.name,
        chain.base_link,
        chain.joints,
        chain.parents,
        chain.placements,
        (chain.tips[0], Tip("base", BASE, np.eye(4))),
    )
    path = tmp_path / "arm.xml"
    path.write_text(Model(chain, np.random.default_rng(4), as_quat).text)
    calibration = Calibration(result.calibration.document)
    calibration.__dict__["chain"] = tree  # in place of what the cached property would give
    q = chain.random_values(5, np.random.default_rng(3))
    (data,) = mjcf(calibration, result.urdf, path).values()
    np.testing.assert_allclose(tips(data, chain, q), tip_poses(result.calibration.calibrated, q), rtol=0, atol=1e-9)
    monkeypatch.setattr("urdfcal.output.exports.mjcf.with_places", lambda *_: path.read_bytes())
    with pytest.raises(OutputError, match="does not move as the calibrated robot"):
        mjcf(calibration, result.urdf, path)
