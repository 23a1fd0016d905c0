"""``urdfcal simulate``: a session from a robot whose errors are known."""

from __future__ import annotations

from pathlib import Path

import click

from urdfcal.cli.options import seed_option


@click.command("simulate")
@click.argument("rig", metavar="RIG")
@click.option("-o", "--output", "session", type=click.Path(path_type=Path), required=True, help="Folder to write.")
@click.option("--poses", type=click.IntRange(min=3), default=50, show_default=True, help="Number of arm positions.")
@seed_option
@click.option("--pixel", type=click.FloatRange(min=0.0), help="Noise of the sightings in px.  [default: the rig's]")
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
    help="Fraction of sightings moved by 5 to 200 px.",
)
@click.option("--images", is_flag=True, help="Write what the cameras saw instead of detections.csv.")
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
    images: bool,
    distractors: bool,
    peak: float,
) -> None:
    """Simulate a session of RIG (a shipped rig's name or a folder), with the truth beside it."""
    from urdfcal.cli.console import progress_bar
    from urdfcal.session.files import read_rig
    from urdfcal.session.rigs import find_rig
    from urdfcal.session.simulate import simulate, write_simulated

    if distractors and not images:
        raise click.UsageError("--distractors goes with --images")
    if images and (outliers or pixel is not None):
        raise click.UsageError("--pixel and --outliers do not go with --images: the images decide")
    description = read_rig(find_rig(rig))
    with progress_bar("posing", poses) as advance:
        simulated = simulate(
            description,
            poses=poses,
            seed=seed,
            pixel=pixel,
            error_scale=error_scale,
            outliers=outliers,
            progress=advance,
        )
    if images:
        from urdfcal.session.simulate_images import Exposure, write_simulated_images

        with progress_bar("rendering", None) as advance:
            write_simulated_images(session, simulated, Exposure(peak=peak, distractors=distractors), advance)
    else:
        write_simulated(session, simulated)
    for warning in simulated.session.warnings:
        click.echo(f"- {warning}", err=True)
    click.echo(f"{session}: {poses} poses of {description.chain.name}, seed {seed}; the truth is in truth.urdf")
