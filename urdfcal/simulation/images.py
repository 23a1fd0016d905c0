"""The images behind a simulated session, lamps and reflections included."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from urdfcal.errors import SessionError
from urdfcal.files import staged
from urdfcal.images.files import in_parallel, write_image, write_video
from urdfcal.io.folder import IMAGES
from urdfcal.io.writing import write_table
from urdfcal.session.trajectory import Trajectory
from urdfcal.simulation.bright_arm import bright_arms
from urdfcal.simulation.moving import pixels_as_taken
from urdfcal.simulation.render import Light, Scenery, Sensor
from urdfcal.simulation.scene import any_direction
from urdfcal.simulation.simulate import write_simulated
from urdfcal.simulation.target_images import target_rows, write_target_images

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from urdfcal.arrays import Bools, Floats
    from urdfcal.images.files import Image
    from urdfcal.simulation.scene import Scene
    from urdfcal.simulation.truth import Simulated, Truth

TRUTH = "truth_detections.csv"

T = TypeVar("T")

# Keeps the images' random numbers apart from the session's.
_STREAM = 4
# The distance at which an LED has the peak that is asked for. [m]
_NEAR = 1.5
# Electrons of an unlit wall at a short exposure, brighter at one side, and darker in the corners behind a small lens.
_WALL, _SLOPE, _VIGNETTING = 25.0, 0.01, 0.35
# A table top mirrors a third of the light, in one pose of four; a twentieth of the poses is taken while the arm still
# moves, and in a twentieth of the images the arm hides the LED. [shares]
_MIRRORED, _MIRRORS, _MOVING, _HIDDEN = 0.35, 0.25, 0.05, 0.05
# How far an LED moves while the shutter is open if it moves. [px]
_STREAK = (8.0, 30.0)
# Lamps behind the arm: brighter and larger than the LED, and of its size. [px, times the LED's]
_LARGE_LAMPS, _SMALL_LAMPS = 3, 2
_LAMP_SIGMA, _SMALL_LAMP_SIGMA, _LAMP_PEAK = (6.0, 20.0), (0.8, 1.5), (1.5, 20.0)
_LAMP_DISTANCE = (2.0, 5.0)
# Hot pixels of an old sensor: one in 30,000. [share, times the LED's peak]
_HOT, _LEAK = 3.0e-5, (0.1, 3.0)


@dataclass(frozen=True)
class Exposure:
    """How images are taken.

    Attributes:
        sigma: of the LED's spot. [px]
        peak: electrons per pixel at its centre, from 1.5 m; it falls with the square of the distance.
        bits: of a pixel.
        electrons_per_count: of the sensor.
        distractors: whether there are lamps, reflections, hot pixels, streaks, and images with the LED hidden.
        arm: how bright the arm is in images of LEDs, a share of white; black as a rule.
    """

    sigma: float = 1.5
    peak: float = 1500.0
    bits: int = 8
    electrons_per_count: float = 10.0
    distractors: bool = False
    arm: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.arm <= 1.0:
            raise SessionError(f"no arm is {self.arm} of white", where="simulate")
        if not (0.3 <= self.sigma <= 25.0 and self.peak > 0.0):
            raise SessionError(f"no LED has a spot of {self.sigma} px and {self.peak} electrons", where="simulate")


class _View(NamedTuple):
    """One image to take.

    Attributes:
        camera, pose, led: indices.
        uv: (2,) true pixel of the LED, NaN where it is not to be found. [px]
        lights: all that is lit and not static.
        seed: of its noise.
    """

    camera: int
    pose: int
    led: int
    uv: Floats
    lights: tuple[Light, ...]
    seed: np.random.SeedSequence


def write_simulated_images(
    folder: str | Path,
    simulated: Simulated,
    exposure: Exposure,
    progress: Callable[[int], object] | None = None,
    *,
    video_rate: float | None = None,
) -> int:
    """Write a session whose detections are still to be made from its images, and the truth beside it.

    Beside truth.urdf and truth.json stands truth_detections.csv: where the LEDs, and the points of targets, are in the
    images in which they can be found. Detection and calibration never read it. With targets, <pose>.png shows them, and
    LEDs have images of their own.

    Args:
        folder: where to; made if need be, in a folder that exists.
        simulated: session and truth; the session's own detections are not used.
        exposure: how the images are taken.
        progress: called with the number of images written since the last call.
        video_rate: frames per second, for players; writes one video a camera instead of image files.

    Returns:
        The number of images.

    Raises:
        SessionError: lamps are to be before an eye-in-hand camera, or a video is to show several LEDs, which would all
            be lit, or an arm at rest.
        CameraError: this OpenCV encodes no videos.
        OutputError: the folder holds a session or a truth already, or cannot be written.
    """
    session, scene, motion = simulated.session, simulated.truth, simulated.session.motion
    if video_rate is not None and (not isinstance(motion, Trajectory) or len(session.led_names) > 1):
        raise SessionError("a video shows a moving arm with one LED", where="simulate", remedy="Write images.")
    riding = len(session.attachments.eye_to_hand) < len(scene.cameras)
    if session.leds and riding and exposure.distractors:
        raise SessionError(
            "lamps and reflections before eye-in-hand cameras, which pass them by, cannot be rendered",
            where="simulate",
            remedy="Leave --distractors out.",
        )
    stage_seed, view_seed, target_seed = np.random.SeedSequence((simulated.truth.seed, _STREAM)).spawn(3)
    sensors = [Sensor(camera.resolution, exposure.bits, exposure.electrons_per_count) for camera in scene.cameras]
    sceneries = _sceneries(scene, exposure, np.random.default_rng(stage_seed))
    outshone = [of.background > sensor.full_well for of, sensor in zip(sceneries, sensors, strict=True)]
    views = _views(simulated.truth, exposure, outshone, view_seed) if session.leds else []
    if isinstance(motion, Trajectory):  # a frame is taken by one camera
        views = [view for view in views if view.camera == motion.camera[view.pose]]
    count = len(views)
    write_simulated(folder, simulated, detections=False)

    def image(view: _View) -> Image:
        scenery = sceneries[view.camera]
        if exposure.arm:
            (arm,) = bright_arms(scene, simulated.truth.q[[view.pose]], view.camera)
            shine = exposure.arm * sensors[view.camera].full_well * scenery.vignette
            scenery = replace(scenery, background=scenery.background + arm * (shine - scenery.background))
        electrons = scenery.expected(view.lights)
        return sensors[view.camera].expose(electrons, np.random.default_rng(view.seed))

    def counted(results: Iterator[T]) -> Iterator[T]:
        for result in results:
            yield result
            if progress:
                progress(1)

    with staged(Path(folder)) as stage:
        for c, camera in enumerate(scene.cameras):
            of_camera, place = [view for view in views if view.camera == c], stage / IMAGES / camera.name

            def write(view: _View, place: Path = place) -> None:
                led = f".{session.led_names[view.led]}" if len(session.leds) > 1 or session.targets else ""
                write_image(place / f"{session.label(view.pose)}{led}.png", image(view))

            if video_rate is None:
                place.mkdir(parents=True)
                deque(counted(in_parallel(write, of_camera)), maxlen=0)
            else:
                place.parent.mkdir(exist_ok=True)
                video = counted(in_parallel(image, of_camera))
                write_video(place.parent / f"{camera.name}.mp4", video, camera.resolution, video_rate)
        if session.targets:
            count += write_target_images(stage / IMAGES, simulated, exposure, target_seed, counted)
        names = session.rig.names
        rows = [
            (session.label(view.pose), names[view.camera], session.led_names[view.led], *view.uv.tolist())
            for view in views
            if np.isfinite(view.uv[0])
        ]
        rows += target_rows(simulated)
        write_table(stage / TRUTH, ["pose", "camera", "led", "u", "v"], zip(*rows, strict=True))
    return count


def _sceneries(scene: Scene, exposure: Exposure, rng: np.random.Generator) -> list[Scenery]:
    """Draw what is static before each camera: the same lamps for all, and hot pixels of its own."""
    lamps = _lamps(scene, exposure, rng) if exposure.distractors else [()] * len(scene.cameras)
    sceneries = []
    for camera, lights in zip(scene.cameras, lamps, strict=True):
        width, height = camera.resolution
        count = round(_HOT * width * height) if exposure.distractors else 0
        slope = _SLOPE * rng.uniform(-1.0, 1.0, 2)
        hot = rng.integers((0, 0), (width, height), (count, 2))
        leak = exposure.peak * rng.uniform(*_LEAK, count)
        sceneries.append(Scenery.flat(camera.resolution, _WALL, (slope[0], slope[1]), _VIGNETTING, lights, hot, leak))
    return sceneries


def _lamps(scene: Scene, exposure: Exposure, rng: np.random.Generator) -> list[tuple[Light, ...]]:
    """Draw lamps some metres away, as each camera sees them."""
    first, count = scene.cameras[0], _LARGE_LAMPS + _SMALL_LAMPS
    points = first.unproject(rng.uniform(0.0, first.resolution, (count, 2)))
    points *= rng.uniform(*_LAMP_DISTANCE, (count, 1))
    sigma = np.append(
        rng.uniform(*_LAMP_SIGMA, _LARGE_LAMPS), exposure.sigma * rng.uniform(*_SMALL_LAMP_SIGMA, _SMALL_LAMPS)
    )
    peak = exposure.peak * rng.uniform(*_LAMP_PEAK, count)
    lights = []
    for camera, T_cam in zip(scene.cameras, scene.T_cam_frame, strict=True):
        uv = camera.project(points @ T_cam[:3, :3].T + T_cam[:3, 3])
        lights.append(tuple(Light(uv[i], peak[i], sigma[i]) for i in range(count) if np.isfinite(uv[i, 0])))
    return lights


def _views(scene: Truth, exposure: Exposure, outshone: Sequence[Bools], seed: np.random.SeedSequence) -> list[_View]:
    """Draw every image: each pose, each camera, each LED; of a rolling shutter each light in the row that takes it.

    ``outshone`` are for each camera the pixels (height, width) before a lamp that saturates the sensor by itself.
    """
    q = scene.q
    direct, mirrored, distance = scene.pixels(q), scene.pixels(q, mirrored=True), scene.distances(q)
    if scene.rolling is not None:  # a reflection moves as its light does
        at_once, direct = direct, pixels_as_taken(scene)
        mirrored += direct - at_once
    views = []
    for pose, of_pose in enumerate(seed.spawn(len(q))):
        rng = np.random.default_rng(of_pose)
        moving, mirrors = (exposure.distractors and rng.random() < share for share in (_MOVING, _MIRRORS))
        for camera, led in np.ndindex(len(scene.cameras), scene.led_count):
            hidden = exposure.distractors and rng.random() < _HIDDEN
            motion = rng.uniform(*_STREAK) * any_direction(rng) if moving else np.zeros(2)
            peak = exposure.peak * (_NEAR / distance[pose, camera, led]) ** 2
            uv, mirror = direct[pose, camera, led], mirrored[pose, camera, led]
            lights = []
            if np.isfinite(uv[0]) and not hidden:
                lights.append(Light(uv, peak, exposure.sigma, motion))
            if np.isfinite(mirror[0]) and mirrors:
                lights.append(Light(mirror, _MIRRORED * peak, 1.2 * exposure.sigma, motion))
            visible = scene.cameras[camera].in_image(uv) and not (hidden or moving)
            found = visible and not outshone[camera][tuple(np.rint(uv[::-1]).astype(int))]
            true = uv if found else np.full(2, np.nan)
            views.append(_View(camera, pose, led, true, tuple(lights), of_pose.spawn(1)[0]))
    return views
