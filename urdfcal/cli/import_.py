"""``urdfcal import``: a session from what other programs wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import click
from click.core import ParameterSource

from urdfcal.cli.console import PATH, base_option, progress_bar, say, sheet, terminal

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.cameras.rig import Rig
    from urdfcal.importing.data_set import StateUnit
    from urdfcal.importing.decimals import Decimal
    from urdfcal.importing.handeye import Eye
    from urdfcal.robot.chain import Chain
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.rosbag.clock import Timeline
    from urdfcal.rosbag.importing import ImportSummary, KnownRobot
    from urdfcal.rosbag.topics import ChosenTopics
    from urdfcal.session.knowledge import Led

# What --urdf, --tip and --base say.
_Robot: TypeAlias = "tuple[str | None, str | None, str | None]"
_Said = TypeVar("_Said")


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
    """Parse NAME=COLUMN[:UNIT], or NAME=LINK."""
    name, _, column = value.partition("=")
    if not name or not column:
        raise click.BadParameter(f"'{value}' is not NAME=COLUMN")
    return name, column


_ENDINGS = {"hand-eye samples": (".samples", ".yaml", ".yml"), "a table": (".csv", ".tsv", ".txt")}
_ROBOT = {"urdf", "tip", "base", "led", "described"}
_OPTIONS = {
    "a recording": _ROBOT | {"joints", "topics", "targets", "stills", "listing"},
    "a table": _ROBOT | {"columns", "columns_file", "decimal"},
    "hand-eye samples": {"eye"},
    "a LeRobot data set": _ROBOT | {"topics", "targets", "stills", "columns", "state", "motors", "mounts"},
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
    "--camera", "topics", type=_camera, multiple=True, metavar="NAME=TOPIC[,INFO]",
    help="A camera: its images, or a data set's video, and its camera_info if that is not beside them.  [default: all]",
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
@click.option("--stills", is_flag=True, help="The arm stopped to be seen: make poses of its stops.")
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
@click.option(
    "--state", type=click.Choice(["degrees", "normalized", "radians"]),
    help="A LeRobot data set: what its joint states are in; normalized, from -100 to 100.",
)  # fmt: skip
@click.option(
    "--mount", "mounts", type=_column, multiple=True, metavar="NAME=LINK",
    help="A LeRobot data set: the link that a camera is on.  [default: it stands]",
)  # fmt: skip
@click.option("--motors", type=PATH, metavar="FILE", help="LeRobot's calibration JSON, for normalized states.")
@click.option("--eye", type=click.Choice(["hand", "base"]), help="Hand-eye samples: what carries the camera.")
def command(
    path: Path,
    session: Path | None,
    urdf: str | None,
    tip: str | None,
    base: str | None,
    joints: str | None,
    topics: tuple[tuple[str, tuple[str, str | None]], ...],
    led: tuple[str, list[float] | None] | None,
    described: Path | None,
    targets: Path | None,
    stills: bool,
    listing: bool,
    columns: tuple[tuple[str, str], ...],
    columns_file: Path | None,
    decimal: Decimal | None,
    state: StateUnit | None,
    mounts: tuple[tuple[str, str], ...],
    motors: Path | None,
    eye: Eye | None,
) -> None:
    """Make a session of SOURCE, what another program has written.

    A recording of ROS (.bag of ROS 1; folder, .db3 or .mcap of ROS 2): joint readings are sensor_msgs/JointState,
    images Image or CompressedImage. Cameras are named after the namespaces of their topics. The second one's pose is
    taken from a stereo pair's camera_info, or /tf_static.

    A table (.csv, .tsv, .txt), one row a pose: joint readings, and points or poses of a tracker or detections.

    Hand-eye samples (.samples of easy_handeye2, .yaml of MoveIt): poses of a hand, and of a target that a camera sees.

    A data set of LeRobot (its folder, with meta/info.json): joint states, and the videos of the cameras of --cameras.
    """
    from urdfcal.importing.lerobot import is_data_set

    source = next((kind for kind, endings in _ENDINGS.items() if path.suffix in endings), "a recording")
    source = "a LeRobot data set" if is_data_set(path) else source
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
    from urdfcal.io.target_keys import read_targets
    from urdfcal.session.knowledge import Led

    rig = Rig() if described is None else read_cameras([described])
    leds = () if led is None else (Led(*led),)  # type: ignore[arg-type]  # a list serves as an array
    named, cameras, on = _unique("columns", columns), _unique("cameras", topics), _unique("mounts", mounts)
    if source == "a table":
        _import_table(path, session, (urdf, tip, base), rig, leds, named, columns_file, decimal)
        return
    shown = () if targets is None else read_targets(targets)
    things = {"leds": leds if leds or shown else (Led("led"),), "targets": shown, "rig": rig}
    if source == "a recording":
        _import_bag(path, session, (urdf, tip, base), things, joints, cameras, stills=stills)
        return
    if state is None or described is None:
        raise click.UsageError("a data set needs --state, what its joint states are in, and --cameras FILE")
    if motors is not None and state != "normalized":
        raise click.UsageError("--motors goes with --state normalized: degrees and radians are angles already")
    numbers = state, motors
    _import_data_set(path, session, (urdf, tip, base), things, named, cameras, on, numbers, stills=stills)


def _unique(what: str, pairs: tuple[tuple[str, _Said], ...]) -> dict[str, _Said]:
    if len(dict(pairs)) < len(pairs):
        raise click.UsageError(f"two {what} have the same name: {', '.join(name for name, _ in pairs)}")
    return dict(pairs)


def _known(robot: _Robot, urdf: Urdf, things: dict[str, Any]) -> KnownRobot:
    from urdfcal.rosbag.importing import KnownRobot

    reference, tip, base = robot
    chain = _chain(urdf, tip, base)
    return KnownRobot(chain=chain, urdf=urdf, urdf_reference=reference or f"{urdf.name}.urdf", **things)


def _read_urdf(reference: str | None, source: str) -> Urdf:
    from urdfcal.robot.urdf.urdf import Urdf

    if reference is None:
        raise click.UsageError(f"--urdf is needed: {source} says nothing of the robot")
    return Urdf.read(reference)


def _import_bag(
    path: Path,
    folder: Path,
    robot: _Robot,
    things: dict[str, Any],
    joints: str | None,
    cameras: dict[str, tuple[str, str | None]],
    *,
    stills: bool,
) -> None:
    from urdfcal.robot.urdf.urdf import Urdf
    from urdfcal.rosbag.bag import open_bag
    from urdfcal.rosbag.importing import import_bag, read_description
    from urdfcal.rosbag.topics import choose_topics

    with open_bag(path) as bag:
        known = _known(robot, read_description(bag) if robot[0] is None else Urdf.read(robot[0]), things)
        topics = choose_topics(bag.topics, joints, cameras, infos=not known.rig.cameras)
        count = sum(topic.count for topic in bag.topics if topic.name in topics.names)
        with progress_bar("reading", count) as advance:
            summary = import_bag(bag, topics, known, folder, advance, stills=stills)
    _print(topics, summary)
    click.echo(str(folder))


def _import_data_set(
    path: Path,
    folder: Path,
    robot: _Robot,
    things: dict[str, Any],
    named: dict[str, str],
    cameras: dict[str, tuple[str, str | None]],
    mounts: dict[str, str],
    numbers: tuple[StateUnit, Path | None],
    *,
    stills: bool,
) -> None:
    from urdfcal.importing.data_set import import_data_set, read_joints
    from urdfcal.importing.lerobot import read_data_set
    from urdfcal.names import check_known
    from urdfcal.session.attachments import CameraMount
    from urdfcal.session.model import Setup

    for name, (video, info) in cameras.items():
        check_known(name, things["rig"].names, "cameras", "--camera")
        if info is not None:
            raise click.UsageError(f"--camera {name}={video},{info}: a data set has no camera_info; --cameras says it")
    known = _known(robot, _read_urdf(robot[0], "a data set"), things)
    known = known.carrying([*mounts.values(), *(target.link for target in known.targets if target.link)])
    data = read_data_set(path, {name: cameras.get(name, (name, None))[0] for name in known.rig.names})
    readings = read_joints(data, known.chain.actuated, named, *numbers)
    setup = Setup(**vars(known), mounts=tuple(CameraMount(*pair) for pair in mounts.items()))
    with progress_bar("writing images", None) as advance:
        notes = import_data_set(data, setup, known.urdf, readings, folder, advance, stills=stills)
    say(f"{path}: {len(readings.time)} frames of {len(data.episodes)} episodes")
    for note in notes:
        say(f"- {note}")
    click.echo(str(folder))


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
    robot: _Robot,
    rig: Rig,
    leds: tuple[Led, ...],
    columns: dict[str, str],
    columns_file: Path | None,
    decimal: Decimal | None,
) -> None:
    from urdfcal.importing.columns import Column, columns_session, read_columns
    from urdfcal.io.writing import write_session

    reference, tip, base = robot
    urdf = _read_urdf(reference, "a table")
    said = {} if columns_file is None else read_columns(columns_file)
    said |= {name: Column.parse(text) for name, text in columns.items()}
    session, notes = columns_session(path, said, _chain(urdf, tip, base), urdf, reference or "", rig, leds, decimal)
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
