"""``urdfcal simulate``: a session from a robot whose errors are known."""

from __future__ import annotations

from pathlib import Path

import click

from urdfcal.cli.options import seed_option

_POSITIVE = click.FloatRange(min=0.0, min_open=True)


@click.command("simulate")
@click.argument("rig", metavar="RIG")
@click.option("-o", "--output", "session", type=click.Path(path_type=Path), required=True, help="Folder to write.")
@click.option("--poses", type=click.IntRange(min=3), default=50, show_default=True, help="Number of arm positions.")
@seed_option
@click.option("--pixel", type=click.FloatRange(min=0.0), help="Noise of the detections in px.  [default: the rig's]")
@click.option(
    "--error-scale",
    type=click.FloatRange(min=0.0),
    default=1.0,
    show_default=True,
    help="Multiplies the true robot's errors.",
)
@click.option(
    "--outliers",
    type=click.FloatRange(0.0, 1.0),
    default=0.0,
    show_default=True,
    help="Fraction of detections moved by 5 to 200 px.",
)
@click.option("--trajectory", is_flag=True, help="Film the arm on its way from pose to pose.")
@click.option("--speed", type=_POSITIVE, default=0.5, show_default=True, help="Of its fastest joint, rad/s or m/s.")
@click.option("--frame-rate", type=_POSITIVE, default=30.0, show_default=True, help="Of each camera, Hz.")
@click.option("--joint-rate", type=_POSITIVE, default=125.0, show_default=True, help="Of the joint readings, Hz.")
@click.option(
    "--time-offset",
    "time_offsets",
    type=float,
    multiple=True,
    metavar="S",
    help="t_robot - t_camera in s, once a camera.  [default: within 30 ms]",
)
@click.option("--images", is_flag=True, help="Write what the cameras saw instead of detections.csv.")
@click.option("--video", is_flag=True, help="Write it as one video a camera.")
@click.option(
    "--distractors", is_flag=True, help="Images with lamps, reflections, hot pixels, streaks and a hidden LED."
)
@click.option(
    "--peak",
    type=click.FloatRange(min=1.0),
    default=1500.0,
    show_default=True,
    help="Electrons of the LED's brightest pixel, 1.5 m away; images saturate at 2500.",
)
def command(
    rig: str,
    session: Path,
    poses: int,
    seed: int,
    pixel: float | None,
    error_scale: float,
    outliers: float,
    trajectory: bool,
    speed: float,
    frame_rate: float,
    joint_rate: float,
    time_offsets: tuple[float, ...],
    images: bool,
    video: bool,
    distractors: bool,
    peak: float,
) -> None:
    """Simulate a session of RIG (a shipped rig's name or a folder), with the truth beside it."""
    from urdfcal.cli.console import progress_bar
    from urdfcal.io.folder import read_rig
    from urdfcal.io.shipped_rigs import find_rig
    from urdfcal.simulation.simulate import simulate, write_simulated

    filmed = images or video
    if distractors and not filmed:
        raise click.UsageError("--distractors goes with --images")
    if filmed and (outliers or pixel is not None):
        raise click.UsageError("--pixel and --outliers do not go with --images: the images decide")
    if video and not trajectory:
        raise click.UsageError("--video goes with --trajectory")
    if images and video:
        raise click.UsageError("--images and --video: choose one")
    if time_offsets and not trajectory:
        raise click.UsageError("--time-offset goes with --trajectory")
    description = read_rig(find_rig(rig))
    with progress_bar("sampling poses", poses) as advance:
        simulated = simulate(
            description,
            poses=poses,
            seed=seed,
            pixel=pixel,
            error_scale=error_scale,
            outliers=outliers,
            progress=advance,
        )
    if trajectory:
        from urdfcal.simulation.motion import MotionSettings, set_in_motion

        simulated = set_in_motion(simulated, MotionSettings(speed, frame_rate, joint_rate, time_offsets))
    if filmed:
        from urdfcal.simulation.images import Exposure, write_simulated_images

        exposure = Exposure(peak=peak, distractors=distractors)
        with progress_bar("rendering", None) as advance:
            write_simulated_images(session, simulated, exposure, advance, video_rate=frame_rate if video else None)
    else:
        write_simulated(session, simulated)
    for warning in simulated.session.warnings:
        click.echo(f"- {warning}", err=True)
    if trajectory:
        click.echo(f"{session}: the arm moves; {len(simulated.session.poses)} frames")
    click.echo(f"{session}: {poses} poses of {description.chain.name}, seed {seed}; the truth is in truth.urdf")
