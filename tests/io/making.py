"""A small valid session, written by hand: what the tests of the readers break."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from urdfcal.cameras.camera import Camera
from urdfcal.robot.chain import Chain
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf.urdf import Urdf

if TYPE_CHECKING:
    from pathlib import Path

URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="turret"/>
  <link name="upper"/>
  <link name="fore"/>
  <link name="carriage"/>
  <link name="wrist"/>
  <link name="tip"/>
  <link name="finger"/>
  <joint name="waist" type="revolute">
    <origin xyz="0 0 0.4"/>
    <parent link="base"/>
    <child link="turret"/>
    <axis xyz="0 0 1"/>
    <limit lower="-2.9" upper="2.9" effort="1" velocity="1"/>
  </joint>
  <joint name="shoulder" type="revolute">
    <origin xyz="0.1 0 0" rpy="-1.5707963267948966 0 0"/>
    <parent link="turret"/>
    <child link="upper"/>
    <axis xyz="0 0 1"/>
    <limit lower="-1.8" upper="1.8" effort="1" velocity="1"/>
  </joint>
  <joint name="elbow" type="revolute">
    <origin xyz="0.4 0 0"/>
    <parent link="upper"/>
    <child link="fore"/>
    <axis xyz="0 0 1"/>
    <limit lower="-2.5" upper="2.5" effort="1" velocity="1"/>
    <mimic joint="shoulder" multiplier="-1.5" offset="0.1"/>
  </joint>
  <joint name="slide" type="prismatic">
    <origin xyz="0.2 0 0" rpy="0 1.5707963267948966 0"/>
    <parent link="fore"/>
    <child link="carriage"/>
    <axis xyz="0 0 1"/>
    <limit lower="0" upper="0.3" effort="1" velocity="1"/>
  </joint>
  <joint name="roll" type="continuous">
    <parent link="carriage"/>
    <child link="wrist"/>
    <axis xyz="0 0 1"/>
  </joint>
  <joint name="flange" type="fixed">
    <origin xyz="0 0 0.1"/>
    <parent link="wrist"/>
    <child link="tip"/>
  </joint>
  <joint name="grip" type="prismatic">
    <parent link="tip"/>
    <child link="finger"/>
    <axis xyz="1 0 0"/>
    <limit lower="0" upper="0.05" effort="1" velocity="1"/>
  </joint>
</robot>
"""

SESSION = """robot:
  urdf: arm.urdf
  base_link: base
  tip_link: tip
leds:
  red: {position: [0.05, 0.02, 0.03], sigma: 0.005}
  blue: {}
cameras: cameras.yaml
joints: joints.csv
detections: detections.csv
noise: {pixel: 0.1}
"""

RESOLUTION = (1280, 1024)
INTRINSICS = (1400.0, 1400.0, 640.0, 512.0)
LEDS = np.array([[0.05, 0.02, 0.03], [-0.04, 0.06, 0.01]])
NAMES = ("red", "blue")
POSES = 8
ACTUATED = ("waist", "shoulder", "slide", "roll")


def looking(position: list[float], target: list[float]) -> np.ndarray:
    """T_cam_base of a camera that stands at a place and looks at another, upright."""
    z = np.subtract(target, position)
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = [x, np.cross(z, x), z]
    T[:3, 3] = -T[:3, :3] @ position
    return T


TARGET = [0.6, 0.0, 0.5]
T_LEFT_BASE = looking([2.4, 0.3, 0.9], TARGET)
T_RIGHT_BASE = looking([2.4, -0.3, 0.9], TARGET)
T_RIGHT_LEFT = T_RIGHT_BASE @ np.linalg.inv(T_LEFT_BASE)


def measured(poses: int = POSES, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Joint readings (poses, 4) and what both cameras saw of both LEDs, (poses, 2 cameras, 2 LEDs, 2) px."""
    rng = np.random.default_rng(seed)
    readings = np.round(rng.uniform([-0.5, -0.3, 0.02, -3.0], [0.5, 0.3, 0.28, 3.0], (poses, 4)), 4)
    chain = Chain.from_urdf(Urdf.parse(URDF.encode()), "tip", "base")
    T_base_tip = tip_poses(chain, chain.joint_values(readings))
    points = np.einsum("nij,lj->nli", T_base_tip[:, :3, :3], LEDS) + T_base_tip[:, None, :3, 3]
    camera = Camera("any", RESOLUTION, np.array(INTRINSICS))
    uv = np.stack([camera.project(points @ T[:3, :3].T + T[:3, 3]) for T in (T_LEFT_BASE, T_RIGHT_BASE)], axis=1)
    uv += rng.normal(0.0, 0.1, uv.shape)
    return readings, np.round(uv, 3)


def write_valid(folder: Path, poses: int = POSES, seed: int = 0) -> Path:
    """Write the session; its LEDs are seen by both cameras in every pose."""
    readings, uv = measured(poses, seed)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text(URDF)
    (folder / "session.yaml").write_text(SESSION)
    rows = [",".join(["pose", *ACTUATED])]
    rows += [",".join([str(i), *map(str, reading)]) for i, reading in enumerate(readings.tolist())]
    (folder / "joints.csv").write_text("\n".join(rows) + "\n")
    rows = ["pose,camera,led,u,v"]
    for (i, c, led), _ in np.ndenumerate(uv[..., 0]):
        u, v = uv[i, c, led].tolist()
        rows.append(f"{i},{('left', 'right')[c]},{NAMES[led]},{u},{v}")
    (folder / "detections.csv").write_text("\n".join(rows) + "\n")
    write_cameras(folder / "cameras.yaml")
    return folder


def write_cameras(path: Path, *, placed: bool = True) -> None:
    lines = []
    for name in ("left", "right"):
        lines += [
            f"{name}:",
            "  camera_model: pinhole",
            f"  intrinsics: {list(INTRINSICS)}",
            "  distortion_model: none",
            "  distortion_coeffs: []",
            f"  resolution: {list(RESOLUTION)}",
        ]
    if placed:
        lines.append(f"  T_cn_cnm1: {T_RIGHT_LEFT.tolist()}")
    path.write_text("\n".join(lines) + "\n")


def write_points(folder: Path, poses: int = POSES, seed: int = 0) -> Path:
    """The same session, measured by a tracker at the base instead of cameras."""
    write_valid(folder, poses, seed)
    chain = Chain.from_urdf(folder / "arm.urdf", "tip", "base")
    readings, _ = measured(poses, seed)
    T_base_tip = tip_poses(chain, chain.joint_values(readings))
    rows = ["pose,led,x,y,z"]
    for i, T in enumerate(T_base_tip):
        for name, led in zip(NAMES, LEDS, strict=True):
            rows.append(",".join([str(i), name, *(f"{x:.6f}" for x in T[:3, :3] @ led + T[:3, 3])]))
    (folder / "points.csv").write_text("\n".join(rows) + "\n")
    (folder / "detections.csv").unlink()
    (folder / "cameras.yaml").unlink()
    text = SESSION.replace("cameras: cameras.yaml\n", "").replace("detections: detections.csv", "points: points.csv")
    (folder / "session.yaml").write_text(text.replace("pixel: 0.1", "point: 1e-4"))
    return folder
