from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from urdfcal.errors import RobotError
from urdfcal.estimation.evaluation import compare, compare_tips
from urdfcal.pipeline import calibrate
from urdfcal.result.calibration import Calibration
from urdfcal.result.changes import find_changes
from urdfcal.result.document import ResultDocument
from urdfcal.robot.tree_dh import rows_of
from urdfcal.session.knowledge import Estimate

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.fixture(scope="module")
def elbow3r(fitted: Callable) -> Calibration:
    return loaded(fitted("elbow3r").to_dict())


@pytest.fixture(scope="module")
def full(simulated: Callable) -> Calibration:
    session = replace(simulated("elbow3r").session, estimate=Estimate("full", "fixed", "fixed"))
    return loaded(calibrate(session).to_dict())


def loaded(data: dict[str, Any]) -> Calibration:
    document = ResultDocument.model_validate(data)
    return Calibration(document)


def data_of(calibration: Calibration) -> dict[str, Any]:
    return ResultDocument.model_validate(calibration.to_dict()).model_dump(exclude_unset=True)


def entry_of(data: dict[str, Any], joint: str, parameter: str) -> dict[str, Any]:
    return next(e for e in data["dh"] if (e["joint"], e["parameter"]) == (joint, parameter))


def changed(of: Calibration, joint: str, parameter: str, sigmas: float) -> Calibration:
    """The same with a parameter so many sigmas of the difference off, but its placements left."""
    data = data_of(of)
    entry = entry_of(data, joint, parameter)
    entry["offset"] += sigmas * np.sqrt(2.0) * entry["sigma"]
    return loaded(data)


def test_the_same_calibration_has_no_changes(elbow3r: Calibration) -> None:
    changes = find_changes(elbow3r, elbow3r)
    assert not changes.changed
    assert (changes.chi2, changes.alone, changes.significant, changes.joints) == (0.0, (), (), {})
    assert changes.tip.rms < 1e-12
    assert len(changes.parameters) == sum(e["status"] == "estimated" for e in elbow3r.to_dict()["dh"]) > 3
    assert changes.unseen == ("joint_1", "joint_3")  # the base's turn, and where the LED is on the last link


def test_the_chance_of_all_parameters_together_is_one_percent(elbow3r: Calibration) -> None:
    """Of six: 2.3 sigma is a chance of 0.021 each, 3.2 of 0.0014 and 0.008 for six, 3.1 of 0.0019 and 0.012."""
    count = len(find_changes(elbow3r, elbow3r).parameters)
    assert count == 6
    for sigmas, significant in ((2.3, False), (3.1, False), (3.2, True), (-3.2, True)):
        changes = find_changes(elbow3r, changed(elbow3r, "joint_2", "theta", sigmas))
        assert changes.chi2 == pytest.approx(sigmas**2)
        assert [(p.joint, p.parameter) for p in changes.significant] == [("joint_2", "theta")] * significant
        assert changes.changed == significant
        assert changes.apart is False


def test_a_change_is_in_units_of_both_sigmas(elbow3r: Calibration) -> None:
    data = data_of(elbow3r)
    entry = entry_of(data, "joint_2", "theta")
    before = entry["offset"], entry["sigma"]
    entry["offset"], entry["sigma"] = before[0] + 0.002, 3.0 * before[1]
    (one,) = (
        p for p in find_changes(elbow3r, loaded(data)).parameters if (p.joint, p.parameter) == ("joint_2", "theta")
    )
    assert one.change == pytest.approx(0.002)
    assert one.sigma == pytest.approx(np.sqrt(10.0) * before[1])
    assert one.sigmas == pytest.approx(0.002 / one.sigma)
    assert str(one) == f"joint_2.theta by 2 mrad ({one.sigmas:.0f} sigma)"


def test_the_joint_that_moves_the_tip_most_comes_first(elbow3r: Calibration) -> None:
    far = changed(changed(elbow3r, "joint_2", "theta", 8.0), "joint_1", "a", 40.0)
    changes = find_changes(elbow3r, far)
    assert [p.joint for p in changes.significant] == ["joint_1", "joint_2"]
    assert list(changes.joints.values()) == sorted(changes.joints.values(), reverse=True)
    for p in changes.significant:
        table, offsets = rows_of(elbow3r.chain), np.array(elbow3r.dh_offsets)
        offsets[table.labels.index(p.joint), table.columns.index(p.parameter)] = p.offsets[1]
        other = elbow3r.chain.with_placements(table.placements(offsets))
        q = elbow3r.chain.random_values(1000, np.random.default_rng(0))
        rms = np.sqrt(np.mean(compare(elbow3r.calibrated, other, q).position ** 2))
        assert changes.joints[p.joint] == pytest.approx(rms)


def with_placements_moved(of: Calibration, metres: float) -> Calibration:
    """The tip moves, but no parameter beyond its sigma."""
    data = data_of(of)
    names = list(data["robot"]["joints"])
    data["robot"]["joints"][names[1]]["calibrated"][0][3] += metres
    return loaded(data)


def test_tips_farther_apart_than_both_errors_are_a_change(elbow3r: Calibration) -> None:
    tip = elbow3r.document.tip
    changes = find_changes(elbow3r, with_placements_moved(elbow3r, 0.01))
    # The chance of one percent is beyond where the intervals of 95 % end.
    assert 1.1e-3 * np.sqrt(2.0) * tip.interval_mm[1] < changes.expected < 1.5e-3 * np.sqrt(2.0) * tip.interval_mm[1]
    assert (changes.significant, changes.apart, changes.changed) == ((), True, True)
    size = 0.01 * changes.expected / changes.tip.rms
    for factor, apart in ((0.98, False), (1.02, True)):
        assert find_changes(elbow3r, with_placements_moved(elbow3r, factor * size)).apart is apart


def test_files_that_claim_no_error_of_the_tip_are_compared_by_parameters_alone(elbow3r: Calibration) -> None:
    data = data_of(with_placements_moved(elbow3r, 0.01))
    del data["tip"]
    changes = find_changes(elbow3r, loaded(data))
    assert (changes.expected, changes.apart, changes.changed) == (None, False, False)


def test_parameters_of_one_alone_are_not_compared(elbow3r: Calibration) -> None:
    data = data_of(elbow3r)
    entry = entry_of(data, "joint_2", "theta")
    del entry["sigma"]
    entry |= {"status": "fixed", "reason": "not asked for", "offset": entry["offset"] + 1.0}
    other = loaded(data)
    for a, b in ((elbow3r, other), (other, elbow3r)):
        changes = find_changes(a, b)
        assert changes.alone == ("joint_2.theta",)
        assert len(changes.parameters) == 5
        assert changes.unseen == ("joint_1", "joint_2", "joint_3")
        assert not changes.changed


def test_whole_placements_are_compared_by_their_own_parameters(full: Calibration, elbow3r: Calibration) -> None:
    changes = find_changes(full, changed(full, "joint_2", "x", 9.0))
    assert [(p.joint, p.parameter, p.unit) for p in changes.significant] == [("joint_2", "x", "m")]
    assert changes.joints["joint_2"] > 0.0
    assert changes.unseen == ()
    # With rows they have no parameter in common, but a tip.
    mixed = find_changes(full, elbow3r)
    assert (mixed.parameters, mixed.changed) == ((), False)
    assert mixed.expected is not None


def test_nothing_in_common_is_refused(full: Calibration, elbow3r: Calibration) -> None:
    data = data_of(elbow3r)
    del data["tip"]
    with pytest.raises(RobotError, match="no parameter of the arm was estimated in both"):
        find_changes(full, loaded(data))


def fixed_arm(of: Calibration) -> Calibration:
    data = data_of(of)
    for entry in data["dh"]:
        entry.pop("sigma", None)
        entry |= {"status": "fixed", "reason": "not asked for"}
    return loaded(data)


def test_the_error_claimed_of_an_arm_that_was_not_estimated_is_none(elbow3r: Calibration) -> None:
    with pytest.raises(RobotError, match="no parameter of the arm was estimated in both"):
        find_changes(elbow3r, fixed_arm(elbow3r))


def renamed_joint(data: dict[str, Any]) -> None:
    robot = data["robot"]
    robot["joints"] = {name.replace("joint_3", "wrist"): joint for name, joint in robot["joints"].items()}
    robot["tips"]["tool0"]["joint"] = "wrist"
    for entry in data["dh"]:
        entry["joint"] = entry["joint"].replace("joint_3", "wrist")


def moved_nominal(data: dict[str, Any]) -> None:
    data["robot"]["joints"]["joint_2"]["nominal"][0][3] += 1e-4


def other_base(data: dict[str, Any]) -> None:
    data["robot"]["base_link"] = "foot"


def other_tip(data: dict[str, Any]) -> None:
    data["robot"]["tip_link"] = "flange"
    data["robot"]["tips"] = {"flange": data["robot"]["tips"]["tool0"]}


def other_axis(data: dict[str, Any]) -> None:
    axis = data["robot"]["joints"]["joint_2"]["axis"]
    data["robot"]["joints"]["joint_2"]["axis"] = [-component for component in axis]


def second_tip(data: dict[str, Any]) -> None:
    data["robot"]["tips"]["camera"] = {**data["robot"]["tips"]["tool0"], "joint": "joint_2"}


def other_parent(data: dict[str, Any]) -> None:
    second_tip(data)
    data["robot"]["joints"]["joint_3"]["parent"] = "joint_1"


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (renamed_joint, "they have different joints: only the first has joint_3; only the second has wrist"),
        (moved_nominal, "the nominal placement of joint 'joint_2' differs"),
        (other_base, "the base_link is 'base_link' in the first, 'foot' in the second"),
        (other_tip, "the tip_link is 'tool0' in the first, 'flange' in the second"),
        (second_tip, "the first ends in tool0, the second in tool0, camera"),
        (other_parent, "the same joints hang on each other in another order"),
        (other_axis, "joint 'joint_2' has another type, axis or mimic"),
    ],
)
def test_what_differs_between_robots_is_said(edit: Callable, told: str, elbow3r: Calibration) -> None:
    data = data_of(elbow3r)
    edit(data)
    with pytest.raises(RobotError) as refused:
        find_changes(elbow3r, loaded(data))
    assert refused.value.what == told
    assert "from the same nominal URDF" in refused.value.remedy


def test_a_link_on_the_base_is_no_tip_that_moves(elbow3r: Calibration) -> None:
    data = data_of(elbow3r)
    data["robot"]["tips"]["board"] = {**data["robot"]["tips"]["tool0"], "joint": None}
    assert list(find_changes(loaded(data), loaded(data)).tips) == ["tool0"]


@pytest.mark.no_cover
def test_each_tip_of_a_tree_is_compared(fitted: Callable) -> None:
    one = loaded(fitted("tiago_dual", poses=40).to_dict())
    changes = find_changes(one, one)
    assert next(iter(changes.tips)) == one.chain.tip_link
    assert len(changes.tips) == len([tip for tip in one.chain.tips if tip.joint >= 0]) > 1
    # A joint that carries a later tip alone moves that one.
    first = set(one.chain.path(one.chain.tips[0].joint))
    (joint, name) = next(
        (p.joint, p.parameter)
        for p in changes.parameters
        if p.joint in one.chain.names and one.chain.names.index(p.joint) not in first and p.parameter == "theta"
    )
    moved = find_changes(one, changed(one, joint, name, 20.0))
    assert list(moved.joints) == [joint]
    assert moved.joints[joint] > 1e-7  # of the first tip it would be rounding


LOAD = {"gravity": [0.0, 0.0, -9.81]}
MASSES = {f"joint_{k}": {"mass": 1.0, "center": [0.1, 0.0, 0.0]} for k in (1, 2, 3)}


def bending(
    of: Calibration,
    models: dict[str, Any],
    sought: dict[str, tuple[float, float]] | None = None,
    load: dict[str, Any] | None = None,
) -> Calibration:
    """The same with joint models, as {joint: {model: (values, inputs)}}, and what was sought and not chosen."""
    data = data_of(of)
    data["joint_models"] = {
        joint: {
            name: {"values": values, "sigma": [1e-4] * len(values), "gain_mm": None, "inputs": inputs}
            for name, (values, inputs) in each.items()
        }
        for joint, each in models.items()
    }
    if models:
        data["load"] = load or LOAD
    losses = {"included": False, "log_evidence": -1.0, "inside_mm": 0.0, "elsewhere_mm": 0.0}
    candidates = {name: {"value": value, "sigma": sigma} for name, (value, sigma) in (sought or {}).items()}
    data["joint_model_trials"] = [{"model": "gain", "joints": ["joint_2"], **losses, "candidates": candidates}]
    return loaded(data)


def gain(value: float) -> dict[str, Any]:
    return {"joint_2": {"gain": ([value], {})}}


def test_a_joint_model_that_has_grown_is_a_change(elbow3r: Calibration) -> None:
    before, after = bending(elbow3r, gain(1e-3)), bending(elbow3r, gain(2e-3))
    changes = find_changes(before, after)
    (one,) = changes.significant
    assert (one.joint, one.parameter, one.unit, one.thousandth) == ("joint_2", "gain", "1", "1e-3")
    assert one.change == pytest.approx(1e-3)
    assert one.sigmas == pytest.approx(10.0 / np.sqrt(2.0))
    assert str(one) == "joint_2.gain by 0.001 (7 sigma)"
    # The tips are those with all joint models, and what moves them is the joint's.
    q = elbow3r.chain.readings(elbow3r.chain.random_values(1000, np.random.default_rng(0)))
    apart = compare_tips(before.forward(q), after.forward(q)).position
    assert changes.tip.rms == pytest.approx(np.sqrt(np.mean(apart**2)))
    assert changes.joints == {"joint_2": pytest.approx(changes.tip.rms)}
    assert changes.tip.rms > 1e-5


def test_a_joint_model_that_is_the_same_moves_nothing_and_a_lag_no_tip_at_rest(elbow3r: Calibration) -> None:
    def both(lag: float, gain: float) -> dict[str, Any]:
        return {"joint_2": {"lag": ([lag], {}), "gain": ([gain], {})}}

    changes = find_changes(bending(elbow3r, both(1e-3, 1e-3)), bending(elbow3r, both(2e-3, 1.1e-3)))
    assert [p.parameter for p in changes.significant] == ["lag"]
    assert changes.joints == {"joint_2": pytest.approx(0.0, abs=1e-12)}
    assert changes.tip.rms > 1e-6


@pytest.mark.parametrize("found_first", [True, False])
@pytest.mark.parametrize(("sigma", "changed"), [(1e-4, True), (1e-3, False)])
def test_what_one_has_looked_for_in_vain_is_compared_with_what_it_would_be_there(
    elbow3r: Calibration, found_first: bool, sigma: float, changed: bool
) -> None:
    rigid, bent = bending(elbow3r, {}, {"joint_2.gain": (2e-4, sigma)}), bending(elbow3r, gain(1e-3))
    changes = find_changes(bent, rigid) if found_first else find_changes(rigid, bent)
    (one,) = [p for p in changes.parameters if p.parameter == "gain"]
    assert one.offsets == ((1e-3, 2e-4) if found_first else (2e-4, 1e-3))
    assert one.sigma == pytest.approx(np.hypot(sigma, 1e-4))
    assert one.significant == changed
    assert changes.unfound == ("joint_2.gain",)
    assert changes.alone == ()
    assert changes.tip.rms > 1e-5
    if changed:
        assert changes.joints == {"joint_2": pytest.approx(changes.tip.rms)}


def test_what_one_has_not_looked_for_is_not_compared(elbow3r: Calibration) -> None:
    changes = find_changes(bending(elbow3r, {}, {"joint_3.gain": (0.0, 1e-4)}), bending(elbow3r, gain(1e-3)))
    assert (changes.significant, changes.unfound, changes.alone) == ((), (), ("joint_2.gain",))


def test_masses_are_those_of_whom_they_are_known_of(elbow3r: Calibration) -> None:
    sag = {"joint_2": {"compliance": ([1e-3], {}), "gain": ([1e-3], {})}}
    first, second = bending(elbow3r, gain(1e-3)), bending(elbow3r, sag, load={**LOAD, "masses": MASSES})
    first = bending(loaded(data_of(first)), gain(1e-3), {"joint_2.compliance": (0.0, 1e-5)})
    data = data_of(first)
    data["joint_model_trials"][0]["model"] = "compliance"
    changes = find_changes(loaded(data), second)
    assert [p.parameter for p in changes.significant] == ["compliance"]
    assert changes.joints["joint_2"] == pytest.approx(changes.tip.rms)


def test_motors_of_other_gear_ratios_are_not_compared(elbow3r: Calibration) -> None:
    def geared(ratio: float, value: float) -> dict[str, Any]:
        return {"joint_2": {"motor_harmonics": ([value, 0.0, 0.0, 0.0], {"gear_ratio": ratio})}}

    same = find_changes(bending(elbow3r, geared(50.0, 1e-3)), bending(elbow3r, geared(50.0, 2e-3)))
    assert [p.joint for p in same.significant] == ["joint_2"]
    other = find_changes(bending(elbow3r, geared(50.0, 1e-3)), bending(elbow3r, geared(60.0, 2e-3)))
    assert (other.significant, len(other.alone)) == ((), 4)


def test_arms_are_compared_under_one_load(elbow3r: Calibration) -> None:
    models = {"joint_2": {"compliance": ([1e-4], {})}}
    carried = {"link": "base_link", "mass": 5.0, "center": [0.0, 0.0, 0.0], "joint": "joint_3"}
    carried |= {"T_joint_link": np.eye(4).tolist()}
    light = {**LOAD, "masses": MASSES}
    tilted = {**light, "gravity": [0.0, 9.81, 0.0]}
    heavy = {**light, "payload": carried}
    plain = bending(elbow3r, models, load=light)
    for load, unloaded in ((light, False), (tilted, False), (heavy, True)):
        other = bending(elbow3r, models, load=load)
        changes = find_changes(plain, other)
        assert (changes.unloaded, changes.rigid, changes.changed) == (unloaded, False, False)
        assert changes.tip.rms == pytest.approx(0.0, abs=1e-12)
    both = find_changes(bending(elbow3r, models, load=heavy), bending(elbow3r, models, load=heavy))
    assert both.unloaded is False


def test_arms_that_give_way_to_measured_torques_are_compared_by_their_rigid_parts(elbow3r: Calibration) -> None:
    a, b = (bending(elbow3r, {"joint_2": {"compliance": ([value], {})}}) for value in (1e-4, 3e-3))
    changes = find_changes(a, b)
    assert changes.rigid
    assert changes.tip.rms == pytest.approx(0.0, abs=1e-12)
    assert [p.parameter for p in changes.significant] == ["compliance"]  # is still compared
    assert changes.joints == {"joint_2": pytest.approx(0.0, abs=1e-12)}
