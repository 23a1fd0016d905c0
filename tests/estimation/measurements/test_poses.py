"""A tracker's 6-D probe: the arm it gives, its two kinds of noise, and what it takes to be read."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
import pytest
import yaml

from tests.worlds import RIGID
from urdfcal.arrays import inverse
from urdfcal.cli import run
from urdfcal.errors import CalibrationError, SessionError
from urdfcal.estimation.assessment import assess
from urdfcal.estimation.blocks.arm import no_offsets
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.blocks.targets import target_key
from urdfcal.estimation.diagnosis.doctor import Finding
from urdfcal.estimation.evaluation import compare, explain
from urdfcal.estimation.joint_models import JOINT_MODELS
from urdfcal.estimation.measurements import Points, Poses
from urdfcal.estimation.measurements.poses import _inverse_left_jacobian
from urdfcal.estimation.noise import find_noise
from urdfcal.estimation.start import first_state
from urdfcal.io.folder import read_rig, read_session
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.io.tables import read_measurements
from urdfcal.io.writing import write_session
from urdfcal.pipeline import calibrate
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.tree_dh import rows_of
from urdfcal.rotations import matrix_to_quaternion
from urdfcal.session.knowledge import Estimate, Led, Noise
from urdfcal.session.model import Session
from urdfcal.session.pattern import FramePattern
from urdfcal.session.target import Target
from urdfcal.simulation.simulate import draw_offsets

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.arrays import Floats
    from urdfcal.session.rig_description import RigDescription

T_WORLD_BASE = pin.exp6(np.array([2.0, -0.5, 0.3, 0.2, -0.4, 1.5])).homogeneous
T_LINK_TARGET = pin.exp6(np.array([0.05, 0.02, 0.11, 0.4, -1.2, 0.3])).homogeneous


@cache
def rig() -> RigDescription:
    return read_rig(find_rig("ur5"))


def probed(
    count: int = 60, *, offsets: Floats | None = None, sigma: float = 1e-4, sigma_rad: float = 3e-4, still: bool = False
) -> Session:
    """Poses of a probe on the last link of an arm; ``still``, the probe hardly turns."""
    chain, rng = rig().chain, np.random.default_rng(4)
    q = chain.random_values(count, rng)
    if still:
        q = q[0] + 0.2 * (q - q[0]) / np.abs(q - q[0]).max()
        q[:, 3:] = q[0, 3:]
        q[:, 0] = q[0, 0]
        q[:, 3] -= q[:, 1] + q[:, 2] - q[0, 1] - q[0, 2]
    arm = chain.with_placements(rows_of(chain).placements(no_offsets(rows_of(chain)) if offsets is None else offsets))
    T = T_WORLD_BASE @ tip_poses(arm, q) @ T_LINK_TARGET
    T[:, :3, :3] = T[:, :3, :3] @ np.array([pin.exp3(sigma_rad * rng.normal(size=3)) for _ in q])
    places = np.hstack([T[:, :3, 3] + sigma * rng.normal(size=(count, 3)), matrix_to_quaternion(T[:, :3, :3])])
    noise = {"pose": sigma or 1e-6, "pose_rad": sigma_rad or 1e-6}
    table = Poses(
        np.arange(count), np.zeros(count, int), places, np.array(noise["pose"]), np.array(noise["pose_rad"])
    )  # fmt: skip
    setup = rig().of_setup(
        leds=(),
        targets=(Target("probe", FramePattern(), chain.tip_link),),
        rig=type(rig().rig)(),
        mounts=(),
        noise=Noise(joint=0.0, other=noise),
        sha256={},
        folder=None,
    )
    return Session(**setup, poses=tuple(map(str, range(count))), q=q, measurements=(table,))


def offsets() -> Floats:
    return draw_offsets(rows_of(rig().chain), np.random.default_rng(1))


def test_the_arm_comes_out() -> None:
    true = offsets()
    session = replace(probed(offsets=true), estimate=Estimate("dh"))
    calibration = calibrate(session)
    assert calibration.assessment.level == "good", calibration.assessment.reasons
    assert calibration.fit.reduced_chi2 == pytest.approx(1.0, abs=0.25)
    chain = session.chain
    truth = chain.with_placements(rows_of(chain).placements(true))
    found = chain.with_placements(calibration.placements)
    q = chain.random_values(300, np.random.default_rng(0))
    before, after = (np.sqrt(np.mean(compare(truth, arm, q).position ** 2)) for arm in (chain, found))
    assert after < 0.1e-3 < 1e-3 < before
    residuals = {of.unit: of.rms for of in calibration.document.fit.residuals}
    assert residuals["mm"] == pytest.approx(np.sqrt(3.0) * 0.1, rel=0.15)
    assert residuals["mrad"] == pytest.approx(np.sqrt(3.0) * 0.3, rel=0.15)
    # What is held out is a distance: turns do not count in it.
    assert calibration.document.validation.rms_mm == pytest.approx(np.sqrt(3.0) * 0.1, rel=0.4)


def test_the_noise_of_places_and_of_turns_is_found_apart() -> None:
    session = replace(probed(offsets=offsets()), estimate=Estimate("dh"))
    wrong = session.with_noise({"pose": 2e-4, "pose_rad": 1e-4})
    calibration = calibrate(wrong, force=True)
    found = {of.name: of for of in find_noise(calibration.problem, calibration.fit)}
    assert found["pose"].found == pytest.approx(1e-4, rel=0.25)
    assert found["pose_rad"].found == pytest.approx(3e-4, rel=0.25)
    assert found["pose_rad"].unit == "rad"
    usual = {of.noise: of.usual for of in Poses.spreads.values()}
    silent = replace(wrong.with_noise(usual), noise=Noise())
    assert silent.undeclared_noise == {"pose", "pose_rad", "joint"}


MISTAKES = {
    "the quaternions of poses.csv are in the order qw, qx, qy, qz": lambda T, p: p[:, [0, 1, 2, 6, 3, 4, 5]],
    "the orientations of poses.csv are those of the world in the target": lambda T, p: p * [1, 1, 1, -1, -1, -1, 1],
    "the poses of poses.csv are those of the world in the target (of hand-eye samples: the other --eye)": (
        lambda T, p: np.hstack([inverse(T)[:, :3, 3], matrix_to_quaternion(inverse(T)[:, :3, :3])])
    ),
}


@pytest.mark.no_cover
@pytest.mark.parametrize("what", MISTAKES)
def test_poses_that_are_written_otherwise_are_named(what: str) -> None:
    session = probed(20, offsets=offsets())
    (table,) = session.measurements
    T = np.tile(np.eye(4), (len(table), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = table.rotations, table.place[:, :3]
    wrong = replace(session, measurements=(replace(table, place=MISTAKES[what](T, table.place)),), noise=Noise())
    with pytest.raises(CalibrationError, match=re.escape(f"{what}: with that mended the nominal arm is")):
        calibrate(replace(wrong, estimate=Estimate("dh"), joint_models=RIGID))


@pytest.mark.no_cover
@pytest.mark.usefixtures("no_trials")
def test_of_residuals_that_are_no_noise_no_effect_is_named() -> None:
    session = probed(20, offsets=offsets())
    (table,) = session.measurements
    rolled = replace(table, place=table.place[:, [0, 1, 2, 6, 3, 4, 5]], sigma=np.full(20, 1e-4))
    usual = {of.noise: of.usual for of in Poses.spreads.values()}
    silent = replace(replace(session, measurements=(rolled,)).with_noise(usual), noise=Noise(), joint_models=RIGID)
    calibration = calibrate(replace(silent, estimate=Estimate("none")), force=True)
    found = replace(calibration.evidence, findings=(Finding("lens", "the lens errs", 0.5, 1e-9, None, ()),))
    assessment = assess(calibration.session, calibration.problem, calibration.comparison, found)
    assert assessment.failures[0].startswith("nothing measures as badly as the residuals are")
    assert not [said for said in assessment.warnings if "the lens errs" in said]


def test_exact_poses_give_base_and_probe_at_once() -> None:
    session = probed(sigma=0.0, sigma_rad=0.0)
    table = rows_of(session.chain)
    start = first_state(session, table, no_offsets(table))
    np.testing.assert_allclose(start[BASE], T_WORLD_BASE, atol=1e-6)
    np.testing.assert_allclose(start[target_key("probe")], T_LINK_TARGET, atol=1e-6)


def test_a_probe_that_hardly_turns_is_started_too() -> None:
    # Closed-form hand-eye calibration refuses it; places alone tell where the base is.
    session = probed(sigma=1e-5, sigma_rad=1e-5, still=True)
    found = explain(session.chain, session)
    assert np.abs(found.residuals[0]).max() < 1e-3


def test_the_inverse_left_jacobian_is_that_of_the_logarithm() -> None:
    for w in (np.zeros(3), np.array([1e-7, 0.0, 0.0]), np.array([0.3, -1.0, 2.0])):
        J = _inverse_left_jacobian(w[None])[0]
        for k in range(3):
            step = 1e-6 * np.eye(3)[k]
            after, before = (pin.log3(pin.exp3(sign * step) @ pin.exp3(w)) for sign in (1, -1))
            np.testing.assert_allclose(J[:, k], (after - before) / 2e-6, atol=1e-7)


class TestTogether:
    def test_points_of_the_same_tracker_go_with_it(self) -> None:
        session = probed()
        (table,) = session.measurements
        points = Points(table.pose, 0 * table.pose, table.place[:, :3], np.array(1e-4))
        both = replace(session, leds=(Led("tip"),), measurements=(table, points))
        found = calibrate(replace(both, estimate=Estimate("none")), force=True)
        np.testing.assert_allclose(found.estimate.leds[0], T_LINK_TARGET[:3, 3], atol=2e-4)

    def test_pixels_do_not(self, simulated: Callable) -> None:
        session, poses = simulated("ur5").session, probed(30)
        both = replace(session, targets=poses.targets, measurements=(*session.measurements, *poses.measurements))
        with pytest.raises(SessionError, match="detections and poses are both named: the tracker's frame"):
            calibrate(both)


class TestFiles:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        write_session(tmp_path / "session", probed(20))
        return tmp_path / "session"

    def test_evaluate_tells_places_and_turns_apart(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        urdf = rig().urdf_reference
        assert run(["evaluate", urdf, str(folder), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["residual_mm"]["rms"] == pytest.approx(np.sqrt(3.0) * 0.1, rel=0.3)
        assert found["residual_mrad"]["rms"] == pytest.approx(np.sqrt(3.0) * 0.3, rel=0.3)

    def test_noise_is_a_pair(self, folder: Path) -> None:
        path = folder / "session.yaml"
        keys = yaml.safe_load(path.read_text())
        path.write_text(yaml.safe_dump(keys | {"noise": {"pose": [2e-4, 5e-4]}}))
        (table,) = read_session(folder).measurements
        assert set(table.sigma) == {2e-4}
        assert set(table.sigma_rad) == {5e-4}
        path.write_text(yaml.safe_dump(keys | {"noise": {"pose": [2e-4, -5e-4]}}))
        with pytest.raises(SessionError, match=r"session.yaml:\d+"):
            read_session(folder)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda text: text.replace("probe", "prod", 1), r"poses.csv:2:3: there is no target 'prod'.*probe"),
            (lambda text: text.replace("qw", "w", 1), r"poses.csv:1: unknown column 'w'"),
            (lambda text: re.sub(r"(?m)[^,\n]+$", "nan", text, count=2), r"poses.csv"),
            (
                lambda text: "\n".join(
                    line if k != 2 else ",".join([*line.split(",")[:-1], "3.0"])
                    for k, line in enumerate(text.splitlines())
                ),
                r"poses.csv:3:\d+: qx, qy, qz, qw have the length 3\.?\d*, not 1.*unit quaternion, qw last",
            ),
            (
                lambda text: re.sub(
                    r"(?m)^(\d+,probe),([^,]+),([^,]+),([^,]+)",
                    lambda found: ",".join([found[1], *(str(1e3 * float(found[k])) for k in (2, 3, 4))]),
                    text,
                ),
                r"poses.csv: the points spread over .* looks like millimetres",
            ),
        ],
    )  # fmt: skip
    def test_what_is_wrong_is_refused_with_its_place(
        self, folder: Path, change: Callable[[str], str], message: str
    ) -> None:
        path = folder / "poses.csv"
        text = path.read_text()
        path.write_text(change(text))
        with pytest.raises(SessionError) as caught:
            read_session(folder)
        assert re.search(message, str(caught.value))


@pytest.mark.no_cover
def test_a_measured_arm_is_as_good_by_poses_as_by_points(shared: Path) -> None:
    source = shared / "ur10_cubes"
    if not source.is_dir():
        pytest.skip(f"the measured data are not here: {source}")
    by_points = read_session(source)
    off = {model.name: False for model in JOINT_MODELS}
    by_points = replace(by_points, estimate=Estimate("dh"), joint_models=off)
    target = Target("probe", FramePattern(), by_points.chain.tip_link)
    known = {"pose": by_points.poses, "target": ("probe",)}
    table = read_measurements(source / "poses.csv", Poses, known, {"sigma": 1e-4, "sigma_rad": 2e-4}).measurements
    by_poses = replace(by_points, leds=(), targets=(target,), measurements=(table,), noise=Noise())
    some = np.arange(0, len(by_points.poses), 2)
    found = [calibrate(session.at(some), force=True).document for session in (by_points, by_poses)]
    assert found[1].validation.rms_mm < 1.02 * found[0].validation.rms_mm
    assert [of.unit for of in found[1].fit.residuals] == ["mm", "mrad"]
