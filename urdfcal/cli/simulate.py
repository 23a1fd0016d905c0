"""``urdfcal simulate`` and ``demo``: a session from a robot whose errors are known, and what comes of one."""

from itertools import count as counting
from pathlib import Path
from typing import Any

import click

from urdfcal.cli.console import PATH, POSITIVE, progress_bar, say, seed_option

_POSES = 50


@click.command("simulate")
@click.argument("rig", metavar="RIG")
@click.option("-o", "--output", "session", type=PATH, required=True, help="Folder to write.")
@click.option(
    "--poses", type=click.IntRange(min=3), show_default=False,
    help=f"Number of arm positions.  [default: {_POSES}, or those of --at]",
)  # fmt: skip
@click.option(
    "--at", type=PATH, metavar="FILE",
    help="Measure in these, a table as `urdfcal plan` writes; rows named pass1, ... are passed through.",
)  # fmt: skip
@seed_option
@click.option(
    "--arm-seed", type=click.IntRange(min=0), show_default=False,
    help="Of the arm alone: another session of the same one has another --seed.  [default: --seed]",
)  # fmt: skip
@click.option("--pixel", type=click.FloatRange(min=0.0), help="Noise of the detections in px.  [default: the rig's]")
@click.option(
    "--error-scale", type=click.FloatRange(min=0.0), default=1.0, help="Multiplies the errors of its geometry."
)
@click.option(
    "--outliers", type=click.FloatRange(0.0, 1.0), default=0.0, help="Fraction of detections moved by 5 to 200 px."
)
@click.option("--trajectory", is_flag=True, help="Film the arm on its way from pose to pose.")
@click.option("--speed", type=POSITIVE, default=0.5, help="Of its fastest joint, rad/s or m/s.")
@click.option("--frame-rate", type=POSITIVE, default=30.0, help="Of each camera, Hz.")
@click.option("--joint-rate", type=POSITIVE, default=125.0, help="Of the joint readings, Hz.")
@click.option(
    "--time-offset", "time_offsets", type=float, multiple=True, metavar="S",
    help="t_robot - t_camera in s, once a camera.  [default: within 30 ms]",
)  # fmt: skip
@click.option("--images", is_flag=True, help="Write what the cameras saw instead of detections.csv.")
@click.option("--video", is_flag=True, help="Write it as one video a camera.")
@click.option(
    "--distractors", is_flag=True, help="Images with lamps, reflections, hot pixels, streaks and a hidden LED."
)
@click.option(
    "--peak", type=click.FloatRange(min=1.0), default=1500.0,
    help="Electrons of the LED's brightest pixel, 1.5 m away; images saturate at 2500.",
)  # fmt: skip
@click.option(
    "--arm", type=click.FloatRange(0.0, 1.0), default=0.0, help="How bright the arm is in images, a share of white."
)
@click.option(
    "--spot", type=click.FloatRange(0.3, 25.0), default=1.5, help="Standard deviation of the LED's spot in px."
)
def simulate(
    rig: str,
    session: Path,
    poses: int | None,
    at: Path | None,
    seed: int,
    arm_seed: int | None,
    pixel: float | None,
    error_scale: float,
    outliers: float,
    trajectory: bool,
    images: bool,
    video: bool,
    distractors: bool,
    peak: float,
    spot: float,
    arm: float,
    **motion: Any,
) -> None:
    """Simulate a session of RIG (a shipped rig's name or a folder), with the truth beside it."""
    from urdfcal.io.folder import read_rig
    from urdfcal.io.shipped_rigs import find_rig
    from urdfcal.names import is_passed
    from urdfcal.planning.files import read_plan
    from urdfcal.simulation import simulate as simulation

    filmed, noisy = images or video, outliers or pixel is not None
    for given, wrong in (
        (poses is not None and at is not None, "--poses does not go with --at: the file says which there are"),
        (distractors and not filmed, "--distractors goes with --images"),
        (filmed and noisy, "--pixel and --outliers do not go with --images: the images decide"),
        (video and not trajectory, "--video goes with --trajectory"),
        (images and video, "--images and --video: choose one"),
        (motion["time_offsets"] and not trajectory, "--time-offset goes with --trajectory"),
    ):
        if given:
            raise click.UsageError(wrong)
    description = read_rig(find_rig(rig))
    # Where the arm comes from is read, too: it may lag. Of a pose that it passes no image is taken.
    planned = None if at is None else read_plan(at, description.chain, passing=not (filmed or trajectory))
    count = (poses or _POSES) if planned is None else len(planned[0])
    errors: dict[str, Any] = {
        "at": planned,
        "arm_seed": arm_seed,
        "pixel": pixel,
        "error_scale": error_scale,
        "outliers": outliers,
    }
    with progress_bar("sampling poses", count) as advance:
        simulated = simulation.simulate(description, poses=count, seed=seed, progress=advance, **errors)
    if passed := [k for k, name in enumerate(simulated.session.poses) if is_passed(name)]:
        simulated, count = simulated.unmeasured_at(passed), count - len(passed)
    if trajectory:
        from urdfcal.simulation.motion import MotionSettings, set_in_motion

        simulated = set_in_motion(simulated, MotionSettings(**motion))
    if filmed:
        from urdfcal.simulation.images import Exposure, write_simulated_images

        exposure = Exposure(sigma=spot, peak=peak, distractors=distractors, arm=arm)
        rate = motion["frame_rate"] if video else None
        with progress_bar("rendering", None) as advance:
            write_simulated_images(session, simulated, exposure, advance, video_rate=rate)
    else:
        simulation.write_simulated(session, simulated)
    for warning in simulated.session.warnings:
        say(f"- {warning}", err=True)
    if trajectory:
        say(f"{session}: the arm moves; {len(simulated.session.poses)} frames")
    bends = ", what its joints do beside in truth.json" if description.errors else ""
    say(f"{session}: {count} poses of {description.chain.name}, seed {seed}; the truth is in truth.urdf{bends}")


@click.command("demo")
@click.argument("rig", default="ur5")
@click.option("-o", "--output", type=PATH, help="Folder to make.  [default: urdfcal-demo, or -2, -3, ...]")
@seed_option
def demo(rig: str, output: Path | None, seed: int) -> None:
    """Simulate a session of RIG, calibrate it, and compare the result with the truth."""
    from urdfcal.cli.calibrate import run
    from urdfcal.cli.robots import compared
    from urdfcal.errors import OutputError
    from urdfcal.io.folder import read_rig, read_session
    from urdfcal.io.shipped_rigs import find_rig
    from urdfcal.robot.mechanism import BASE
    from urdfcal.robot.urdf.urdf import find_urdf
    from urdfcal.simulation import simulate as simulation

    description = read_rig(find_rig(rig))
    names = ("urdfcal-demo" if i == 1 else f"urdfcal-demo-{i}" for i in counting(1))
    folder = output or next(Path(name) for name in names if not Path(name).exists())
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        what = f"cannot make this folder: {error.strerror}"
        raise OutputError(what, where=str(folder), remedy="Name a new one with -o.") from error
    simulation.write_simulated(folder / "session", simulation.simulate(description, poses=_POSES, seed=seed))
    calibration = run(read_session(folder / "session"), folder / "result", seed=seed)

    session, truth = calibration.session, str(folder / "session" / "truth.urdf")
    nominal = find_urdf(session.urdf_reference, relative_to=session.folder)
    urdfs = (str(nominal), str(folder / "result" / calibration.urdf_name))
    tips = [tip.link for tip in session.chain.tips if tip.joint != BASE]
    for link in tips:
        found = [compared(urdf, truth, link, session.chain.base_link, 1000, seed) for urdf in urdfs]
        before, after = (difference["position_mm"] for difference in found)
        say(
            f"{'tip' if len(tips) == 1 else link} against the true robot over the workspace: "
            f"{before['rms']:.2f} -> {after['rms']:.2f} mm rms, {before['max']:.2f} -> {after['max']:.2f} mm max"
        )
