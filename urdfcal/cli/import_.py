"""``urdfcal import``: a session from what other programs wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from urdfcal.cli.console import PATH, base_option, progress_bar, say, sheet, terminal

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.cameras.rig import Rig
    from urdfcal.importing.decimals import Decimal
    from urdfcal.importing.handeye import Eye
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.rosbag.clock import Timeline
    from urdfcal.rosbag.importing import ImportSummary
    from urdfcal.rosbag.topics import ChosenTopics
    from urdfcal.session.knowledge import Led


def _led(value: str) -> tuple[str, list[float] | None]:
    """Parse NAME or NAME=x,y,z."""
    name, separator, place = value.partition("=")
    if not separator:
        return name, None
    try:
        position = [float(number) for number in place.split(",")]
    except ValueError:
        position = []
    if len(position) != 3:
        raise click.BadParameter(f"'{place}' is not three numbers such as 0.03,0.02,0.05")
    return name, position


def _camera(value: str) -> tuple[str, tuple[str, str | None]]:
    """Parse NAME=IMAGE_TOPIC[,INFO_TOPIC]."""
    name, _, topics = value.partition("=")
    image, _, info = topics.partition(",")
    if not name or not image:
        raise click.BadParameter(f"'{value}' is not NAME=TOPIC")
    return name, (image, info or None)


def _column(value: str) -> tuple[str, str]:
    """Parse NAME=COLUMN[:UNIT]."""
    name, _, column = value.partition("=")
    if not name or not column:
        raise click.BadParameter(f"'{value}' is not NAME=COLUMN")
    return name, column


_ENDINGS = {"hand-eye samples": (".samples", ".yaml", ".yml"), "a table": (".csv", ".tsv", ".txt")}
_ROBOT = {"urdf", "tip", "base", "led", "described"}
_OPTIONS = {
    "a recording": _ROBOT | {"joints", "named", "targets", "stills", "listing"},
    "a table": _ROBOT | {"columns", "columns_file", "decimal"},
    "hand-eye samples": {"eye"},
}


def _check_options(source: str) -> None:
    """Refuse options that a kind of source has no use for."""
    context = click.get_current_context()
    for option in context.command.params:
        name = option.name or ""
        takers = [kind for kind, options in _OPTIONS.items() if name in options]
        given = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        if given and takers and source not in takers:
            raise click.UsageError(f"{option.opts[0]} goes with {' or '.join(takers)}: this is {source}")


@click.command("import")
@click.argument("path", metavar="SOURCE", type=PATH)
@click.option("-o", "--output", "session", type=PATH, help="Folder to write.")
@click.option("--urdf", metavar="ROBOT.urdf", help="The nominal robot: a file, or package://...  [default: the bag's]")
@click.option("--tip", metavar="LINK", help="Link at the end of the chain.")
@base_option
@click.option("--joints", metavar="TOPIC", help="Of the joint states.  [default: the only one]")
@click.option(
    "--camera", "named", type=_camera, multiple=True, metavar="NAME=TOPIC[,INFO]",
    help="A camera: its images, and its camera_info if that is not beside them.  [default: all]",
)  # fmt: skip
@click.option(
    "--led", type=_led, metavar="NAME[=X,Y,Z]",
    help="The LED, in the tip's frame, m.  [default: led, unless there are targets]",
)  # fmt: skip
@click.option(
    "--cameras", "described", type=PATH, metavar="FILE",
    help="A camera file instead of camera_info, with the cameras' names.",
)  # fmt: skip
@click.option("--targets", type=PATH, metavar="FILE", help="Boards and tags: YAML, targets: as in session.yaml.")
@click.option("--stills", is_flag=True, help="A bag of an arm that stopped to be seen: make poses of its stops.")
@click.option("--list", "listing", is_flag=True, help="Print a bag's topics and write nothing.")
@click.option(
    "--column", "columns", type=_column, multiple=True, metavar="NAME=COLUMN[:UNIT]",
    help="A table: the column of a joint, of pose, x, qx, CAMERA.u ..., in deg, mm if not in rad, m.",
)  # fmt: skip
@click.option(
    "--columns", "columns_file", type=PATH, metavar="FILE", help="The same as YAML, NAME: COLUMN:UNIT a line."
)
@click.option(
    "--decimal", type=click.Choice(["point", "comma"]),
    help="A table: what stands before decimals.  [default: as its numbers show]",
)  # fmt: skip
@click.option("--eye", type=click.Choice(["hand", "base"]), help="Hand-eye samples: what carries the camera.")
def command(
    path: Path,
    session: Path | None,
    urdf: str | None,
    tip: str | None,
    base: str | None,
    joints: str | None,
    named: tuple[tuple[str, tuple[str, str | None]], ...],
    led: tuple[str, list[float] | None] | None,
    described: Path | None,
    targets: Path | None,
    stills: bool,
    listing: bool,
    columns: tuple[tuple[str, str], ...],
    columns_file: Path | None,
    decimal: Decimal | None,
    eye: Eye | None,
) -> None:
    """Make a session of SOURCE, what another program has written.

    A recording of ROS (.bag of ROS 1; folder, .db3 or .mcap of ROS 2): joint readings are sensor_msgs/JointState,
    images Image or CompressedImage. Cameras are named after the namespaces of their topics. The second one's pose is
    taken from a stereo pair's camera_info, or /tf_static.

    A table (.csv, .tsv, .txt), one row a pose: joint readings, and points or poses of a tracker or detections.

    Hand-eye samples (.samples of easy_handeye2, .yaml of MoveIt): poses of a hand, and of a target that a camera sees.
    """
    source = next((kind for kind, endings in _ENDINGS.items() if path.suffix in endings), "a recording")
    _check_options(source)
    if listing:
        _list(path)
        return
    if session is None:
        raise click.UsageError("-o is needed" + ("; --list prints the topics" if source == "a recording" else ""))
    if source == "hand-eye samples":
        _import_samples(path, session, eye)
        return
    from urdfcal.cameras.io.formats import read_cameras
    from urdfcal.cameras.rig import Rig
    from urdfcal.names import check_names
    from urdfcal.session.knowledge import Led

    leds = () if led is None else (Led(*led),)  # type: ignore[arg-type]  # a list serves as an array
    check_names("LEDs", [each.name for each in leds])
    rig = Rig() if described is None else read_cameras([described])
    if source == "a table":
        if urdf is None:
            raise click.UsageError("--urdf is needed: a table says nothing of the robot")
        if len(dict(columns)) < len(columns):
            raise click.UsageError("two columns have the same name: " + ", ".join(name for name, _ in columns))
        _import_table(path, session, (urdf, tip, base), rig, leds, dict(columns), columns_file, decimal)
        return
    if len(dict(named)) < len(named):
        raise click.UsageError(f"two cameras have the same name: {', '.join(name for name, _ in named)}")
    from urdfcal.io.target_keys import read_targets
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.rosbag.bag import open_bag
    from urdfcal.rosbag.importing import KnownRobot, import_bag, read_description
    from urdfcal.rosbag.topics import choose_topics

    with open_bag(path) as bag:
        robot = read_description(bag) if urdf is None else Urdf.read(urdf)
        known = KnownRobot(
            chain=_chain(robot, tip, base),
            leds=leds if leds or targets else (Led("led"),),
            targets=() if targets is None else read_targets(targets),
            rig=rig,
            urdf=robot,
            urdf_reference=urdf or f"{robot.name}.urdf",
        )
        topics = choose_topics(bag.topics, joints, dict(named), infos=described is None)
        count = sum(topic.count for topic in bag.topics if topic.name in topics.names)
        with progress_bar("reading", count) as advance:
            summary = import_bag(bag, topics, known, session, advance, stills=stills)
    _print(topics, summary)
    click.echo(str(session))


def _chain(robot: Urdf, tip: str | None, base: str | None) -> Chain:
    from urdfcal.names import listed
    from urdfcal.robot.chain import Chain

    if tip is None:
        last = [link for link in robot.links if all(joint.parent != link for joint in robot.joints.values())]
        raise click.UsageError(f"--tip is needed; the links at the ends of {robot.name} are {listed(last)}")
    return Chain.from_urdf(robot, tip, base)


def _import_table(
    path: Path,
    folder: Path,
    robot: tuple[str, str | None, str | None],
    rig: Rig,
    leds: tuple[Led, ...],
    columns: dict[str, str],
    columns_file: Path | None,
    decimal: Decimal | None,
) -> None:
    from urdfcal.importing.columns import Column, columns_session, read_columns
    from urdfcal.io.writing import write_session
    from urdfcal.robot.urdf.urdf import Urdf

    reference, tip, base = robot
    said = {} if columns_file is None else read_columns(columns_file)
    said |= {name: Column.parse(text) for name, text in columns.items()}
    urdf = Urdf.read(reference)
    session, notes = columns_session(path, said, _chain(urdf, tip, base), urdf, reference, rig, leds, decimal)
    write_session(folder, session)
    counts = ", ".join(f"{len(table)} {table.kind}" for table in session.measurements)
    say(f"{path}: {len(session.poses)} poses, {counts}")
    for note in notes:
        say(f"- {note}")
    click.echo(str(folder))


def _import_samples(path: Path, folder: Path, eye: Eye | None) -> None:
    from urdfcal.importing.handeye import handeye_session, read_handeye
    from urdfcal.io.writing import write_session

    samples = read_handeye(path, eye)
    session = handeye_session(samples)
    write_session(folder, session)
    say(f"{path}: {len(session.poses)} samples, the camera is on {session.chain.base_link}")
    say(f"- calibrate finds the camera, frame 'tracker', in {session.chain.base_link}")
    click.echo(str(folder))


def _list(path: Path) -> None:
    from urdfcal.rosbag.bag import open_bag

    with open_bag(path) as bag:
        table = sheet(f"{path}, {bag.duration:.3f} s", ["topic", "type", "messages", "Hz"], texts=2)
        for topic in bag.topics:
            rate = f"{(topic.count - 1) / bag.duration:.1f}" if bag.duration and topic.count > 1 else ""
            table.add_row(topic.name, topic.type, f"{topic.count}", rate)
    terminal().print(table)


def _print(topics: ChosenTopics, summary: ImportSummary) -> None:
    say(f"{topics.joints}: {_of('joint states', summary.joints)}")
    for camera in summary.rig.cameras:
        width, height = camera.resolution
        taken = _of("images", summary.cameras[camera.name])
        say(f"{camera.name}: {topics.cameras[camera.name][0]}, {taken}, {width} x {height} px")
    if summary.poses is not None:
        say(f"the arm stood still {summary.poses} times; one image a camera and pose")
    say(f"time 0 is {summary.origin // 10**9}.{summary.origin % 10**9:09d} s")
    for note in (*summary.notes, *summary.warnings):
        say(f"- {note}")


def _of(what: str, times: Timeline) -> str:
    count, span = len(times.time), float(times.time[-1] - times.time[0]) / 1e9
    return f"{count} {what}" + (f" at {(count - 1) / span:.1f} Hz" if span else "")
