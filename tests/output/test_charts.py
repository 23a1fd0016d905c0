from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.chart import Scale
from urdfcal.output.charts import (
    all_charts,
    by_pose,
    convergence_charts,
    frame_times,
    parameter_charts,
    residual_charts,
    spread,
)
from urdfcal.output.findings import Overview
from urdfcal.output.scene import measurements_of
from urdfcal.pipeline import calibrate
from urdfcal.simulation.simulate import simulate


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-3.2, 7.9), (1e-9, 2e-9), (-5000, -4999.5), (0, 213)])
def test_ticks_are_few_round_and_inside(low, high):
    ticks = np.array(list(Scale(low, high).ticks()))
    assert 2 <= len(ticks) <= 7
    assert ticks.min() >= low
    assert ticks.max() <= high
    steps = np.diff(ticks)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-6)
    mantissa = steps[0] / 10 ** np.floor(np.log10(steps[0]) + 1e-9)
    assert round(mantissa, 6) in {1, 2, 5}


@pytest.mark.parametrize(("low", "high"), [(0.02, 3), (1e-12, 1e12), (3, 40), (1.2, 6)])
def test_logarithmic_ticks(low, high):
    ticks = np.array(list(Scale(low, high, logarithmic=True).ticks()))
    assert 1 <= len(ticks) <= 9
    assert low <= ticks.min() <= ticks.max() <= high


def test_scales_hold_their_values_and_forgive_what_is_none():
    values = [0.5, np.nan, 20.0, np.inf, -1.0]
    for logarithmic in (False, True):
        share = Scale.holding(values, logarithmic=logarithmic).share(values)
        assert 0 < share[0] < share[2] < 1
    assert np.isnan(Scale.holding(values, logarithmic=True).share([-1.0, 0.0])).all()
    for none in ([], [np.nan], [3.0], [0.0]):
        scale = Scale.holding(none)
        assert scale.low < scale.high
        assert len(scale.ticks()) > 0


@pytest.fixture(scope="module")
def overview():
    return Overview.of(calibrate(simulate(read_rig(find_rig("stanford")), seed=2, poses=25).session))


def test_every_chart_has_a_name_of_its_own_and_marks_inside(overview):
    charts = all_charts(overview)
    assert len({chart.name for chart in charts}) == len(charts)
    for chart in charts:
        assert len({mark.name for mark in chart.marks}) == len(chart.marks), chart.name
        shares = [chart.y.share(mark.y) for mark in chart.marks]
        assert any(((share >= 0) & (share <= 1)).any() for share in shares), chart.name


def test_bars_are_the_corrections_with_their_deviations(overview):
    calibration = overview.calibration
    rows = np.argwhere(np.isfinite(calibration.sigmas())).tolist()
    for chart in parameter_charts(calibration):
        marks = {mark.name: mark for mark in chart.marks}
        lengths = chart.name == "lengths"
        index = [(i, k) for i, k in rows if (calibration.geometry.columns[k] in "da") == lengths]
        offsets = 1e3 * np.array([calibration.estimate.offsets[i] for i in index])
        sigmas = 1e3 * np.array([calibration.sigmas()[i] for i in index])
        np.testing.assert_allclose(marks["offsets"].x[:, 1], offsets)
        np.testing.assert_allclose(np.diff(marks["intervals"].x, axis=1)[:, 0], 2 * 1.96 * sigmas)


def test_thousands_of_frames_are_no_carpet(overview):
    table = overview.scene.tables[0]
    many = np.tile(np.arange(len(table.pose)), 200)
    columns = {name: value[many] for name, value in vars(table).items() if isinstance(value, np.ndarray)}
    frames = replace(table, **columns | {"pose": np.arange(len(many))})
    chart = by_pose(frames)
    assert all(len(mark.x) <= 251 for mark in chart.marks)
    assert chart.title == f"rms of {1 + (len(many) - 1) // 250} poses each [{table.unit}]"
    np.testing.assert_allclose(np.median(chart.marks[2].y), np.sqrt(np.mean(by_pose(table).marks[2].y ** 2)), rtol=0.3)
    assert by_pose(table).title == f"rms of each pose [{table.unit}]"


def test_frames_of_an_arm_that_moved_are_drawn_over_their_time_whatever_camera_took_them(overview):
    (table,) = overview.scene.tables
    # The second camera's frames come after the first one's.
    times = 100.0 + np.concatenate([np.arange(13.0), np.arange(12.0)])
    chart = by_pose(table, times)
    assert (chart.title, chart.x_label) == (f"rms of about 2 frames each [{table.unit}]", "time [s]")
    for mark in chart.marks[1:]:
        np.testing.assert_allclose(mark.x, 100.0 + np.arange(13.0), atol=0.05)
    both = np.isin(table.pose, [1, 14]) & table.used
    square = np.sum((table.predicted - table.measured)[both] ** 2, axis=1)
    assert chart.marks[2].y[1] == pytest.approx(np.sqrt(np.mean(square)))
    assert frame_times(overview.calibration) is None


def test_what_is_beyond_the_chart_is_said_of_each_arm_that_has_any(overview):
    (table,) = overview.scene.tables
    nominal, calibrated = (np.abs(table.sigmas(of)) for of in (table.nominal, table.predicted))
    assert not (calibrated > 6.0).any()
    assert spread(table).x_label == f"residual / noise ({100 * np.mean(nominal > 6.0):.0f} % of nominal beyond)"
    assert spread(replace(table, nominal=table.predicted)).x_label == "residual / noise"


def test_residuals_have_their_unit_and_what_they_are_drawn_over(overview):
    found = {chart.name: chart for chart in residual_charts(overview)}
    joint = overview.calibration.chain.joints[0]
    assert (found["joint 1"].title, found["joint 1"].x_label) == (
        f"{joint.name} [rad]",
        "",
    )
    assert found["distance"].title == "camera distance [m]"


def test_cost_falls_from_that_of_the_nominal_arm(overview):
    cost, damping, step, *of_joints = convergence_charts(overview.calibration)
    calibration = overview.calibration
    expected = [calibration.nominal_fit.cost, *(each.cost for each in calibration.fit.history)]
    for mark in cost.marks:
        np.testing.assert_array_equal(mark.x, np.arange(len(expected)))
        np.testing.assert_array_equal(mark.y, expected)
    assert cost.x == damping.x == step.x == of_joints[0].x


def test_a_joint_that_rests_has_no_chart(overview):
    session = overview.calibration.session
    still = replace(
        overview.calibration, session=replace(session, q=session.q * [1, 0, *[1] * (session.q.shape[1] - 2)])
    )
    names = [chart.name for chart in residual_charts(replace(overview, calibration=still))]
    assert "joint 2" not in names
    assert "joint 1" in names


def test_a_trend_shows_in_the_means(overview):
    from dataclasses import replace

    (table,) = overview.scene.tables
    joint = 1
    q = overview.calibration.session.q[table.pose, joint]
    bent = table.measured + np.outer(0.5 * (q - q.mean()), [1.0, 0.0])
    scene = replace(overview.scene, tables=(replace(table, predicted=bent),))
    chart = next(c for c in residual_charts(replace(overview, scene=scene)) if c.name == f"joint {joint + 1}")
    mean = next(mark for mark in chart.marks if mark.name == "mean 0")
    assert (np.diff(mean.y) > 0).all()


def test_a_scale_may_hold_its_values_without_room_beside_them():
    scale = Scale.holding([1.0, 3.0], room=0.0)
    assert (scale.low, scale.high) == (1.0, 3.0)
    flat = Scale.holding([0.0, 0.0], room=0.0)
    assert np.isfinite(flat.share([0.0])).all()
    assert flat.ticks()


@pytest.mark.no_cover
def test_what_charts_call_the_declared_noise_is_what_the_estimate_weighs_by(simulated):
    """Joint noise of 1 mrad outweighs that of pixels: residuals in units of what was declared still have length 1."""
    data = simulated("ur5", poses=40)
    q = data.session.q + 1e-3 * np.random.default_rng(0).normal(size=data.session.q.shape)
    session = replace(data.session, q=q, noise=replace(data.session.noise, joint=1e-3))
    calibration = calibrate(session, force=True)
    (table,) = measurements_of(calibration)
    assert np.median(table.spread) > 3.0 * np.median(table.sigma)
    np.testing.assert_allclose(np.sqrt(np.mean(table.sigmas(table.predicted) ** 2)), 1.0, atol=0.35)
    by_length = np.sqrt(np.mean(np.sum(table.sigmas(table.predicted) ** 2, axis=1) / 2.0))
    np.testing.assert_allclose(by_length, np.sqrt(np.mean(table.size[table.used] ** 2)), rtol=0.15)
    (still,) = measurements_of(calibrate(replace(data.session, noise=replace(data.session.noise, joint=0.0))))
    np.testing.assert_allclose(still.spread, np.repeat(still.sigma[:, None], 2, axis=1))
