"""A session measured on a robot that exists only here, so that its truth is known."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, Ints, frozen, inverse
from urdfcal.errors import RobotError, SessionError
from urdfcal.estimation.measurements import Detections
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.origins import origins_of, rewrite_origins
from urdfcal.session.model import MIN_POSES, Session, Setup
from urdfcal.simulation.collision import Clearance
from urdfcal.simulation.geometric_errors import draw_offsets
from urdfcal.simulation.pose_sampling import choose_poses
from urdfcal.simulation.scene import Scene, look_at
from urdfcal.simulation.truth import Simulated, Truth, write_simulated

if TYPE_CHECKING:
    from collections.abc import Callable

    from urdfcal.session.model import RigDescription

__all__ = ["Simulated", "Truth", "simulate", "write_simulated"]

# A tripod put up by tape measure and eye. [m, rad]
_STAND_SIGMA = np.array([3e-3] * 3 + [3e-3] * 3)
# Of an LED whose place is given without saying how well: by ruler. [m]
_LED_SIGMA = 5e-3
# From a blob found with a reflection in it, to the wrong blob. [px]
_OUTLIERS = (5.0, 200.0)


def simulate(
    rig: RigDescription,
    *,
    seed: int,
    poses: int = 50,
    pixel: float | None = None,
    error_scale: float = 1.0,
    outliers: float = 0.0,
    progress: Callable[[int], object] | None = None,
) -> Simulated:
    """Build a robot that differs from its drawing, put it before the cameras, and measure.

    Poses are planned on the robot as drawn, as a user would. Robot, stand, LEDs, poses and the kinds of noise
    are drawn independently: another ``pixel`` or ``error_scale`` leaves all else as it was.

    Args:
        rig: the robot, its LEDs and its cameras.
        seed: of all that is random.
        poses: how many to measure.
        pixel: noise of the sightings, one standard deviation, instead of the rig's; without noise (0) the
            session goes on to declare the rig's. [px]
        error_scale: factor on how far the robot is from its drawing.
        outliers: share of the sightings moved by 5 to 200 px.
        progress: called with the number of poses found since the last call.

    Raises:
        SessionError: an argument makes no sense, the rig lacks what only a calibration can do without, or there
            are not enough poses.
        RobotError: the corrected URDF cannot be written.
    """
    _check_arguments(seed, poses, pixel, error_scale, outliers)
    planned = _planned(rig)
    robot, stand, bulbs, posing, encoders, pixels, blunders = np.random.default_rng(seed).spawn(7)

    table = rows_of(rig.chain)
    offsets = error_scale * draw_offsets(table, robot)
    sigma = [_LED_SIGMA if led.sigma is None else led.sigma for led in rig.leds]
    true = replace(
        planned,
        placements=table.placements(offsets),
        T_world_base=_stood(rig, planned.T_world_base, stand.normal(0.0, _STAND_SIGMA)),
        leds=planned.leds + bulbs.standard_normal(planned.leds.shape) * np.array(sigma)[:, None],
        T_cam_frame=_fastened(rig, planned.T_cam_frame, bulbs),
    )

    clearance, warnings = find_clearance(planned, rig)
    q = choose_poses(planned, clearance, poses, posing, progress)
    noise = rig.noise if not pixel else replace(rig.noise, pixel=pixel)
    pixel = rig.noise.pixel if pixel is None else pixel
    pose, camera, led, uv = _watch(true, q, pixel, pixels)
    outlying = mistake(true, uv, camera, outliers, blunders)
    session = Session(
        **{field.name: getattr(rig, field.name) for field in fields(Setup)}
        | {"noise": noise, "sha256": {}, "folder": None},
        poses=tuple(f"{k:0{len(str(poses))}d}" for k in range(1, poses + 1)),
        q=_read(rig, q, encoders),
        measurements=(Detections(pose, camera, led, uv, np.array(noise.pixel)),),
        warnings=warnings,
    )
    truth = Truth(
        seed=seed,
        pixel=pixel,
        error_scale=error_scale,
        outlier_share=outliers,
        offsets=frozen(offsets),
        placements=frozen(true.placements),
        T_world_base=frozen(true.T_world_base),
        leds=frozen(true.leds),
        T_cam_frame=frozen(true.T_cam_frame),
        q=frozen(q),
        outliers=frozen(outlying, np.intp),
        urdf=_true_urdf(rig, true.placements),
    )
    return Simulated(session, truth)


def _check_arguments(seed: int, poses: int, pixel: float | None, error_scale: float, outliers: float) -> None:
    where = "simulate"
    if seed < 0:
        raise SessionError(f"seed is {seed}, not a whole number from 0 up", where=where)
    if poses < MIN_POSES:
        raise SessionError(f"poses is {poses}: a session needs at least {MIN_POSES}", where=where)
    if pixel is not None and not 0.0 <= pixel < np.inf:
        raise SessionError(f"pixel is {pixel}, not a standard deviation", where=where)
    if not 0.0 <= error_scale < np.inf:
        raise SessionError(f"error_scale is {error_scale}, not a factor from 0 up", where=where)
    if not 0.0 <= outliers <= 1.0:
        raise SessionError(f"outliers is {outliers}, not a share from 0 to 1", where=where, remedy="5 % are 0.05.")


def _planned(rig: RigDescription) -> Scene:
    """The scene as drawn and as the stand was meant."""
    if not rig.rig.cameras:
        raise SessionError("the rig has no cameras", where="cameras")
    placed = [T for T in rig.attachments.T_cam_frame if T is not None]
    if len(placed) < len(rig.rig.cameras):
        unknown = next(name for name, T in zip(rig.rig.names, rig.attachments.T_cam_frame, strict=True) if T is None)
        raise SessionError(
            f"where {unknown!r} stands is not given",
            where="cameras",
            remedy="Simulating needs T_cn_cnm1 of every camera but the first, or its place on its link.",
        )
    positions = [led.position for led in rig.leds if led.position is not None]
    if len(positions) < len(rig.leds):
        unknown = next(led.name for led in rig.leds if led.position is None)
        raise SessionError(
            "an LED has no position", where=f"leds, {unknown}", remedy="Simulating needs it, if only roughly."
        )
    return Scene(
        chain=rig.chain,
        placements=rig.chain.placements,
        attachments=rig.attachments,
        leds=np.array(positions),
        T_world_base=_planned_stand(rig),
        cameras=rig.rig.cameras,
        T_cam_frame=np.array(placed),
    )


def _planned_stand(rig: RigDescription) -> Floats:
    """T_world_base (4, 4); where all cameras ride on the robot, its base is the world."""
    if not len(rig.attachments.eye_to_hand):
        return np.eye(4)
    if rig.stand is None:
        raise SessionError("where the first camera stands is not given", where="stand")
    return inverse(look_at(rig.stand.position, rig.stand.look_at))


def _stood(rig: RigDescription, T_world_base: Floats, motion: Floats) -> Floats:
    """Where the robot truly stands before cameras that were put up by hand."""
    return T_world_base @ _nudge(motion) if len(rig.attachments.eye_to_hand) else T_world_base


def _fastened(rig: RigDescription, T_cam_frame: Floats, rng: np.random.Generator) -> Floats:
    """How riding cameras are truly fastened to their links; the others in a frame go with the first."""
    frames, names = rig.attachments, rig.rig.names
    sigma = {mount.camera: _STAND_SIGMA if mount.sigma is None else mount.sigma for mount in rig.mounts}
    true = np.array(T_cam_frame)
    for c in np.flatnonzero((frames.camera != 0) & (frames.reference == np.arange(len(names)))):
        moved = _nudge(rng.normal(0.0, sigma[names[c]])) @ T_cam_frame[c]
        for k in np.flatnonzero(frames.reference == c):
            true[k] = T_cam_frame[k] @ inverse(T_cam_frame[c]) @ moved
    return true


def true_scene(simulated: Simulated) -> Scene:
    """The robot as it truly is and its cameras.

    Raises:
        SessionError: there are no cameras.
    """
    session, truth = simulated.session, simulated.truth
    if not session.rig.cameras:
        raise SessionError("there are no cameras", where="simulate")
    return Scene(
        session.chain,
        truth.placements,
        session.attachments,
        truth.leds,
        truth.T_world_base,
        session.rig.cameras,
        truth.T_cam_frame,
    )


def find_clearance(planned: Scene, rig: Setup) -> tuple[Clearance | None, tuple[str, ...]]:
    """The arm's collision geometry, and what to warn of when it is not to be had."""
    if rig.urdf is None:
        return None, ("no URDF: the poses were not checked for collisions",)
    try:
        clearance = Clearance(rig.chain, rig.urdf, *planned.fastened())
    except RobotError as error:
        return None, (f"the poses were not checked for collisions: {error}",)
    if clearance.empty:
        return None, (f"{rig.urdf_reference}: no collision geometry, the poses were not checked",)
    return clearance, ()


def _nudge(motion: Floats) -> Floats:
    T: Floats = pin.exp6(pin.Motion(motion)).homogeneous
    return T


def _read(rig: RigDescription, q: Floats, rng: np.random.Generator) -> Floats:
    """What the encoders say of true joint values: mimic joints have none."""
    own = [i for i, joint in enumerate(rig.chain.joints) if joint.mimic is None]
    return rig.chain.joint_values(q[:, own] + rig.noise.joint * rng.standard_normal((len(q), len(own))))


def _watch(scene: Scene, q: Floats, sigma: float, rng: np.random.Generator) -> tuple[Ints, Ints, Ints, Floats]:
    """Pose, camera, LED and pixel of every sighting; what falls out of an image is missing."""
    uv = scene.images(q)
    uv = uv + sigma * rng.standard_normal(uv.shape)
    inside = np.stack([camera.in_image(uv[:, c]) for c, camera in enumerate(scene.cameras)], axis=1)
    pose, camera, led = np.nonzero(inside)
    return pose, camera, led, uv[inside]


def mistake(scene: Scene, uv: Floats, camera: Ints, share: float, rng: np.random.Generator) -> Ints:
    """Move a share of the sightings ``uv`` (S, 2) in place, within their images, and say which."""
    rows = np.sort(rng.choice(len(uv), round(share * len(uv)), replace=False))
    for row in rows:
        seen = uv[row].copy()
        while True:
            angle, distance = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*_OUTLIERS)
            uv[row] = seen + distance * np.array([np.cos(angle), np.sin(angle)])
            if scene.cameras[camera[row]].in_image(uv[row]):
                break
    return rows


def _true_urdf(rig: RigDescription, placements: Floats) -> bytes:
    if rig.urdf is None:
        return b""
    return rewrite_origins(rig.urdf, origins_of(rig.urdf, rig.chain, placements))
