"""The table of identifiable numbers: r + 3 for one LED, r + 9 for three, r = 4 R + 2 P (base, LEDs unknown)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.states import state_of
from urdfcal.arrays import frozen
from urdfcal.cameras.camera import Camera
from urdfcal.cameras.rig import Rig
from urdfcal.estimation.identifiability import Identifiability, identify
from urdfcal.estimation.measurements import Detections
from urdfcal.estimation.model_spec import ModelSpec
from urdfcal.estimation.parameters import choose_parameters
from urdfcal.estimation.problem import Problem
from urdfcal.robot.chain import Chain
from urdfcal.robot.dh import DHTable, row_transform
from urdfcal.robot.mechanism import Joint, Tip
from urdfcal.session.knowledge import Led
from urdfcal.session.model import Session

H = np.pi / 2
# (type, theta, d, a, alpha), from the makers' data sheets.
ARMS: dict[str, list[tuple[str, float, float, float, float]]] = {
    "elbow3r": [("R", 0, 0.35, 0, H), ("R", 0, 0, 0.4, 0), ("R", 0, 0, 0.35, 0)],
    "ur5": [
        ("R", 0, 0.089159, 0, H), ("R", 0, 0, -0.425, 0), ("R", 0, 0, -0.39225, 0),
        ("R", 0, 0.10915, 0, H), ("R", 0, 0.09465, 0, -H), ("R", 0, 0.0823, 0, 0),
    ],
    "panda": [
        ("R", 0, 0.333, 0, -H), ("R", 0, 0, 0, H), ("R", 0, 0.316, 0.0825, H), ("R", 0, 0, -0.0825, -H),
        ("R", 0, 0.384, 0, H), ("R", 0, 0, 0.088, H), ("R", 0, 0.107, 0, 0),
    ],
    "iiwa14": [
        ("R", 0, 0.36, 0, -H), ("R", 0, 0, 0, H), ("R", 0, 0.42, 0, H), ("R", 0, 0, 0, -H),
        ("R", 0, 0.4, 0, -H), ("R", 0, 0, 0, H), ("R", 0, 0.126, 0, 0),
    ],
    "scara": [("R", 0, 0.4, 0.3, 0), ("R", 0, 0, 0.25, np.pi), ("P", 0, 0.1, 0, 0), ("R", 0, 0.05, 0, 0)],
    "stanford": [
        ("R", 0, 0.412, 0, -H), ("R", 0, 0.154, 0, H), ("P", -H, 0, 0.0203, 0),
        ("R", 0, 0, 0, -H), ("R", 0, 0, 0, H), ("R", 0, 0.1, 0, 0),
    ],
    "puma560": [
        ("R", 0, 0.6718, 0, H), ("R", 0, 0, 0.4318, 0), ("R", 0, 0.15005, 0.0203, -H),
        ("R", 0, 0.4318, 0, H), ("R", 0, 0, 0, -H), ("R", 0, 0.06, 0, 0),
    ],
    "irb120": [
        ("R", 0, 0.29, 0, -H), ("R", -H, 0, 0.27, 0), ("R", 0, 0, 0.07, -H),
        ("R", 0, 0.302, 0, H), ("R", 0, 0, 0, -H), ("R", np.pi, 0.072, 0, 0),
    ],
}  # fmt: skip
#              1 LED, no beta, on last axis, 3 LEDs, 1 camera
RANKS = {
    "elbow3r": (15, 14, 15, 21, 14),
    "ur5": (27, 25, 25, 33, 26),
    "panda": (31, 31, 29, 37, 30),
    "iiwa14": (31, 31, 29, 37, 30),
    "scara": (17, 14, 15, 23, 17),
    "stanford": (25, 24, 23, 31, 25),
    "puma560": (27, 26, 25, 33, 26),
    "irb120": (27, 26, 25, 33, 26),
}


def chain_of(name: str) -> Chain:
    rows = ARMS[name]
    joints = tuple(
        Joint(f"j{i + 1}", "prismatic" if kind == "P" else "revolute", frozen([0.0, 0.0, 1.0]), -2.0, 2.0)
        if kind == "R"
        else Joint(f"j{i + 1}", "prismatic", frozen([0.0, 0.0, 1.0]), 0.1, 0.4)
        for i, (kind, *_) in enumerate(rows)
    )
    B = [row_transform([*row[1:], 0.0]) for row in rows]
    last = len(joints) - 1
    placements = np.array([np.eye(4), *B[:-1]])
    return Chain(name, "base", joints, tuple(range(-1, last)), placements, (Tip("tip", last, B[-1]),))


class WithoutBeta(DHTable):
    """The rows as textbooks have them: theta, d, a and alpha everywhere."""

    @property
    def parameters(self):
        last = len(self.rows) - 1
        return tuple(
            (i, p)
            for i, row in enumerate(self.rows)
            for p in ("theta", "d", "a", "alpha")
            if (i < last and not (row.directed and p in ("d", "a"))) or p == row.variable
        )


def identified(arm: str, leds: np.ndarray, cameras: int = 2, table_type: type[DHTable] = DHTable) -> Identifiability:
    chain = chain_of(arm)
    lens = Camera("c", (4000, 4000), np.array([2000.0, 2000.0, 2000.0, 2000.0]))
    beside = np.eye(4)
    beside[0, 3] = -0.5
    T_world_base = np.eye(4)
    T_world_base[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    T_world_base[:3, 3] = [0.1, 0.3, 4.0]
    pose, camera, led = (a.ravel() for a in np.meshgrid(np.arange(60), np.arange(cameras), np.arange(len(leds))))
    session = Session(
        chain=chain,
        poses=tuple(map(str, range(60))),
        q=chain.random_values(60, np.random.default_rng(0)),
        leds=tuple(Led(f"led{i}") for i in range(len(leds))),
        rig=Rig(tuple(replace(lens, name=f"cam{c}") for c in range(cameras)), (np.eye(4), beside)[:cameras]),
        measurements=(Detections(pose, camera, led, np.zeros((len(pose), 2)), np.ones(len(pose))),),
    )
    problem = Problem.of(session, table_type.from_chain(chain))
    T_cam_world = np.array([np.eye(4), beside])[:cameras]
    state = state_of(session, np.zeros((len(chain.joints), 5)), T_world_base, leds, T_cam_world)
    (observed,) = problem.observations
    assert np.isfinite(problem.predict(observed, state)).all()
    fixed = ("fixed",) * cameras
    return identify(problem, state, choose_parameters(session, problem, state, ModelSpec("dh", fixed, fixed)))


ONE = np.array([[0.04, 0.03, 0.05]])
THREE = np.array([[0.04, 0.03, 0.05], [-0.05, 0.02, 0.03], [0.01, -0.06, 0.04]])
ON_AXIS = np.array([[0.0, 0.0, 0.05]])


@pytest.mark.parametrize("arm", ARMS)
def test_one_led_and_two_cameras(arm: str) -> None:
    assert identified(arm, ONE).rank == RANKS[arm][0]


@pytest.mark.parametrize("arm", ARMS)
def test_without_hayatis_beta_parallel_axes_lose_numbers(arm: str) -> None:
    assert identified(arm, ONE, table_type=WithoutBeta).rank == RANKS[arm][1]


@pytest.mark.parametrize("arm", ARMS)
def test_an_led_on_the_last_axis(arm: str) -> None:
    assert identified(arm, ON_AXIS).rank == RANKS[arm][2]


@pytest.mark.parametrize("arm", ARMS)
def test_three_leds(arm: str) -> None:
    assert identified(arm, THREE).rank == RANKS[arm][3]


@pytest.mark.parametrize("arm", ARMS)
def test_one_camera_loses_the_scale_of_a_revolute_arm(arm: str) -> None:
    found = identified(arm, ONE, cameras=1)
    assert found.rank == RANKS[arm][4]
    assert any("the scale" in text for text in found.unidentifiable) == (arm not in ("scara", "stanford"))


def test_unidentifiable_directions_are_named() -> None:
    without = identified("ur5", ONE, table_type=WithoutBeta).unidentifiable
    assert any("d of row 2 (j2)" in text and "d of row 3 (j3)" in text and "as a sum" in text for text in without)
    on_axis = identified("ur5", ON_AXIS).unidentifiable
    assert any(text.startswith("theta of row 6 (j6) moves nothing that is measured") for text in on_axis)
