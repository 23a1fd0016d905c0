"""``urdfcal cameras``: cameras calibrated from images of a board, and camera files converted."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import click

from urdfcal.cli.console import PATH, POSITIVE, progress_bar, say, sheet, terminal
from urdfcal.errors import CameraError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from urdfcal.cameras.board.board import Board, BoardKind
    from urdfcal.cameras.board.calibration import BoardCalibration
    from urdfcal.cameras.io.formats import Format

_BOARD_FILE = "board.yaml"
# Of radtan in Kalibr's own files: k1 k2 p1 p2 (aslam_cv RadialTangentialDistortion).
_KALIBR_COEFFICIENTS = 4


def _pair(value: str | tuple[int, int]) -> tuple[int, int]:
    """Two whole numbers, as 9x6."""
    if isinstance(value, tuple):
        return value
    match = re.fullmatch(r"([1-9]\d{0,5})[xX]([1-9]\d{0,5})", value)
    if match is None:
        raise click.BadParameter(f"'{value}' is not two whole numbers such as 9x6")
    return int(match[1]), int(match[2])


class _CalibrateUnlessNamed(click.Group):
    """A group whose first argument may be left out where it would be ``calibrate``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        # Options before the folder belong to calibrate, too: the group itself has --help alone.
        if args and args[0] not in (*self.commands, *ctx.help_option_names):
            args = ["calibrate", *args]
        return super().parse_args(ctx, args)


@click.group("cameras", cls=_CalibrateUnlessNamed, subcommand_metavar="BOARD_FOLDER -o OUT | convert IN... OUT")
def command() -> None:
    """Calibrate cameras from images of a board, or convert camera files.

    `urdfcal cameras BOARD_FOLDER -o cameras.yaml` is short for `urdfcal cameras calibrate ...`.
    """


@command.command("calibrate")
@click.argument("folder", metavar="BOARD_FOLDER", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Camera file to write (Kalibr).")
@click.option(
    "--board", type=(click.Choice(["chessboard", "charuco"]), _pair), metavar="KIND WxH",
    help="chessboard 9x6 counts inner corners, charuco 10x7 squares.  [default: BOARD_FOLDER/board.yaml]",
)  # fmt: skip
@click.option("--square", type=POSITIVE, metavar="M", help="Side of a square, m.")
@click.option(
    "--measured", type=(click.IntRange(1), POSITIVE, POSITIVE), metavar="N M M",
    help="Length of N squares in a row as measured on the print, and its standard deviation, m.",
)  # fmt: skip
@click.option("--marker", type=POSITIVE, metavar="M", help="ChArUco: side of a marker, m.")
@click.option("--dictionary", metavar="NAME", help="ChArUco: OpenCV's name, such as DICT_4X4_50.")
@click.option("--legacy", is_flag=True, help="ChArUco: printed by OpenCV before 4.6.")
@click.option("--force", is_flag=True, help="Write cameras that these images leave open, too.")
@click.option(
    "--distortion", type=click.Choice(["radtan", "equidistant", "none"]), default="radtan",
    help="Lens model; equidistant for a fisheye.",
)  # fmt: skip
def calibrate(
    folder: Path,
    output: Path,
    board: tuple[BoardKind, tuple[int, int]] | None,
    distortion: str,
    force: bool,
    measured: tuple[int, float, float] | None,
    **details: Any,
) -> None:
    """Calibrate one or several cameras from BOARD_FOLDER/<camera>/<view>.png (or .jpg, .jpeg, .tif, .tiff).

    Images of the same name were taken at the same time. The standard deviations are written beside the cameras, for
    `intrinsics: refine` and `extrinsics: refine` in session.yaml.
    """
    from urdfcal.cameras.board.calibration import calibrate_cameras
    from urdfcal.cameras.board.views import find_images, read_views
    from urdfcal.cameras.io.formats import write_kalibr

    chosen = _board(folder, board, details)
    if measured is not None:
        chosen = chosen.measured(*measured)
    count = sum(len(views) for views in find_images(folder).values())
    with progress_bar("looking for the board", count) as advance:
        views = read_views(folder, chosen, advance)
    calibration = calibrate_cameras(views, chosen, distortion, force=force)
    write_kalibr(output, calibration.rig)
    _print(calibration, output)


@command.command("convert")
@click.argument("files", metavar="IN...", nargs=-1, required=True, type=PATH)
@click.argument("output", metavar="OUT", type=PATH)
@click.option(
    "--to", "format_", type=click.Choice(["kalibr", "ros", "opencv"]),
    help="Format of OUT.  [default: opencv for .xml and .yml, kalibr for .yaml, ros for a folder]",
)  # fmt: skip
@click.option("--size", type=_pair, metavar="WxH", help="Size of the image, for OpenCV files that do not tell it.")
def convert(files: tuple[Path, ...], output: Path, format_: Format | None, size: tuple[int, int] | None) -> None:
    """Convert camera files: Kalibr camchain, ROS camera_info (one a camera, in order), OpenCV FileStorage.

    The format of IN is told by its content. A pair in ROS's format is a folder with one file a camera, as IN, too.
    """
    from urdfcal.cameras.io.formats import read_cameras, write_cameras

    formats: dict[str, Format] = {".xml": "opencv", ".yml": "opencv", ".yaml": "kalibr", "": "ros"}
    chosen = format_ or formats.get("" if output.is_dir() else output.suffix.lower())
    if chosen is None:
        raise click.UsageError(f"'{output.name}' does not tell a format; name it with --to")
    rig = read_cameras(files, size)
    for path in write_cameras(output, rig, chosen):
        click.echo(str(path))
    if chosen == "kalibr" and (five := [c.name for c in rig.cameras if len(c.distortion) > _KALIBR_COEFFICIENTS]):
        say(
            f"{', '.join(five)}: radtan with five coefficients, k3 the last: urdfcal reads it, Kalibr itself only four",
            err=True,
        )
    unplaced = [name for name, T in zip(rig.names, rig.T_cam_world, strict=True) if T is None]
    if unplaced:
        say(f"not known: where {', '.join(unplaced)} stands", err=True)
    if chosen != "kalibr" and any(rig.sigmas):
        say("not kept: the standard deviations, which only Kalibr's format as urdfcal writes it has", err=True)


def _board(folder: Path, board: tuple[BoardKind, tuple[int, int]] | None, details: Mapping[str, Any]) -> Board:
    from urdfcal.cameras.board.board import Board, read_board

    if board is None:
        if any(details.values()):
            raise click.UsageError("--square, --marker, --dictionary and --legacy go with --board")
        if not (folder / _BOARD_FILE).exists() and folder.is_dir():
            what = f"there is no {_BOARD_FILE} that describes the board"
            remedy = "Write one (type, columns, rows, square), or use --board chessboard 9x6 --square 0.025."
            raise CameraError(what, where=str(folder), remedy=remedy)
        return read_board(folder / _BOARD_FILE)
    if details["square"] is None:
        raise click.UsageError("--board needs --square, the side of a square in metres")
    kind, (columns, rows) = board
    return Board(kind, columns, rows, **details)


def _print(calibration: BoardCalibration, output: Path) -> None:
    import numpy as np

    console = terminal()
    scale = calibration.board.scale_sigma
    known = "" if scale is None else f", measured to {100 * scale:.2g} % (standard deviation)"
    console.print(f"{calibration.board.title}{known}", markup=False)
    rig = calibration.rig

    quality = sheet("images", ["camera", "used", "corners", "residual (px)", "coverage", "tilt (deg)", "worst view"])
    for q in calibration.qualities:
        worst = int(np.argmax(q.rms))
        seen = [q.name, f"{len(q.views)}", f"{q.corners}", f"{q.sigma:.3f}", f"{100 * q.coverage:.0f} %"]
        tilts = f"{q.tilts.min():.0f} to {q.tilts.max():.0f}"
        quality.add_row(*seen, tilts, f"{q.views[worst]}, {q.rms[worst]:.3f} px")
    console.print(quality)

    lenses = sheet("cameras ± standard deviation", ["camera", "parameter", "value", "±"], texts=2)
    for camera, T, sigma in zip(rig.cameras, rig.T_cam_world, rig.sigmas, strict=True):
        if sigma is None:
            continue
        for name, value, s in zip(camera.parameter_names, camera.parameters, sigma.parameters, strict=True):
            digits = 3 if name in ("fx", "fy", "cx", "cy") else 6
            lenses.add_row(camera.name, name, f"{value:.{digits}f}", f"{s:.{digits}f}")
        if T is not None and sigma.pose is not None:
            # A small motion (v, w) after T moves the first camera's centre t by v + w x t, its distance by t·v / |t|.
            t, x = T[:3, 3], calibration.names.index(f"{camera.name}.x")
            away = t @ calibration.covariance[x : x + 3, x : x + 3] @ t
            distance = float(np.linalg.norm(t))
            lenses.add_row(
                camera.name, f"to {rig.names[0]} (mm)", f"{1e3 * distance:.3f}", f"{1e3 * np.sqrt(away) / distance:.3f}"
            )
            turn = 1e3 * np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
            deviation = 1e3 * np.linalg.norm(sigma.pose[3:])
            lenses.add_row(camera.name, f"turned against {rig.names[0]} (mrad)", f"{turn:.3f}", f"{deviation:.3f}")
    console.print(lenses)

    rejected = [f"{of.camera}/{of.view} not used: {of.reason}" for of in calibration.rejected]
    for text in (*rejected, *calibration.warnings):
        console.print(f"- {text}", markup=False)
    console.print(str(output), markup=False)
