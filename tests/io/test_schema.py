from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from urdfcal.errors import SessionError
from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.measurements import MEASUREMENTS
from urdfcal.io.schema import RigFile, SessionFile
from urdfcal.io.yaml_document import Document
from urdfcal.session.knowledge import Estimate, Noise, Tolerances

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.estimation.measurements import Measurement
    from urdfcal.io.schema import SetupFile

_NAMES = [repr(model.name) for model in JOINT_MODELS]
_EVERY_MODEL = f"{', '.join(_NAMES[:-1])} or {_NAMES[-1]}"
LEAST = "robot: {urdf: a.urdf, tip_link: tip}\nleds:\n  led:\njoints: j.csv\npoints: p.csv\n"


def read(tmp_path: Path, text: str, model: type[SetupFile] = SessionFile) -> SetupFile:
    path = tmp_path / "session.yaml"
    path.write_text(text)
    return Document.read(path).validate(model)


def test_the_least_that_is_needed_takes_the_defaults(tmp_path: Path) -> None:
    setup = read(tmp_path, LEAST).setup()
    assert setup["noise"] == Noise()
    assert setup["estimate"] == Estimate()
    assert setup["tolerances"] == Tolerances()
    (led,) = setup["leds"]
    assert (led.name, led.position, led.sigma) == ("led", None, None)


def test_everything_that_may_be_said(tmp_path: Path) -> None:
    text = LEAST.replace("  led:", "  led: {position: [1, 0.5, -2e-3], sigma: 0}")
    text += "noise: {pixel: 1, point: 1e-5, joint: 1E-4}\n"
    text += "estimate: {geometry: none, intrinsics: refine, extrinsics: free}\n"
    text += "tolerances: {length: 2e-3, angle: 0, zero: 1, j: {theta: 0, a: 1.5}}\n"
    setup = read(tmp_path, text).setup()
    assert setup["noise"] == Noise(1.0, 1e-5, 1e-4)
    assert setup["estimate"] == Estimate("none", "refine", "free")
    assert setup["tolerances"] == Tolerances(2e-3, 0.0, 1.0, {"j": {"theta": 0.0, "a": 1.5}})
    assert setup["leds"][0].position.tolist() == [1.0, 0.5, -2e-3]
    assert setup["leds"][0].sigma == 0.0


def test_auto_leaves_all_to_the_calibration(tmp_path: Path) -> None:
    assert read(tmp_path, LEAST + "estimate: auto\n").setup()["estimate"] == Estimate()
    with pytest.raises(SessionError, match="'all' stands where a mapping"):
        read(tmp_path, LEAST + "estimate: all\n")


def test_joint_models_are_asked_for_by_name(tmp_path: Path) -> None:
    assert read(tmp_path, LEAST).setup()["joint_models"] == {}
    text = LEAST + "joint_models: {zero_offset: on, time_offset: false}\n"
    assert read(tmp_path, text).setup()["joint_models"] == {"zero_offset": True, "time_offset": False}


def test_joint_models_are_asked_for_joint_by_joint_or_left_to_the_measurements(tmp_path: Path) -> None:
    text = LEAST + "joint_models: {compliance: on, harmonics: {joint_2: on, joint_3: off}}\n"
    said = {"compliance": True, "harmonics": {"joint_2": True, "joint_3": False}}
    assert read(tmp_path, text).setup()["joint_models"] == said
    assert read(tmp_path, LEAST + "joint_models: auto\n").setup()["joint_models"] == {}


@pytest.mark.parametrize("name", [model.name for model in JOINT_MODELS])
def test_every_joint_model_has_a_key(tmp_path: Path, name: str) -> None:
    text = LEAST + f"joint_models: {{{name}: true}}\n"
    assert read(tmp_path, text).setup()["joint_models"] == {name: True}


@pytest.mark.parametrize("kind", MEASUREMENTS)
def test_every_kind_of_measurement_has_a_key_for_its_noise(tmp_path: Path, kind: type[Measurement]) -> None:
    assert read(tmp_path, LEAST).setup()["noise"].of(kind) == kind.usual
    noise = read(tmp_path, LEAST + f"noise: {{{kind.noise}: 0.25}}\n").setup()["noise"]
    assert noise.of(kind) == 0.25
    assert all(noise.of(other) == other.usual for other in MEASUREMENTS if other is not kind)


@pytest.mark.parametrize("name", ["1", "on", "no", "1e3", "0x10", "~", "2001-01-01"])
def test_names_are_text_as_written(tmp_path: Path, name: str) -> None:
    assert [led.name for led in read(tmp_path, LEAST.replace("led:", f"{name}:")).setup()["leds"]] == [name]


@pytest.mark.parametrize("number", ["1e-4", "1.0e-4", "1.E-4", "0.1e-3", "1e-04", ".0001", "+1e-4"])
def test_numbers_as_people_write_them(tmp_path: Path, number: str) -> None:
    assert read(tmp_path, LEAST + f"noise: {{pixel: {number}}}\n").setup()["noise"].pixel == 1e-4


def test_anchors_are_followed(tmp_path: Path) -> None:
    text = LEAST.replace("  led:", "  a: &a {position: [0, 0, 1], sigma: 0.1}\n  b: {<<: *a, sigma: 0.2}")
    a, b = read(tmp_path, text).setup()["leds"]
    assert a.position.tolist() == b.position.tolist() == [0.0, 0.0, 1.0]
    assert (a.sigma, b.sigma) == (0.1, 0.2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\n---\nb: 2\n", "2:1: this is no YAML: but found another document"),
        ("? [a, b]\n: 1\n", "1:3: this is no YAML: a key is not text"),
        ("a: !!python/object:os.system {}\n", "1:4: this is no YAML: could not determine a constructor"),
        ("a: *b\n", "1:4: this is no YAML: found undefined alias 'b'"),
        ("a: {b: 1, b: 2}\n", "1:11: this is no YAML: the key 'b' is already in line 1"),
        ("a: \x01\n", "session.yaml:1: this is no YAML: special characters are not allowed"),
        ("# nothing\n", "the file is empty"),
        (LEAST + "stand: {position: [0, 0, 0], look_at: [0, 0, 1]}\n", "unknown key 'stand'"),
        (LEAST.replace("led:", "' led':"), "' led' begins or ends with a blank"),
        (
            LEAST + "joint_models: {time_ofset: true}\n",
            f"session.yaml:6:16, key 'joint_models.time_ofset': 'time_ofset' is not {_EVERY_MODEL}",
        ),
        (
            LEAST + "joint_models: {time_offset: 1}\n",
            "session.yaml:6:16, key 'joint_models.time_offset': 1 stands where on or off belongs",
        ),
        (LEAST + "joint_models: {time_offset: maybe}\n", "session.yaml:6:16, key 'joint_models.time_offset': "),
        (LEAST + "joint_models: [time_offset]\n", "key 'joint_models': ['time_offset'] stands where a mapping"),
        (LEAST.replace("tip}", "7}"), "key 'robot.tip_link': 7 stands where text belongs"),
    ],
)
def test_what_is_not_understood_is_refused_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SessionError) as caught:
        read(tmp_path, text)
    assert message in str(caught.value)


def test_a_rig_stands_somewhere_and_measures_nothing(tmp_path: Path) -> None:
    rig = LEAST.replace("joints: j.csv\npoints: p.csv", "cameras: c.yaml")
    assert read(tmp_path, rig, RigFile).stand is None  # where all cameras ride on the robot, as read_rig checks
    with pytest.raises(SessionError, match="position and look_at are the same place"):
        read(tmp_path, rig + "stand: {position: [0, 0, 1], look_at: [0, 0, 1]}\n", RigFile)
    with pytest.raises(SessionError, match="unknown key 'joints'"):
        read(tmp_path, rig + "stand: {position: [0, 0, 1], look_at: [0, 0, 0]}\njoints: j.csv\n", RigFile)
    assert isinstance(read(tmp_path, rig + "stand: {position: [0, 0, 1], look_at: [0, 0, 0]}\n", RigFile), RigFile)
