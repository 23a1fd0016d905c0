"""Ways to break the session that ``making.write_valid`` writes, each with what is to be said about it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.io import making

Edit = Callable[[Path], None]


@dataclass(frozen=True)
class Broken:
    """A broken session: what is done to the valid one, and the piece of message that must come."""

    name: str
    edit: Edit
    expect: str


def swap(file: str, old: str, new: str) -> Edit:
    """Replace the first ``old``, which must be there, by ``new``."""

    def edit(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text, f"{old!r} is not in {file}"
        (folder / file).write_text(text.replace(old, new, 1))

    return edit


def append(file: str, text: str) -> Edit:
    return lambda folder: (folder / file).write_text((folder / file).read_text() + text) and None


def write(file: str, data: bytes) -> Edit:
    return lambda folder: (folder / file).write_bytes(data) and None


def remove(file: str) -> Edit:
    return lambda folder: (folder / file).unlink()


def in_millimetres(folder: Path) -> None:
    def thousandfold(found: re.Match[str]) -> str:
        return f'{found[1]}"{" ".join(str(1000.0 * float(x)) for x in found[2].split())}"'

    text = (folder / URDF).read_text()
    (folder / URDF).write_text(re.sub(r'(<origin xyz=)"([^"]*)"', thousandfold, text))


def cells(file: str, change: Callable[[int, dict[str, str]], dict[str, str] | None]) -> Edit:
    """Change the rows of a table: ``change`` gets the row's number and its cells by column."""

    def edit(folder: Path) -> None:
        header, *lines = (folder / file).read_text().split()
        names = header.split(",")
        rows = (change(i, dict(zip(names, line.split(","), strict=True))) for i, line in enumerate(lines))
        kept = [",".join(row.values()) for row in rows if row is not None]
        (folder / file).write_text("\n".join([header, *kept]) + "\n")

    return edit


def put(file: str, row: int, **values: str) -> Edit:
    """Set cells of one row, counted from 0 below the header."""
    return cells(file, lambda i, cells: {**cells, **values} if i == row else cells)


def several(*edits: Edit) -> Edit:
    return lambda folder: [edit(folder) for edit in edits] and None


def scaled(file: str, factor: float, *columns: str) -> Edit:
    return cells(
        file,
        lambda _, row: {name: repr(factor * float(cell)) if name in columns else cell for name, cell in row.items()},
    )


def measured_points(edit: Edit) -> Edit:
    """Break the session that a tracker measured instead of the one with cameras."""

    def both(folder: Path) -> None:
        making.write_points(folder)
        edit(folder)

    return both


def renamed_cameras(_: int, row: dict[str, str]) -> dict[str, str]:
    return {**row, "camera": {"left": "right", "right": "left"}[row["camera"]]}


def exchanged_pixels(_: int, row: dict[str, str]) -> dict[str, str]:
    return {**row, "u": row["v"], "v": row["u"]}


def frozen_camera(folder: Path) -> None:
    lines = (folder / "detections.csv").read_text().split()
    # Pose 3 shows what pose 2 shows.
    lines[13:17] = [re.sub("^2", "3", line) for line in lines[9:13]]
    (folder / "detections.csv").write_text("\n".join(lines) + "\n")


def half_resolution(folder: Path) -> None:
    text = (folder / "cameras.yaml").read_text()
    text = text.replace("[1280, 1024]", "[640, 512]").replace(
        "[1400.0, 1400.0, 640.0, 512.0]", "[700.0, 700.0, 320.0, 256.0]"
    )
    (folder / "cameras.yaml").write_text(text)


# Nine levels of nine references each.
BILLIONS = "leds:\n  - &a0 [x, x]\n"
BILLIONS += "".join(f"  - &a{i + 1} [{', '.join([f'*a{i}'] * 9)}]\n" for i in range(9)) + "robot: *a9\n"

YAML, CAMERAS, JOINTS = "session.yaml", "cameras.yaml", "joints.csv"
PIXELS, POINTS, URDF = "detections.csv", "points.csv", "arm.urdf"

BROKEN = [
    # session.yaml
    Broken("no session.yaml", remove(YAML), "there is no session.yaml in this folder"),
    Broken("empty session.yaml", write(YAML, b""), "session.yaml: the file is empty"),
    Broken("tab in the YAML", swap(YAML, "  tip_link", "\ttip_link"), "session.yaml:4:1: this is no YAML: "),
    Broken("a list for a mapping", write(YAML, b"- robot\n"), "session.yaml:1:1: ['robot'] stands where a mapping"),
    Broken(
        "key twice",
        append(YAML, "joints: j.csv\n"),
        "session.yaml:12:1: this is no YAML: the key 'joints' is already in line 9",
    ),
    Broken(
        "nested without end",
        write(YAML, b"robot: " + b"[" * 5000),
        "session.yaml: this is no YAML: it is nested too deeply",
    ),
    Broken(
        "Latin-1",
        write(YAML, "robot: {urdf: ärmchen.urdf}\n".encode("latin-1")),
        "session.yaml:1: byte 0xe4 is not UTF-8",
    ),
    Broken(
        "misspelt key",
        swap(YAML, "robot:", "robt:"),
        "session.yaml:1:1, key 'robt': unknown key 'robt' (and 1 more to put right). Did you mean 'robot'?",
    ),
    Broken(
        "misspelt inner key",
        swap(YAML, "tip_link", "tiplink"),
        "session.yaml:4:3, key 'robot.tiplink': unknown key 'tiplink'",
    ),
    Broken(
        "no tip link",
        swap(YAML, "  tip_link: tip\n", ""),
        "key 'robot.tip_link': the key 'tip_link' is missing. The keys are: urdf, tip_link, base_link",
    ),
    Broken(
        "no LED",
        swap(YAML, "  red: {position: [0.05, 0.02, 0.03], sigma: 0.005}\n  blue: {}", "  {}"),
        "there is neither an LED nor a target: name at least one",
    ),
    Broken(
        "text for a number",
        swap(YAML, "pixel: 0.1", "pixel: 0.1 px"),
        "session.yaml:11:9, key 'noise.pixel': '0.1 px' stands where a number belongs",
    ),
    Broken(
        "truth for a number",
        swap(YAML, "pixel: 0.1", "pixel: yes"),
        "key 'noise.pixel': True stands where a number belongs",
    ),
    Broken("noise of zero", swap(YAML, "pixel: 0.1", "pixel: 0"), "key 'noise.pixel': 0 is not greater than 0"),
    Broken(
        "noise not finite", swap(YAML, "pixel: 0.1", "joint: .nan"), "key 'noise.joint': nan is not a finite number"
    ),
    Broken(
        "unknown geometry",
        append(YAML, "estimate: {geometry: hd}\n"),
        "key 'estimate.geometry': 'hd' is not 'dh', 'offsets', 'full' or 'none'",
    ),
    Broken(
        "two coordinates",
        swap(YAML, "[0.05, 0.02, 0.03]", "[0.05, 0.02]"),
        "session.yaml:6:9, key 'leds.red.position': [0.05, 0.02] has 2 values, not 3",
    ),
    Broken(
        "sigma of nowhere",
        swap(YAML, "blue: {}", "blue: {sigma: 0.01}"),
        "key 'leds.blue': sigma is given without a position",
    ),
    Broken(
        "tolerance of nothing",
        append(YAML, "tolerances: {ellbow: {a: 0}}\n"),
        "key 'tolerances.ellbow': there is no joint 'ellbow' between 'base' and 'tip'. Did you mean 'elbow'?",
    ),
    Broken(
        "unknown parameter",
        append(YAML, "tolerances: {elbow: {b: 0}}\n"),
        "key 'tolerances.elbow.b': 'b' is not 'theta', 'd', 'a', 'alpha' or 'beta'",
    ),
    Broken(
        "negative tolerance", append(YAML, "tolerances: {length: -1}\n"), "key 'tolerances.length': -1 is less than 0"
    ),
    Broken("nothing measured", swap(YAML, "detections: detections.csv\n", ""), "none of detections, points"),
    Broken("no cameras named", swap(YAML, "cameras: cameras.yaml\n", ""), "detections are named, but no cameras"),
    Broken(
        "file not there",
        swap(YAML, "joints.csv", "joint.csv"),
        "session.yaml:9:1, key 'joints': there is no file 'joint.csv'. Did you mean 'joints.csv'?",
    ),
    Broken(
        "LED in millimetres",
        swap(YAML, "[0.05, 0.02, 0.03]", "[50, 20, 30]"),
        "session.yaml:6:9, key 'leds.red.position': 61.6441 m from the tip looks like millimetres",
    ),
    Broken(
        "LED sigma in millimetres",
        swap(YAML, "sigma: 0.005", "sigma: 5"),
        "key 'leds.red.sigma': a sigma of 5 m looks like millimetres",
    ),
    Broken(
        "noise of an image",
        swap(YAML, "pixel: 0.1", "pixel: 100"),
        "key 'noise.pixel': a sigma of 100 px is of the size of the image",
    ),
    Broken(
        "joint noise in degrees",
        swap(YAML, "pixel: 0.1", "pixel: 0.1, joint: 0.5"),
        "key 'noise.joint': a joint noise of 0.5 rad is no reading noise",
    ),
    Broken("a file name too long", swap(YAML, "joints.csv", "j" * 300), "key 'joints': there is no file 'jjj"),
    Broken(
        "an empty list",
        append(YAML, "led_distances: [{leds: [], distance: 1, sigma: 1}]\n"),
        "key 'led_distances.0.leds.0'",
    ),
    Broken("a list of billions", write(YAML, BILLIONS.encode()), "key 'robot': [[...], [...],"),
    # cameras.yaml
    Broken("no camera file", remove(CAMERAS), "key 'cameras': there is no file 'cameras.yaml'"),
    Broken("camera file no YAML", swap(CAMERAS, "  intrinsics: [1400.0,", "  intrinsics: 1400.0]"), "cameras.yaml:3:"),
    Broken("three intrinsics", swap(CAMERAS, "[1400.0, 1400.0, 640.0, 512.0]", "[1400.0, 640.0, 512.0]"), "intrinsics"),
    Broken("unknown lens", swap(CAMERAS, "distortion_model: none", "distortion_model: omni"), "omni"),
    Broken(
        "coefficients of no lens",
        swap(CAMERAS, "none\n  distortion_coeffs: []", "radtan\n  distortion_coeffs: [0, 1e30, 0, 0]"),
        "no lens bends",
    ),
    Broken("focal length in millimetres", swap(CAMERAS, "[1400.0, 1400.0,", "[16.0, 16.0,"), "looks like millimetres"),
    Broken("image too small", half_resolution, "lies outside the 640 x 512 image of camera"),
    # joints.csv
    Broken("no joint file", remove(JOINTS), "key 'joints': there is no file 'joints.csv'"),
    Broken(
        "empty table",
        write(JOINTS, b"\n\n"),
        "joints.csv: the file is empty. Its first line names the columns: pose,waist,shoulder,slide,roll",
    ),
    Broken(
        "only a header",
        write(JOINTS, b"pose,waist,shoulder,slide,roll\n"),
        "joints.csv:1: there are no rows below the header",
    ),
    Broken("two poses", cells(JOINTS, lambda i, row: row if i < 2 else None), "joints.csv: 2 poses are too few"),
    Broken("column missing", swap(JOINTS, "slide", "time"), "joints.csv:1: the column is missing: 'slide'"),
    Broken(
        "column unknown", swap(JOINTS, "waist", "wasit"), "joints.csv:1: unknown column 'wasit'. Did you mean 'waist'?"
    ),
    Broken(
        "column twice", swap(JOINTS, "waist,shoulder", "waist,waist"), "joints.csv:1: the column 'waist' is named twice"
    ),
    Broken(
        "semicolons",
        lambda folder: write(JOINTS, (folder / JOINTS).read_bytes().replace(b",", b";"))(folder),
        "joints.csv:1: the columns are separated by semicolons. Use commas",
    ),
    Broken(
        "UTF-16",
        lambda folder: write(JOINTS, (folder / JOINTS).read_text().encode("utf-16"))(folder),
        "joints.csv:1: UTF-16 is not UTF-8 text",
    ),
    Broken("ragged row", swap(JOINTS, ",-0.1381,", ","), "joints.csv:2: 4 cells where the header names 5"),
    Broken("empty line inside", swap(JOINTS, "\n3,", "\n\n3,"), "joints.csv:5: the line is empty"),
    Broken("unclosed quote", swap(JOINTS, "\n3,", '\n"3,'), "joints.csv:5: a quote is opened and not closed"),
    Broken(
        "quote over two lines",
        swap(JOINTS, "\n3,0.3574,-0.2798,0.2097,-1.9461\n", '\n3,0.3574,-0.2798,0.2097,"-1.\n9461"\n'),
        "joints.csv:5: a quote is opened and not closed",
    ),
    Broken("text in a cell", put(JOINTS, 2, slide="open"), "joints.csv:4:16: slide: 'open' is not a number"),
    Broken("empty cell", put(JOINTS, 2, slide=""), "joints.csv:4:16: slide: the cell is empty"),
    Broken("not a number", put(JOINTS, 2, slide="nan"), "joints.csv:4:16: slide: nan is not a finite number"),
    Broken("infinite", put(JOINTS, 2, roll="-inf"), "joints.csv:4:23: roll: -inf is not a finite number"),
    Broken("overflow", put(JOINTS, 2, roll="1e999"), "joints.csv:4:23: roll: 1e999 is not a finite number"),
    Broken("damaged number", put(JOINTS, 2, roll="1_3"), "joints.csv:4:23: roll: '1_3' is not a number"),
    Broken("pose twice", put(JOINTS, 3, pose="2"), "joints.csv:5:1: pose '2' is already in line 4"),
    Broken("pose without label", put(JOINTS, 3, pose=""), "joints.csv:5:1: pose: the cell is empty"),
    Broken(
        "degrees",
        scaled(JOINTS, 180.0 / np.pi, "waist", "shoulder", "roll"),
        "joints.csv:2:3: the readings of waist, shoulder, roll look like degrees: waist is 7.84952. Write radians",
    ),
    Broken(
        "millimetres",
        scaled(JOINTS, 1000.0, "slide"),
        "joints.csv:2:17: the readings of slide look like millimetres: slide is 30.7. Write metres",
    ),
    Broken(
        "outside limits",
        put(JOINTS, 2, shoulder="1.85"),
        "joints.csv:4:10: shoulder = 1.85 rad is outside the joint's limits [-1.8, 1.8]",
    ),
    # detections.csv
    Broken("no sightings", write(PIXELS, b"pose,camera,led,u,v\n"), "detections.csv:1: there are no rows"),
    Broken("no column v", swap(PIXELS, "u,v", "u,sigma"), "detections.csv:1: the column is missing: 'v'"),
    Broken(
        "capital column",
        swap(PIXELS, "u,v", "U,v"),
        "detections.csv:1: unknown column 'U'. Did you mean 'u'? Upper and lower case differ",
    ),
    Broken(
        "pixel is text", put(PIXELS, 5, v="x12"), "detections.csv:7:21: v: 'x12' is not a number. Leave the row out"
    ),
    Broken("pixel is missing", put(PIXELS, 5, u=""), "detections.csv:7:13: u: the cell is empty. Leave the row out"),
    Broken("pose unknown", put(PIXELS, 5, pose="1.0"), "detections.csv:7:1: there is no pose '1.0'. Did you mean '1'?"),
    Broken(
        "camera unknown",
        put(PIXELS, 5, camera="Left"),
        "detections.csv:7:3: there is no camera 'Left'. Did you mean 'left'? Upper and lower case differ",
    ),
    Broken(
        "LED unknown",
        put(PIXELS, 5, led="green"),
        "detections.csv:7:8: there is no led 'green'. The LEDs are: red, blue",
    ),
    Broken(
        "seen twice",
        put(PIXELS, 6, camera="left"),
        "detections.csv:8:1: pose '1', camera 'left', led 'red' is already in line 6",
    ),
    Broken("sigma of zero", lambda folder: add_sigma(folder, "0"), "detections.csv:4:29: sigma: 0 is not positive"),
    Broken(
        "sigma of an image",
        lambda folder: add_sigma(folder, "300"),
        "detections.csv:4:29: a sigma of 300 px is of the size of the image",
    ),
    Broken(
        "outside the image",
        several(put(PIXELS, 5, u="1300.5"), put(PIXELS, 9, u="1300.5")),
        "detections.csv:7:13: (1300.5, 722.462) lies outside the 1280 x 1024 image of camera 'left', as do 1 more",
    ),
    Broken("cameras exchanged", cells(PIXELS, renamed_cameras), "cameras 'left' and 'right' look exchanged"),
    Broken("u and v exchanged", cells(PIXELS, exchanged_pixels), "u and v look exchanged"),
    Broken(
        "frozen camera",
        frozen_camera,
        "detections.csv:14:1: pose '3' shows exactly what pose '2' shows (line 10), but the joints have moved",
    ),
    # points.csv
    Broken(
        "points in millimetres",
        measured_points(scaled(POINTS, 1000.0, "x", "y", "z")),
        "which looks like millimetres: the arm reaches",
    ),
    Broken(
        "one point far off",
        measured_points(put(POINTS, 4, y="340.0")),
        "points.csv:6:7: the point lies 340 m from the others",
    ),
    Broken("point is text", measured_points(put(POINTS, 4, y="-")), "points.csv:6:16: y: '-' is not a number"),
    Broken(
        "point twice",
        measured_points(put(POINTS, 5, led="red")),
        "points.csv:7:1: pose '2', led 'red' is already in line 6",
    ),
    Broken(
        "point noise in millimetres",
        measured_points(swap(YAML, "1e-4", "2")),
        "key 'noise.point': a sigma of 2 m is of the size of the arm. Write one standard deviation in m",
    ),
    # the URDF
    Broken("no URDF", remove(URDF), "arm.urdf"),
    Broken(
        "URDF in millimetres",
        in_millimetres,
        "session.yaml:2:3, key 'robot.urdf': the URDF's lengths look like millimetres",
    ),
    Broken("no package", swap(YAML, "arm.urdf", "package://nowhere/arm.urdf"), "package://nowhere/arm.urdf"),
    Broken("not XML", swap(URDF, '<link name="base"/>', '<link name="base">'), "arm.urdf:"),
    Broken(
        "entities", swap(URDF, '<robot name="arm">', '<!DOCTYPE r [<!ENTITY a "b">]><robot name="arm">'), "arm.urdf:2"
    ),
    Broken("no such tip", swap(YAML, "tip_link: tip", "tip_link: tool0"), "there is no link 'tool0'"),
    Broken(
        "base below tip",
        swap(YAML, "base_link: base", "base_link: finger"),
        "base link 'finger' is not above tip link 'tip'",
    ),
    Broken(
        "no movable joint",
        swap(YAML, "base_link: base", "base_link: wrist"),
        "no movable joint between 'wrist' and 'tip'",
    ),
    Broken("two roots", swap(URDF, '<link name="base"/>', '<link name="base"/><link name="table"/>'), "root"),
    Broken(
        "zero axis", swap(URDF, '<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'), "joint 'waist': the joint's axis is zero"
    ),
    Broken("floating joint", swap(URDF, 'type="revolute"', 'type="floating"'), "joint 'waist'"),
    Broken(
        "mimic of a joint elsewhere",
        swap(URDF, 'mimic joint="shoulder"', 'mimic joint="grip"'),
        "joint 'elbow': it mimics 'grip'",
    ),
]


def add_sigma(folder: Path, value: str) -> None:
    """Give detections.csv a column sigma, all 0.1 but the third."""
    header, *lines = (folder / PIXELS).read_text().split()
    rows = [f"{line},{value if i == 2 else 0.1}" for i, line in enumerate(lines)]
    (folder / PIXELS).write_text("\n".join([f"{header},sigma", *rows]) + "\n")
