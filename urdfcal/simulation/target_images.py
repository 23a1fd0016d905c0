"""The images of targets behind a simulated session, blurred, dark and covered ones included."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from urdfcal.images.files import in_parallel, write_image
from urdfcal.session.trajectory import Trajectory
from urdfcal.simulation.moving import PosesByRow, pixels_as_taken
from urdfcal.simulation.prints import PrintRenderer
from urdfcal.simulation.render import Sensor
from urdfcal.simulation.scene import any_direction
from urdfcal.simulation.true_prints import pieces_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from urdfcal.images.files import Image
    from urdfcal.simulation.images import Exposure
    from urdfcal.simulation.truth import Simulated

# A lens in focus. [px]
_BLUR = 0.8
# With distractors a tenth of the images is smeared by an arm that still moves, dark, or glaring. [share, px, factors]
_SPOILT, _SMEAR, _LIGHT = 0.1, (3.0, 12.0), (0.04, 2.5)


def write_target_images(
    folder: Path,
    simulated: Simulated,
    exposure: Exposure,
    seed: np.random.SeedSequence,
    counted: Callable[[Iterator[Any]], Iterator[Any]],
) -> int:
    """Write what each camera sees of the targets at each pose, ``folder``/<camera>/<pose>.png.

    Args:
        folder: of the images.
        simulated: session and truth.
        exposure: bits of a pixel, and whether some images are spoilt.
        seed: of the noise.
        counted: passes results on and counts them.

    Returns:
        The number of images.

    Raises:
        SessionError: a target is nothing printed.
    """
    session, scene, motion = simulated.session, simulated.truth, simulated.session.motion
    T_cam_target = scene.target_poses(scene.q)
    by_row = None if scene.rolling is None else PosesByRow.of(scene, scene.rolling)
    printed = [pieces_of(target, of) for target, of in zip(session.targets, scene.prints, strict=True)]
    renderers = [PrintRenderer(camera) for camera in scene.cameras]

    def take(task: tuple[int, int, np.random.SeedSequence]) -> Image:
        pose, c, own = task
        rng = np.random.default_rng(own)
        smear, light = np.zeros(2), 1.0
        if exposure.distractors and rng.random() < _SPOILT:
            smear = rng.uniform(*_SMEAR) * any_direction(rng) if rng.random() < 0.5 else smear
            light = rng.choice(_LIGHT) if not smear.any() else 1.0
        height, facing = scene.cameras[c].resolution[1], scene.faced(scene.q[pose : pose + 1])[0, c]
        shown = []
        for t in np.flatnonzero(facing).tolist():
            T = T_cam_target[pose, c, t] if by_row is None else by_row.at(pose, t, height)
            shown += [piece.before(T) for piece in printed[t]]
        grey = renderers[c].expected(shown, _BLUR, (float(smear[0]), float(smear[1])))
        sensor = Sensor(scene.cameras[c].resolution, exposure.bits, exposure.electrons_per_count)
        return sensor.expose(light * grey.astype(float) / 255.0 * sensor.full_well, rng)

    def write(task: tuple[int, int, np.random.SeedSequence]) -> None:
        pose, c, _ = task
        write_image(folder / scene.cameras[c].name / f"{session.label(pose)}.png", take(task))

    tasks = [
        (pose, c, own)
        for pose, of_pose in enumerate(seed.spawn(len(session.poses)))
        for c, own in enumerate(of_pose.spawn(len(scene.cameras)))
        if not isinstance(motion, Trajectory) or motion.camera[pose] == c
    ]
    for camera in scene.cameras:
        (folder / camera.name).mkdir(parents=True, exist_ok=True)
    deque(counted(in_parallel(write, tasks)), maxlen=0)
    return len(tasks)


def target_rows(simulated: Simulated) -> list[tuple[str, str, str, float, float]]:
    """Pose, camera, point, u and v of every point of a target that is in an image and faces the camera."""
    session, scene = simulated.session, simulated.truth
    uv = pixels_as_taken(scene)
    seen = scene.in_image(uv) & scene.turned_to(simulated.truth.q)
    seen[..., : scene.led_count] = False
    names, points = session.rig.names, session.led_names
    return [
        (session.label(pose), names[c], points[k], *uv[pose, c, k].tolist())
        for pose, c, k in np.argwhere(seen).tolist()
        if not isinstance(session.motion, Trajectory) or session.motion.camera[pose] == c
    ]
