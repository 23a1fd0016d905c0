"""What a rig would bring, before anything is bought: simulated calibrations, and the error to expect beside."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np

from urdfcal.arrays import inverse, rms
from urdfcal.cameras.rig import Rig
from urdfcal.errors import SessionError, UrdfcalError
from urdfcal.estimation.evaluation import compare_tips
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_rig
from urdfcal.pipeline import calibrate
from urdfcal.planning.belief import Belief, check_plannable
from urdfcal.robot.kinematics import tip_poses
from urdfcal.session.knowledge import Estimate, Led
from urdfcal.simulation.joint_errors import true_tips
from urdfcal.simulation.scene import look_at
from urdfcal.simulation.simulate import simulate
from urdfcal.study.engine import each

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.session.rig_description import RigDescription
    from urdfcal.study.engine import Engine

Varied: TypeAlias = Literal["poses", "pixel", "baseline", "lens", "cameras", "leds", "arm"]
VARIED: tuple[Varied, ...] = get_args(Varied)
"""What a study can vary; baseline, lens and arm are factors on the rig's distances, focal lengths and arm errors."""

POSES = 50
"""As `urdfcal simulate`, where nothing else is asked for."""
_WORKSPACE = 300
# From the first LED to those that a study adds, on a ring about it. [m]
_RING = 0.05


@dataclass(frozen=True)
class Variation:
    """One thing that is varied, and to what; None for the rig as it is."""

    varied: Varied | None
    value: float

    def __str__(self) -> str:
        return "as it is" if self.varied is None else f"{self.varied} {self.value:g}"


@dataclass(frozen=True)
class Outcome:
    """What a setting brings.

    Attributes:
        setting: of the rig.
        poses: how many each arm is measured in.
        error: root mean square of the true tip errors over the arms, each over the workspace, its base aligned. [m]
        worst: of one arm in ten it is worse than this. [m]
        expected: from the information of the measurements and the tolerances (Cramer and Rao); arms that are better
            than their tolerances come out better where measurements say little. [m]
        nominal: the error of the arms that are not calibrated. [m]
        arms: true tip errors of those that were simulated. [m]
        failed: why others could not be; empty where all could.
    """

    setting: Variation
    poses: int
    error: float
    worst: float
    expected: float
    nominal: float
    arms: tuple[float, ...]
    failed: tuple[str, ...]


@dataclass(frozen=True)
class Run:
    """One simulated calibration."""

    rig: Path
    setting: Variation
    seed: int


def study(
    rig: Path,
    settings: Sequence[Variation],
    *,
    seeds: int,
    seed: int = 0,
    engine: Engine = "processes",
    processes: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], object] | None = None,
) -> tuple[Outcome, ...]:
    """Simulate and calibrate arms for each setting of a rig, the same arms for all.

    Args:
        rig: its folder.
        settings: what is varied.
        seeds: how many arms of each.
        seed: of the first one.
        engine: what runs them.
        processes: how many at a time, on this machine.
        scheduler: address of a Dask scheduler.
        progress: called with the number of arms done since the last call.

    Raises:
        SessionError: the rig cannot be read, or a setting is none of it.
    """
    description = read_rig(rig)
    check_plannable(description)
    for setting in settings:
        varied_rig(description, setting)
    runs = [Run(rig, setting, seed + k) for setting in settings for k in range(seeds)]
    results: dict[int, Floats | str] = {}
    for k, result in each(run_one, runs, _killed, engine, processes=processes, scheduler=scheduler):
        results[k] = result
        if progress is not None:
            progress(1)
    return tuple(
        _outcome(setting, [results[i * seeds + k] for k in range(seeds)]) for i, setting in enumerate(settings)
    )


def run_one(run: Run) -> Floats | str:
    """Simulate and calibrate one arm.

    Returns:
        True tip errors of the nominal and of the calibrated arm, and the one expected (3,) [m]; or why there is none.
    """
    rig, options = varied_rig(read_rig(run.rig), run.setting)
    try:
        simulated = simulate(rig, seed=run.seed, **options)
        estimate = replace(simulated.session.estimate, geometry=simulated.session.estimate.geometry or "dh")
        session = replace(simulated.session, estimate=estimate)
        built = calibrate(session, force=True)
    except UrdfcalError as error:
        return error.what
    chain, truth = session.chain, simulated.truth
    q = chain.random_values(_WORKSPACE, np.random.default_rng(run.seed))
    true = true_tips(simulated, q)
    tips = tip_poses(chain, q), built.forward(chain.readings(q))
    errors = [rms(compare_tips(of, true).position) for of in tips]
    belief = Belief.of_rig(rig, truth.readings).identified_by(truth.readings).with_session(session)
    return np.array([*errors, belief.candidates(truth.readings, q).error(belief.information)])


def present(rig: RigDescription, varied: Varied) -> float:
    """Return what is varied as the rig has it."""
    if varied == "pixel":
        return rig.noise.of(Detections)
    counts = {"poses": POSES, "cameras": len(rig.rig.cameras), "leds": len(rig.leds)}
    return float(counts.get(varied, 1.0))


def varied_rig(rig: RigDescription, setting: Variation) -> tuple[RigDescription, dict[str, Any]]:
    """Return a rig with a setting, and the options of its simulation.

    Raises:
        SessionError: the rig has not what the setting varies.
    """
    value, where = setting.value, f"study {setting}"
    options: dict[str, Any] = {"poses": POSES}
    if setting.varied in ("poses", "cameras", "leds") and (value < 1 or value != int(value)):
        raise SessionError(f"{value:g} is no number of {setting.varied}", where=where)
    if value <= 0.0:
        raise SessionError(f"{value:g} is not positive", where=where)
    if setting.varied == "poses":
        options["poses"] = int(value)
    elif setting.varied == "pixel":
        options["pixel"] = value
    elif setting.varied == "arm":
        options["error_scale"] = value
    elif setting.varied == "lens":
        cameras = [replace(camera, intrinsics=camera.intrinsics * [value, value, 1, 1]) for camera in rig.rig.cameras]
        rig = replace(rig, rig=replace(rig.rig, cameras=tuple(cameras)))
    elif setting.varied == "baseline":
        rig = replace(rig, rig=replace(rig.rig, T_cam_world=_further(rig, value, where)))
    elif setting.varied == "cameras":
        rig = _first_cameras(rig, int(value), where)
    elif setting.varied == "leds":
        rig = _more_leds(rig, int(value), where)
    return rig, options


def _further(rig: RigDescription, factor: float, where: str) -> tuple[Floats | None, ...]:
    """Move cameras away from the first one by a factor; they go on looking where it looks."""
    if rig.stand is None or len(rig.rig.cameras) < 2 or rig.mounts or any(T is None for T in rig.rig.T_cam_world):
        remedy = "It takes two cameras that stand, at places that are given."
        raise SessionError("the rig has no baseline", where=where, remedy=remedy)
    T_base_world = look_at(rig.stand.position, rig.stand.look_at)
    placed: list[Floats | None] = [rig.rig.T_cam_world[0]]
    for T in rig.rig.T_cam_world[1:]:
        centre = T_base_world[:3, :3] @ (factor * inverse(np.array(T))[:3, 3]) + T_base_world[:3, 3]
        placed.append(inverse(look_at(centre, rig.stand.look_at)) @ T_base_world)
    return tuple(placed)


def _first_cameras(rig: RigDescription, count: int, where: str) -> RigDescription:
    if count > len(rig.rig.cameras) or rig.mounts:
        what = f"the rig has {len(rig.rig.cameras)} cameras" + (" on the robot" if rig.mounts else "")
        raise SessionError(what, where=where, remedy="Add the others to its camera file first.")
    kept = {one.name: getattr(rig.rig, one.name) for one in fields(Rig)}
    kept = {name: of[:count] if isinstance(of, tuple) else of for name, of in kept.items()}
    return replace(rig, rig=Rig(**kept), estimate=Estimate(rig.estimate.geometry))


def _more_leds(rig: RigDescription, count: int, where: str) -> RigDescription:
    if not rig.leds or rig.leds[0].position is None:
        raise SessionError("the rig has no LED whose place is given", where=where)
    first, place = rig.leds[0], np.array(rig.leds[0].position)
    angles = 2.0 * np.pi * np.arange(count) / max(count, 1)
    more = [
        Led(f"{first.name}_{k}", place + _RING * np.array([np.cos(a), np.sin(a), 0.0]), first.sigma, first.link)
        for k, a in enumerate(angles[len(rig.leds) :], len(rig.leds) + 1)
    ]
    named = {led.name for led in rig.leds[:count]}
    kept = tuple(of for of in rig.led_distances if set(of.leds) <= named)
    return replace(rig, leds=(*rig.leds[:count], *more), led_distances=kept)


def _outcome(setting: Variation, results: Sequence[Floats | str]) -> Outcome:
    failed = tuple(dict.fromkeys(result for result in results if isinstance(result, str)))
    rows = np.array([result for result in results if not isinstance(result, str)]).reshape(-1, 3)
    nominal, error, expected = (rms(column) for column in rows.T)
    worst = float(np.percentile(rows[:, 1], 90.0)) if len(rows) else float("nan")
    poses = int(setting.value) if setting.varied == "poses" else POSES
    return Outcome(setting, poses, error, worst, expected, nominal, tuple(rows[:, 1].tolist()), failed)


def _killed(run: Run) -> Floats | str:
    return f"seed {run.seed}: its process was killed, twice"


def settings_of(varied: Mapping[Varied, Sequence[float]]) -> tuple[Variation, ...]:
    """Return the rig as it is, and every value of what is varied, one thing at a time."""
    return (Variation(None, 1.0), *(Variation(name, value) for name, values in varied.items() for value in values))
