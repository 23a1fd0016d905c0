"""A simulated arm bends, lags and errs as it is told to, and calibration finds it."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import pinocchio as pin
import pytest
import yaml

from urdfcal.cli import run
from urdfcal.errors import SessionError
from urdfcal.estimation.blocks.arm import ARM
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig, shipped_rigs
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate, JointError, Payload
from urdfcal.simulation.motion import MotionSettings, set_in_motion
from urdfcal.simulation.simulate import simulate

if TYPE_CHECKING:
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.simulation.truth import Simulated

UR5_JOINT = 2  # the elbow
RANGES = {"compliance": (1e-5, 7e-5), "backlash": (1e-4, 1e-3), "lag": (1e-4, 5e-4), "gain": (2e-4, 7e-4)}
RANGES["gravity_backlash"] = RANGES["backlash"]
RANGES["bending"] = (5e-7, 2e-5)


def simulated_with(errors: dict[str, Any], rig: str = "ur5", poses: int = 10, seed: int = 0, **said: Any) -> Simulated:
    return simulate(replace(read_rig(find_rig(rig)), errors=errors, **said), poses=poses, seed=seed)


def errors_of(data: Simulated) -> Floats:
    return data.truth.q - data.truth.readings


def in_order(q: Floats) -> Floats:
    return np.diff(q, axis=0, prepend=q[:1])


def test_joints_are_where_each_error_puts_them() -> None:
    # The formulas once more, on their own: torques by finite differences of the potential energy.
    box = Payload("tool0", 3.0, np.array([0.02, 0.0, 0.1]))
    data = simulated_with({"compliance": 4e-5}, payload=box)
    model = pin.buildModelFromXML(data.session.urdf.text)
    flange = model.getFrameId("tool0")
    mass = model.addFrame(pin.Frame("box", model.frames[flange].parentJoint, model.frames[flange].placement
                                    * pin.SE3(np.eye(3), np.array(box.center)), pin.FrameType.OP_FRAME))  # fmt: skip
    state = model.createData()

    def energy(q: Floats) -> float:
        pin.framesForwardKinematics(model, state, q)
        return float(pin.computePotentialEnergy(model, state, q) + box.mass * 9.81 * state.oMf[mass].translation[2])

    for q, error in zip(data.truth.readings, errors_of(data), strict=True):
        steps = 1e-5 * np.eye(len(q))
        torque = [(energy(q + step) - energy(q - step)) / 2e-5 for step in steps]
        np.testing.assert_allclose(error, -4e-5 * np.array(torque), atol=1e-9)

    bent = errors_of(simulated_with({"compliance": 4e-5}))
    data = simulated_with({"gain": -1e-3})
    np.testing.assert_allclose(errors_of(data), -1e-3 * data.truth.readings, atol=1e-15)
    data = simulated_with({"lag": 3e-4})
    np.testing.assert_allclose(errors_of(data), -3e-4 * in_order(data.truth.readings), atol=1e-15)
    data = simulated_with({"backlash": 1e-3})
    np.testing.assert_allclose(errors_of(data), -0.5e-3 * np.sign(in_order(data.truth.readings)), atol=1e-15)
    data = simulated_with({"gravity_backlash": 1e-3})
    sagging = np.sign(np.where(np.abs(bent) > 4e-5 * 0.01, bent, 0.0))
    np.testing.assert_allclose(errors_of(data), 0.5e-3 * sagging, atol=1e-15)
    assert not sagging[:, 0].any()  # gravity does not load an upright axis
    data = simulated_with({"eccentricity": {"elbow_joint": 1e-3}}, poses=40)
    error, q = errors_of(data), data.truth.readings[:, UR5_JOINT]
    waves = np.stack([np.sin(q), np.cos(q), np.sin(2.0 * q), np.cos(2.0 * q)], axis=1)
    s, k, s2, k2 = np.linalg.lstsq(waves, error[:, UR5_JOINT], rcond=None)[0]
    assert (np.hypot(s, k), np.hypot(s2, k2)) == pytest.approx((1e-3, 3e-4))
    np.testing.assert_allclose(error[:, UR5_JOINT], waves @ [s, k, s2, k2], atol=1e-15)
    assert np.all(np.delete(error, UR5_JOINT, axis=1) == 0.0)


def test_what_a_joint_reads_is_what_it_would_without_errors() -> None:
    plain, sizes = simulated_with({}), {"compliance": "default", "lag": 1e-4}
    bent = simulated_with(sizes)
    assert plain.truth.q.tobytes() == plain.truth.readings.tobytes() == bent.truth.readings.tobytes()
    assert plain.session.q.tobytes() == bent.session.q.tobytes()
    assert np.abs(errors_of(bent)).max() > 1e-4
    none = simulated_with(dict.fromkeys(sizes, 0.0))
    assert none.session.find(Detections).uv.tobytes() == plain.session.find(Detections).uv.tobytes()


@pytest.mark.no_cover
@pytest.mark.parametrize("rig", ["ur5", "stanford"])
def test_realistic_ones_are_drawn_for_each_kind_on_its_own(rig: str) -> None:
    kinds = get_args(JointError)
    together = simulated_with(dict.fromkeys(kinds, "default"), rig, poses=6)
    assert [len(p) > 0 for p in together.truth.joint_errors.values()] == [True] * len(kinds)
    for name in kinds:
        alone = simulated_with({name: "default"}, rig, poses=6)
        ((model, p),) = alone.truth.joint_errors.items()
        np.testing.assert_array_equal(p, together.truth.joint_errors[model])
        assert not np.array_equal(p, simulated_with({name: "default"}, rig, 6, 1).truth.joint_errors[model])
        size = np.abs(p) * (2.0 if name.endswith("backlash") else 1.0)
        if name == "eccentricity":
            first = np.hypot(*p.reshape(-1, 4)[:, :2].T)
            assert np.all((first >= 1e-4) & (first <= 1e-3))
            assert len(first) == sum(not joint.prismatic for joint in alone.session.chain.joints)
        else:
            sliding = np.array([joint.prismatic for joint in alone.session.chain.joints])
            sliding = np.repeat(sliding & (name != "bending"), len(size) // len(sliding))
            least, most = RANGES[name]
            assert np.all((size[~sliding] >= least) & (size[~sliding] <= most))
            factor = {"compliance": 0.02, "backlash": 0.1, "gravity_backlash": 0.1}.get(name, 1.0)
            assert np.all((size[sliding] >= factor * least) & (size[sliding] <= factor * most))


@pytest.mark.parametrize(
    ("rig", "errors", "message"),
    [
        ("stanford", {"eccentricity": {"joint_3": 1e-3}}, "errors.eccentricity: joint 'joint_3' slides.*Leave it out"),
        ("ur5", {"lag": {"elbow": 1e-3}}, "errors.lag.*'elbow'.*'elbow_joint'"),
        ("ur5", {"laag": 1e-3}, "errors.*'laag'.*'lag'"),
    ],
)
def test_errors_that_an_arm_cannot_have_are_refused(rig: str, errors: dict[str, Any], message: str) -> None:
    with pytest.raises(SessionError) as caught:
        simulated_with(errors, rig, poses=3)
    assert re.search(message, str(caught.value)), caught.value


def test_an_arm_that_touches_places_has_true_joints() -> None:
    rig = next(rig for name in shipped_rigs() if (rig := read_rig(find_rig(name))).places)
    with pytest.raises(SessionError, match=r"errors: joint errors are simulated before cameras alone"):
        replace(rig, errors={"lag": 1e-3})


def test_without_masses_nothing_bends() -> None:
    rig = read_rig(find_rig("elbow3r"))
    weightless = re.sub(rb"<inertial>.*?</inertial>", b"", rig.urdf.data, flags=re.DOTALL)
    rig = replace(rig, urdf=replace(rig.urdf, data=weightless), errors={"compliance": "default"})
    with pytest.raises(SessionError, match=r"errors\.compliance: the URDF has no masses.*<inertial>"):
        simulate(rig, poses=3, seed=0)


def test_a_moving_arm_bends_on_its_way() -> None:
    still = simulated_with({"compliance": 5e-5, "gain": 1e-3})
    moving = set_in_motion(still, MotionSettings())
    log, reading = moving.session.motion.log, moving.truth.q - 1e-3 * moving.truth.q
    at = moving.session.motion.robot_time(moving.truth.time_offsets)
    off = np.abs(moving.truth.q - log.at(at)).max(axis=0)
    assert off[1] > 1e-3  # the shoulder lifts the arm
    assert np.abs(reading - log.at(at))[:, 5].max() < 2e-4  # the flange's joint turns little but itself
    with pytest.raises(SessionError, match=r"errors\.lag: .*arms that stand still.*not a trajectory"):
        set_in_motion(simulated_with({"lag": 1e-3}), MotionSettings())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return shutil.copytree(find_rig("ur5"), tmp_path / "rig")


@pytest.mark.no_cover
def test_calibration_finds_what_the_rig_says(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with (folder / "rig.yaml").open("a") as file:
        file.write("payload: {link: tool0, mass: 3, center: [0, 0, 0.1]}\nerrors: {compliance: default, lag: 4e-4}\n")
    assert run(["simulate", str(folder), "-o", str(tmp_path / "s"), "--poses", "50", "--seed", "2"]) == 0
    truth = {of["parameter"]: of for of in json.loads((tmp_path / "s" / "truth.json").read_text())["joint_errors"]}
    assert truth["elbow_joint.lag"] == {"parameter": "elbow_joint.lag", "unit": "1", "value": -4e-4}
    said = yaml.safe_load((tmp_path / "s" / "session.yaml").read_text())
    assert "errors" not in said
    assert said["payload"]["mass"] == 3.0
    session = replace(
        read_session(tmp_path / "s"), estimate=Estimate("dh", "fixed"), joint_models={"compliance": True, "lag": True}
    )
    fit = calibrate(session, force=True).fit
    spread, far = np.sqrt(np.diag(fit.covariance)), []
    for model in (block for block in fit.parameters.blocks if block.key != ARM and set(block.names) <= set(truth)):
        where, active = fit.parameters.active_columns(model.key)
        true = np.array([truth[name]["value"] for name in model.names])
        far += (np.abs(fit.state[model.key] - true)[active] / spread[where]).tolist()
    assert len(far) > 8  # nothing tells how the joint along gravity yields
    assert np.max(far) < 3.5
    assert np.mean(far) < 1.5


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        ("{laag: 1e-3}", "rig.yaml:13:10, key 'errors.laag': 'laag' is not 'compliance'"),
        (
            "{lag: much}",
            "rig.yaml:13:10, key 'errors.lag': 'much' stands where default, a number, or a number for each",
        ),
        ("{lag: {elbow_joint: on}}", "key 'errors.lag': .* stands where default, a number, or a number for each"),
        ("{lag: .nan}", "key 'errors.lag': nan stands where"),
        ("{lag: {elbow: 1e-3}}", "rig.yaml:13:10, key 'errors.lag': .*'elbow_joint'"),
    ],
)
def test_sizes_that_are_none_are_refused_with_their_place(folder: Path, errors: str, message: str) -> None:
    with (folder / "rig.yaml").open("a") as file:
        file.write(f"errors: {errors}\n")
    with pytest.raises(SessionError) as caught:
        read_rig(folder)
    assert re.search(message, str(caught.value)), caught.value
