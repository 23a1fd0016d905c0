"""The geometry of a robot and its cameras, nominal or true: from joint values to pixels, and to noisy detections."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.arrays import Bools, Floats, Ints, frozen, inverse
from urdfcal.estimation.measurements import Detections
from urdfcal.robot.flexure import spread_placements, with_flexures, without_flexures
from urdfcal.robot.kinematics import link_poses
from urdfcal.robot.mechanism import BASE, Tip

if TYPE_CHECKING:
    from typing_extensions import Self

    from urdfcal.cameras.camera import Camera
    from urdfcal.robot.mechanism import Mechanism
    from urdfcal.session.attachments import Attachments
    from urdfcal.session.model import Setup

# From a blob found with a reflection in it, to the wrong blob. [px]
_OUTLIERS = (5.0, 200.0)
# Cosine of how far a target may turn away: beyond 60 degrees its squares are half as wide as high, and few are found.
_FACING = 0.5


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot with its LEDs and the cameras that see them.

    Attributes:
        chain: the robot.
        placements: (n, 4, 4) its joint placements, used instead of the chain's own. [m]
        attachments: what LEDs and cameras are attached to.
        leds: (L + M, 3) LEDs and points of targets, in the frames they are fixed in. [m]
        targets: (T, 4, 4) each target in the frame that carries it. [m]
        T_world_base: (4, 4) where the robot stands; the world is the first standing camera's frame. [m]
        cameras: C of them.
        T_cam_frame: (C, 4, 4) in each camera the frame that it is fixed in: the world, or its link. [m]
    """

    chain: Mechanism
    placements: Floats
    attachments: Attachments
    leds: Floats
    targets: Floats
    T_world_base: Floats
    cameras: tuple[Camera, ...]
    T_cam_frame: Floats

    def __post_init__(self) -> None:
        for name in ("placements", "leds", "targets", "T_world_base", "T_cam_frame"):
            object.__setattr__(self, name, frozen(getattr(self, name)))

    def with_flexures(self) -> Self:
        """Return the same scene with flexures in all links of the robot."""
        chain = with_flexures(self.chain, self.chain.actuated)
        return self._of(chain, spread_placements(chain, self.placements))

    def without_flexures(self) -> Self:
        """Return the same scene of links that do not bend."""
        placed = without_flexures(self.chain.with_placements(self.placements))
        return self._of(without_flexures(self.chain), placed.placements)

    def _of(self, chain: Mechanism, placements: Floats) -> Self:
        """The same scene with the robot's joints given otherwise."""
        tips = tuple(chain.tip(tip.link) for tip in self.attachments.tips)
        return replace(self, chain=chain, placements=placements, attachments=replace(self.attachments, tips=tips))

    def camera_centres(self, q: Floats) -> Floats:
        """Return the cameras' centres (N, C, 3) in the base link's frame at joint values ``q`` (N, n). [m]."""
        return np.swapaxes(self.camera_poses(q)[..., :3, 3], 0, 1)

    def camera_poses(self, q: Floats) -> Floats:
        """Return T_base_cam (C, N, 4, 4) at joint values ``q`` (N, n). [m]."""
        return np.asarray(self._frames(q)[self.attachments.camera] @ inverse(self.T_cam_frame)[:, None])

    def points_on_joints(self) -> tuple[list[tuple[int, Floats]], list[tuple[int, Floats]]]:
        """Return for LEDs and for camera centres the joint that carries each, and its position (3,) there. [m]."""
        tips = [Tip("world", BASE, inverse(self.T_world_base)), *self.attachments.tips]
        for T, (name, carrier) in zip(self.targets, self.attachments.carried, strict=True):
            tips.append(Tip(name, tips[carrier].joint, tips[carrier].T_joint_link @ T))
        centres = inverse(self.T_cam_frame)[:, :3, 3]
        leds, cameras = (
            [(tips[f].joint, (tips[f].T_joint_link @ [*p, 1.0])[:3]) for f, p in zip(of, points, strict=True)]
            for of, points in ((self.attachments.led, self.leds), (self.attachments.camera, centres))
        )
        return leds, cameras

    def pixels(self, q: Floats, *, mirrored: bool = False) -> Floats:
        """Project the LEDs at joint values ``q`` (N, n): (N, C, L, 2) px, NaN where a camera cannot see.

        ``mirrored``, their reflections in the plane on which the robot stands.
        """
        points = self._points(q, mirrored=mirrored)
        return np.stack([camera.project(points[:, c]) for c, camera in enumerate(self.cameras)], axis=1)

    def distances(self, q: Floats) -> Floats:
        """Return the distances (N, C, L) from each camera to each LED at joint values ``q`` (N, n). [m]."""
        return np.asarray(np.linalg.norm(self._points(q), axis=-1))

    def target_poses(self, q: Floats) -> Floats:
        """Return T_cam_target (N, C, T, 4, 4) at joint values ``q`` (N, n). [m]."""
        T_base_frame, attachments = self._frames(q), self.attachments
        T_cam_base = self.T_cam_frame[:, None] @ inverse(T_base_frame)[attachments.camera]
        T_base_target = T_base_frame[attachments.first_target :]
        return np.moveaxis(T_cam_base[:, None] @ T_base_target[None], 2, 0)

    def faced(self, q: Floats) -> Bools:
        """Return which targets (N, C, T) show their printed side to which cameras, at up to 60 degrees."""
        T = self.target_poses(q)
        towards = np.sum(T[..., :3, 2] * T[..., :3, 3], axis=-1) / np.linalg.norm(T[..., :3, 3], axis=-1)
        return np.asarray(towards > _FACING)

    def turned_to(self, q: Floats) -> Bools:
        """Return which LEDs and points of targets (N, C, L + M) face which cameras: LEDs shine to all sides."""
        shown = np.ones((len(q), len(self.cameras), len(self.leds)), dtype=bool)
        shown[..., self.led_count :] = self.faced(q)[
            ..., self.attachments.led[self.led_count :] - self.attachments.first_target
        ]
        return shown

    def outlined(self) -> Scene:
        """Return the same scene with only the outermost points of targets: where they are seen, all is."""
        kept, attachments = list(range(self.led_count)), self.attachments
        for frame in range(attachments.first_target, len(attachments.frames)):
            mine = np.flatnonzero(attachments.led == frame)
            if len(mine):
                across = self.leds[mine][:, :2] @ np.array([[1.0, 1.0], [1.0, -1.0]])
                kept += np.unique(mine[[*across.argmin(axis=0), *across.argmax(axis=0)]]).tolist()
        own = {entry.name: getattr(self, entry.name) for entry in fields(Scene)}
        points = self.leds[kept[self.led_count :]].reshape(-1, 3)
        fewer = replace(attachments, led=attachments.led[kept], target_points=points)
        return Scene(**own | {"leds": self.leds[kept], "attachments": fewer})

    @property
    def led_count(self) -> int:
        """Number of LEDs."""
        return len(self.leds) - len(self.attachments.target_points)

    def in_image(self, uv: Floats, margin: float = 0.0) -> Bools:
        """Return which pixels ``uv`` (N, C, L, 2) are in the images of their cameras, ``margin`` px from the border."""
        return np.stack([camera.in_image(uv[:, c], margin) for c, camera in enumerate(self.cameras)], axis=1)

    def _points(self, q: Floats, *, mirrored: bool = False) -> Floats:
        """Return the LEDs (N, C, L, 3) in the cameras' frames. [m]."""
        T_base_frame = self._frames(q)
        p_base = self._leds_in_base(T_base_frame)
        if mirrored:
            p_base = p_base * [1.0, 1.0, -1.0, 1.0]
        T_cam_base = self.T_cam_frame[:, None] @ inverse(T_base_frame)[self.attachments.camera]  # (C, N, 4, 4)
        points = T_cam_base.swapaxes(0, 1)[:, :, None] @ p_base.swapaxes(0, 1)[:, None, :, :, None]
        return np.asarray(points[..., :3, 0])

    def led_positions(self, q: Floats) -> Floats:
        """Return the LEDs (N, L, 3) in the base link's frame at joint values ``q`` (N, n). [m]."""
        return np.asarray(self._leds_in_base(self._frames(q)).swapaxes(0, 1)[..., :3])

    def _leds_in_base(self, T_base_frame: Floats) -> Floats:
        """Return the LEDs (L, N, 4) in homogeneous coordinates. [m]."""
        leds = np.concatenate([self.leds, np.ones((len(self.leds), 1))], axis=1)
        return np.asarray((T_base_frame[self.attachments.led] @ leds[:, None, :, None])[..., 0])

    def _frames(self, q: Floats) -> Floats:
        """Return T_base_frame (F, N, 4, 4) of the world, of links that carry something, and of targets. [m]."""
        links = link_poses(self.chain, q, self.attachments.tips, self.placements)
        frames = [np.broadcast_to(inverse(self.T_world_base), (len(q), 4, 4)), *links]
        frames += [frames[carrier] @ T for T, (_, carrier) in zip(self.targets, self.attachments.carried, strict=True)]
        return np.array(frames)


def look_at(position: Floats, target: Floats) -> Floats:
    """Return T_base_cam (4, 4) of a camera at ``position`` that looks at ``target``, upright as far as that goes.

    Its image's y axis points down along the base frame's z; for a camera that looks along z, along x.
    """
    z = (target - position) / np.linalg.norm(target - position)
    up = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(z, up)) < 1e-6:
        up = np.array([1.0, 0.0, 0.0])
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.column_stack([x, np.cross(z, x), z, position])
    return T


def noisy_values(setup: Setup, q: Floats, rng: np.random.Generator) -> Floats:
    """Return what encoders say of true joint values (N, n): mimic joints have no reading of their own, and follow."""
    readings = setup.chain.readings(q)
    return setup.chain.joint_values(readings + setup.noise.reading * rng.standard_normal(readings.shape))


def simulate_detections(
    scene: Scene,
    q: Floats,
    views: Ints,
    noise: tuple[float, float],
    outliers: float,
    noise_rng: np.random.Generator,
    outlier_rng: np.random.Generator,
    uv: Floats | None = None,
) -> tuple[Detections, Ints]:
    """Detect the LEDs of a scene, and the points of targets that face the camera; what is out of an image is missing.

    Args:
        scene: as it truly is.
        q: (N, n) true joint values of the poses. [rad or m]
        views: (N, K) the cameras that look at each pose.
        noise: one standard deviation, and the one that the detections declare. [px]
        outliers: share of the detections that is moved by 5 to 200 px, within their images.
        noise_rng: the source of the noise.
        outlier_rng: the source of the outliers.
        uv: (N, K, L, 2) where they are truly seen, if that is not where they are. [px]

    Returns:
        The detections, and the rows (K,) of the outliers among them.
    """
    each = np.arange(len(q))[:, None]
    uv, inside = scene.pixels(q)[each, views] if uv is None else uv, scene.turned_to(q)[each, views]
    uv = uv + noise[0] * noise_rng.standard_normal(uv.shape)
    for c, one in enumerate(scene.cameras):
        inside[views == c] &= one.in_image(uv[views == c])
    pose, view, led = np.nonzero(inside)
    camera, uv = views[pose, view], uv[inside]
    rows = np.sort(outlier_rng.choice(len(uv), round(outliers * len(uv)), replace=False))
    for row in rows:
        moved = np.full(2, np.nan)
        while not scene.cameras[camera[row]].in_image(moved):
            moved = uv[row] + any_direction(outlier_rng) * outlier_rng.uniform(*_OUTLIERS)
        uv[row] = moved
    return Detections(pose, camera, led, uv, np.array(noise[1])), rows


def any_direction(rng: np.random.Generator) -> Floats:
    """Draw a unit vector (2,) in the plane."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])
