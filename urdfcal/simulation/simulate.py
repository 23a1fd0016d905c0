"""A session measured on a simulated robot; its truth is written where calibration never reads it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from urdfcal.arrays import Floats, frozen, inverse
from urdfcal.errors import OutputError, SessionError
from urdfcal.estimation.blocks.leds import led_positions
from urdfcal.estimation.joint_models.bending import Bending
from urdfcal.estimation.measurements import Contacts, Detections
from urdfcal.files import write_bytes, write_text
from urdfcal.io.writing import write_session
from urdfcal.robot.dh import PARAMETERS
from urdfcal.robot.tree_dh import rows_of
from urdfcal.robot.urdf.origins import origins_of, rewrite_origins
from urdfcal.session.model import MIN_POSES, Positions
from urdfcal.simulation.joint_errors import draw_joint_errors, true_joint_values
from urdfcal.simulation.planning import load_collision_checker, sample_poses
from urdfcal.simulation.scene import Scene, look_at, noisy_values, simulate_detections
from urdfcal.simulation.touching import touch_places
from urdfcal.simulation.true_prints import draw_prints, printed
from urdfcal.simulation.truth import Simulated, Truth, truth_to_dict

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from urdfcal.estimation.measurements import Measurement
    from urdfcal.robot.dh import DHRow, DHTable
    from urdfcal.session.rig_description import RigDescription

_URDF, _JSON = "truth.urdf", "truth.json"

# A tripod put up by tape measure and eye. [m, rad]
_STAND_SIGMA = np.array([3e-3] * 3 + [3e-3] * 3)
# Of an LED whose position is given without saying how well: by ruler. [m]
_LED_SIGMA = 5e-3
# Root mean squares over five Universal Robots (two UR5, a UR5e, two UR3) of the factory's calibration less the
# data sheet, as their owners published them. Rows 1 to 5: the factory leaves the last row's a and alpha alone.
# Alpha of parallel rows is the largest by far: 11.9 mrad on one UR3, and 2.5 mrad in the median.
_D = 0.76e-3
_A = 0.17e-3
_ALPHA = 0.74e-3
_ALPHA_PARALLEL = 4.5e-3
_BETA_PARALLEL = 1.5e-3
# The same robots leave the factory with zeros adjusted to 0.05 mrad; few others do. An arm that was assembled
# or repaired in the field is off by milliradians, with either sign, and so is every simulated one.
_ZERO_ANGLE = (1e-3, 5e-3)
# What a homing switch repeats to.
_ZERO_LENGTH = (0.2e-3, 0.8e-3)


def simulate(
    rig: RigDescription,
    *,
    seed: int,
    arm_seed: int | None = None,
    poses: int = 50,
    at: tuple[Sequence[str], Floats] | None = None,
    pixel: float | None = None,
    error_scale: float = 1.0,
    outliers: float = 0.0,
    progress: Callable[[int], object] | None = None,
) -> Simulated:
    """Simulate a session of a robot that differs from the nominal one.

    Poses are planned on the nominal robot, as a user would. Robot, stand, LEDs, poses and the kinds of noise
    are drawn independently: another ``pixel`` or ``error_scale`` leaves all else as it was.

    Args:
        rig: the robot, its LEDs and its cameras.
        seed: of all that is random.
        arm_seed: of the true robot alone, instead: sessions with the same one are of the same arm, wherever it stands
            and whatever else they were drawn from.
        poses: how many to measure.
        at: names of poses and their joint values (N, n) to measure instead, whether or not the arm collides there.
            [rad or m]
        pixel: noise of the detections, one standard deviation, instead of the rig's; without noise (0) the
            session goes on to declare the rig's. [px]
        error_scale: factor on how far the robot's geometry is from the nominal one.
        outliers: share of the detections moved by 5 to 200 px.
        progress: called with the number of poses found since the last call.

    Raises:
        SessionError: an argument makes no sense, the rig lacks what only a calibration can do without, or there
            are not enough poses.
        RobotError: the corrected URDF cannot be written.
    """
    names = tuple(f"{k:0{len(str(poses))}d}" for k in range(1, poses + 1))
    names, poses = (names, poses) if at is None else (tuple(at[0]), len(at[0]))
    _check_arguments(seed, poses, pixel, error_scale, outliers)
    if at is not None and rig.places:
        raise SessionError("a rig that touches places finds its poses itself", where="simulate", remedy="Leave at out.")
    if rig.places and (outliers or pixel is not None):
        remedy = "Leave outliers and pixel out; the rig's noise is that of its contacts."
        raise SessionError("there are no pixels: the rig touches places", where="simulate", remedy=remedy)
    nominal = nominal_scene(rig)
    robot_rng, stand_rng, led_rng, pose_rng, joint_rng, noise_rng, outlier_rng = np.random.default_rng(seed).spawn(7)
    if arm_seed is None:
        arm_seed = seed
    else:
        _check_arguments(arm_seed, poses, pixel, error_scale, outliers)
        robot_rng = np.random.default_rng(arm_seed).spawn(7)[0]

    table = rows_of(rig.chain)
    offsets = error_scale * draw_offsets(table, robot_rng)
    off = pin.exp6(stand_rng.normal(0.0, _STAND_SIGMA)).homogeneous if len(rig.attachments.eye_to_hand) else np.eye(4)
    true = replace(
        nominal,
        placements=table.placements(offsets),
        T_world_base=nominal.T_world_base @ off,
        leds=np.concatenate([_true_leds(rig, nominal, led_rng), rig.attachments.target_points]),
        targets=_true_targets(rig, nominal, led_rng),
        T_cam_frame=_true_mounts(rig, nominal.T_cam_frame, led_rng),
    )
    prints = draw_prints(rig.targets, led_rng)
    true = replace(true, leds=printed(rig, true.leds, prints))

    outlined = nominal.outlined()
    checker, warnings = load_collision_checker(outlined, rig)
    noise = rig.noise if not pixel else replace(rig.noise, pixel=pixel)
    measured: Measurement
    if rig.places:
        spread, outlying = rig.noise.of(Contacts), np.zeros(0, dtype=np.intp)
        readings, measured = touch_places(rig, true, offsets, poses, spread, pose_rng, checker, progress)
    else:
        readings = sample_poses(outlined, checker, poses, pose_rng, progress) if at is None else at[1]
    planned = Positions(
        **rig.of_setup(noise=noise, sha256={}, folder=None),
        poses=names,
        q=readings,
        warnings=warnings,
    )
    joint_errors = draw_joint_errors(rig.errors, planned, arm_seed)
    q, origins = true_joint_values(planned, joint_errors), true.placements
    if Bending.name in joint_errors:
        true = true.with_flexures()
    pixel = rig.noise.of(Detections) if pixel is None else pixel
    if not rig.places:
        views, levels = np.tile(np.arange(len(true.cameras)), (poses, 1)), (pixel, noise.of(Detections))
        measured, outlying = simulate_detections(true, q, views, levels, outliers, noise_rng, outlier_rng)
    session = planned.measured((measured,), q=noisy_values(rig, planned.q, joint_rng))
    truth = Truth(
        **vars(true),
        seed=seed,
        arm_seed=arm_seed,
        pixel=pixel,
        error_scale=error_scale,
        outlier_share=outliers,
        offsets=frozen(offsets),
        q=frozen(q),
        readings=planned.q,
        joint_errors=joint_errors,
        prints=prints,
        outliers=frozen(outlying, np.intp),
        places=rig.places,
        urdf=b"" if rig.urdf is None else rewrite_origins(rig.urdf, origins_of(rig.urdf, rig.chain, origins)),
    )
    return Simulated(session, truth)


def write_simulated(folder: str | Path, simulated: Simulated, *, detections: bool = True) -> None:
    """Write a session, and beside it what no calibration reads: truth.urdf and truth.json.

    Args:
        folder: where to; made if need be, in a folder that exists.
        simulated: what to write.
        detections: whether to write them too; without, the session waits for images.

    Raises:
        OutputError: the folder holds a session or a truth already, or cannot be written.
    """
    folder, session = Path(folder), simulated.session
    for name in (_URDF, _JSON):
        if (folder / name).exists():
            raise OutputError(f"there is a {name} already", where=str(folder), remedy="Name a new folder.")
    if Path(session.urdf_reference).name == _URDF:
        raise OutputError(f"the nominal robot's file is itself called {_URDF}", where=str(folder), remedy="Rename it.")
    write_session(folder, session if detections else session.unmeasured())
    write_bytes(folder / _URDF, simulated.truth.urdf)
    write_text(folder / _JSON, json.dumps(truth_to_dict(simulated), indent=1) + "\n")


def _check_arguments(seed: int, poses: int, pixel: float | None, error_scale: float, outliers: float) -> None:
    for good, what, remedy in (
        (seed >= 0, f"seed is {seed}, not a whole number from 0 up", ""),
        (poses >= MIN_POSES, f"poses is {poses}: a session needs at least {MIN_POSES}", ""),
        (pixel is None or 0.0 <= pixel < np.inf, f"pixel is {pixel}, not a standard deviation", ""),
        (0.0 <= error_scale < np.inf, f"error_scale is {error_scale}, not a factor from 0 up", ""),
        (0.0 <= outliers <= 1.0, f"outliers is {outliers}, not a share from 0 to 1", "5 % are 0.05."),
    ):
        if not good:
            raise SessionError(what, where="simulate", remedy=remedy)


def nominal_scene(rig: RigDescription) -> Scene:
    """Build the scene of the nominal robot, its cameras and LEDs where they were meant to be."""
    if not rig.rig.cameras and not rig.places:
        raise SessionError("the rig has no cameras, and no places to touch", where="cameras")
    T_cam_frame = dict(zip(rig.rig.names, rig.attachments.T_cam_frame, strict=True))
    if unknown := [name for name, T in T_cam_frame.items() if T is None]:
        raise SessionError(
            f"the pose of {unknown[0]!r} is not given",
            where="cameras",
            remedy="Simulating needs T_cn_cnm1 of every camera but the first, or its pose on its link.",
        )
    unknown = [f"leds.{led.name}" for led in rig.leds if led.position is None]
    unknown += [f"targets.{target.name}" for target in rig.targets if target.T_link_target is None]
    if unknown:
        remedy = "Simulating needs it, if only roughly."
        raise SessionError("its place is not given", where=unknown[0], remedy=remedy)
    return Scene(
        chain=rig.chain,
        placements=rig.chain.placements,
        attachments=rig.attachments,
        leds=np.concatenate([led_positions(rig.leds), rig.attachments.target_points]),
        targets=np.array([target.T_link_target for target in rig.targets]).reshape(-1, 4, 4),
        # Without a stand all cameras are eye-in-hand, and the base is the world.
        T_world_base=np.eye(4) if rig.stand is None else inverse(look_at(rig.stand.position, rig.stand.look_at)),
        cameras=rig.rig.cameras,
        T_cam_frame=np.array(list(T_cam_frame.values())).reshape(-1, 4, 4),
    )


def _true_leds(rig: RigDescription, nominal: Scene, rng: np.random.Generator) -> Floats:
    sigma = [_LED_SIGMA if led.sigma is None else led.sigma for led in rig.leds]
    leds = nominal.leds[: nominal.led_count]
    return np.asarray(leds + rng.standard_normal(leds.shape) * np.array(sigma).reshape(-1, 1))


def _true_targets(rig: RigDescription, nominal: Scene, rng: np.random.Generator) -> Floats:
    """Draw how targets are truly fastened."""
    true = np.array(nominal.targets)
    for t, target in enumerate(rig.targets):
        sigma = _STAND_SIGMA if target.sigma is None else target.sigma
        true[t] = true[t] @ pin.exp6(rng.normal(0.0, sigma)).homogeneous
    return true


def _true_mounts(rig: RigDescription, T_cam_frame: Floats, rng: np.random.Generator) -> Floats:
    """Draw how eye-in-hand cameras are truly mounted on their links; others in a frame move with the reference one."""
    attachments, names = rig.attachments, rig.rig.names
    sigma = {mount.camera: _STAND_SIGMA if mount.sigma is None else mount.sigma for mount in rig.mounts}
    true = np.array(T_cam_frame)
    for c in np.flatnonzero((attachments.camera != 0) & (attachments.reference == np.arange(len(names)))):
        moved = pin.exp6(rng.normal(0.0, sigma[names[c]])).homogeneous @ T_cam_frame[c]
        for k in np.flatnonzero(attachments.reference == c):
            true[k] = T_cam_frame[k] @ inverse(T_cam_frame[c]) @ moved
    return true


def draw_offsets(table: DHTable, rng: np.random.Generator) -> Floats:
    """Draw the offsets of a true robot's DH rows from the nominal ones.

    Zero offsets are uniform in magnitude, 1-5 mrad (a sliding joint's 0.2-0.8 mm), with either sign; the
    other parameters that a row has free are normal, with the spread measured on real robots.

    What one LED of unknown position cannot identify stays nominal: theta and d of the first row, which only move
    the base, and the last row, which only moves the LED and the tip on the last link.

    Args:
        table: of the nominal robot.
        rng: the source of randomness; what is drawn for a row does not depend on the other rows of its branch.

    Returns:
        (R, 5) offsets, columns as ``PARAMETERS``. [rad, m]
    """
    drawn: list[Floats] = []
    for branch in table.chain.branches:
        if table.rows[len(drawn)].mount:
            drawn.append(rng.standard_normal(len(PARAMETERS)) * _spreads(table.rows[len(drawn)]))
        shape = (len(branch), len(PARAMETERS))
        normal, magnitude, sign = rng.standard_normal(shape), rng.random(shape[0]), rng.integers(0, 2, shape[0])
        for i in range(len(branch)):
            row = table.rows[len(drawn)]
            least, most = _ZERO_LENGTH if row.type == "prismatic" else _ZERO_ANGLE
            zero = (1 - 2 * sign[i]) * (least + magnitude[i] * (most - least))
            own = np.array([name == row.variable for name in PARAMETERS])
            drawn.append(np.where(own, zero, normal[i] * _spreads(row)) * (not row.last))
    drawn[0][[PARAMETERS.index("theta"), PARAMETERS.index("d")]] = 0.0
    return np.array(drawn) + 0.0  # no "-0.0"


def _spreads(row: DHRow) -> list[float]:
    """Standard deviations (5,) of a row's parameters, 0 of those that it has not free."""
    angle = _ALPHA_PARALLEL if row.parallel else _ALPHA
    spread = {"theta": angle, "d": _D, "a": _A, "alpha": angle, "beta": _BETA_PARALLEL}
    return [spread[name] * (name in row.free) for name in PARAMETERS]
