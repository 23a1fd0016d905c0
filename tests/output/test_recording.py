from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import rerun as rr
import rerun.blueprint as rrb

import urdfcal
from tests.recorded import Recorded
from urdfcal.arrays import inverse
from urdfcal.cameras.rig import Rig
from urdfcal.errors import OutputError
from urdfcal.estimation.measurements import Detections, Points
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output import arms
from urdfcal.output.chart import Chart, Mark, Scale
from urdfcal.output.charts import convergence_charts, parameter_charts
from urdfcal.output.entities import chart_view
from urdfcal.output.findings import Overview, headline
from urdfcal.output.images import arm_in_images, compressed, overlays
from urdfcal.output.palette import CALIBRATED
from urdfcal.output.recording import layout, write_recording
from urdfcal.output.scene import build_scene
from urdfcal.output.stream import CORNER
from urdfcal.pipeline import calibrate
from urdfcal.robot.chain import Chain
from urdfcal.robot.kinematics import tip_poses
from urdfcal.robot.urdf.urdf import Urdf, find_urdf
from urdfcal.session.knowledge import Estimate, Led
from urdfcal.session.model import Session
from urdfcal.simulation.simulate import simulate

POSES = 20
BLIND = 3
"""A pose at which no camera sees the LED."""


def make_session(shipped="elbow3r", **changes):
    session = simulate(read_rig(find_rig(shipped)), seed=4, poses=POSES).session
    seen = session.find(Detections).pose != BLIND
    columns = {name: column[seen] for name, column in session.find(Detections).arrays.items()}
    columns["uv"][5] += 40.0
    detections = Detections(**columns)
    values = {name: getattr(session, name) for name in session.__dataclass_fields__}
    return Session(**values | {"measurements": (detections,)} | changes)


@pytest.fixture(scope="module")
def calibration():
    return calibrate(make_session())


@pytest.fixture(scope="module")
def recorded(calibration, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "calibration.rrd"
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # rerun only warns when it cannot log something
        assert write_recording(path, Overview.of(calibration)) == ()
    assert [file.name for file in path.parent.iterdir()] == ["calibration.rrd"]
    return Recorded(path)


def residuals(calibration, state):
    """Predicted minus measured of every sighting, and its pose, by the estimator's own prediction."""
    (block,) = calibration.observations
    pose = np.broadcast_to(block.pose[:, None], block.valid.shape)
    used = block.valid & ~calibration.fit.outlier[0]
    return pose[used], calibration.problem.residual(block, state)[used]


def test_everything_promised_is_there(recorded):
    for entity in ("calibrated", "nominal", "dh/F0", "dh/F3", "led/measured", "led/predicted", "texts/about"):
        assert any(name.startswith(f"/base/{entity}") for name in recorded.entities), entity
    for camera in ("cam0", "cam1"):
        assert f"/base/rays/{camera}" in recorded.entities
        assert f"/base/cameras/{camera}/image" in recorded.entities
    assert recorded.timelines == {"pose", "iteration"}
    assert len(recorded.reader.blueprints()) == 1


@pytest.mark.no_cover
def test_poses_of_known_time_have_a_time_axis_and_a_number_from_1(calibration, tmp_path):
    session = replace(calibration.session, time=0.5 * np.arange(POSES) + 3.0)
    write_recording(tmp_path / "timed.rrd", Overview.of(replace(calibration, session=session)))
    timed = Recorded(tmp_path / "timed.rrd")
    assert timed.timelines == {"pose", "time", "iteration"}
    entity, component = "/base/texts/about", "TextDocument:text"
    seconds = [of.total_seconds() for of in timed.rows(entity, component, "time")]
    np.testing.assert_allclose(seconds, session.time)
    (batch,) = [b for chunk, b in timed.chunks if chunk.entity_path == entity and component in b.schema.names]
    assert batch.column("pose").to_pylist() == list(range(1, POSES + 1))


def test_before_and_after_are_shown_in_one_scale(calibration, recorded):
    """Arrows of both arms are enlarged alike, and those of known lengths say by how much."""
    scene = build_scene(calibration)
    for camera in calibration.estimate.cameras:
        image = f"/base/cameras/{camera.name}/image"
        for name, factor in (("scale", scene.pixel_factor), ("scale\\ enlarged", scene.field_factor)):
            (label,) = recorded.static(f"{image}/{name}", "Arrows2D:labels")
            ((length, _),) = recorded.static(f"{image}/{name}", "Arrows2D:vectors")
            assert length / factor == pytest.approx(float(label.removesuffix(" px")), rel=1e-5)
        near, far = (recorded.static(f"{image}/{name}", "Arrows2D:vectors") for name in ("field", "field\\ enlarged"))
        np.testing.assert_allclose(far * scene.pixel_factor, near * scene.field_factor, rtol=1e-3, atol=1e-2)


def test_every_pose_has_its_row_even_when_nothing_was_seen(recorded):
    for entity, component in (
        ("/base/led/measured", "Points3D:positions"),
        ("/base/rays/cam0", "LineStrips3D:strips"),
        ("/base/residuals/calibrated", "Arrows3D:vectors"),
        ("/base/cameras/cam1/image/sighted", "Points2D:positions"),
    ):
        rows = recorded.rows(entity, component)
        assert list(rows) == list(range(POSES))
        assert len(rows[BLIND]) == 0
        assert len(rows[BLIND + 1]) == 1
    assert len(recorded.rows("/base/plots/residual_px/calibrated", "Scalars:scalars")[BLIND]) == 0


@pytest.mark.parametrize("name", ["nominal", "calibrated"])
def test_logged_residuals_are_those_of_the_calibration(calibration, recorded, name):
    state = (calibration.nominal_fit if name == "nominal" else calibration.fit).state
    pose, residual = residuals(calibration, state)
    rows = recorded.rows(f"/base/plots/residual_px/{name}", "Scalars:scalars")
    for k in range(POSES):
        expected = [np.sqrt(np.mean(np.sum(residual[pose == k] ** 2, axis=1)))] if k in pose else []
        np.testing.assert_allclose(rows[k], expected, rtol=1e-12)
    summary = calibration.to_dict()["fit"]
    per_iteration = recorded.rows("/base/plots/rms_px", "Scalars:scalars", "iteration")
    assert per_iteration[0] == pytest.approx(summary["rms_nominal_px"], rel=1e-12)
    assert per_iteration[max(per_iteration)] == pytest.approx(summary["rms_px"], rel=1e-12)


def test_cost_of_every_iteration_is_logged(calibration, recorded):
    rows = recorded.rows("/base/plots/cost", "Scalars:scalars", "iteration")
    np.testing.assert_allclose(np.concatenate(list(rows.values())), [step.cost for step in calibration.fit.history])


def test_pictures_show_where_the_led_was_seen_and_predicted(calibration, recorded):
    seen = calibration.session.find(Detections)
    for c, camera in enumerate(("cam0", "cam1")):
        logged = recorded.all_rows(f"/base/cameras/{camera}/image/sighted", "Points2D:positions")
        np.testing.assert_allclose(logged, seen.uv[seen.camera == c] + CORNER, atol=1e-3)
        predicted = recorded.all_rows(f"/base/cameras/{camera}/image/predicted", "Points2D:positions")
        (block,) = calibration.observations
        expected = calibration.problem.predict(block, calibration.fit.state)[block.valid & (block.index["camera"] == c)]
        np.testing.assert_allclose(predicted, expected + CORNER, atol=1e-3)


def test_predicted_led_rides_on_the_calibrated_tip(calibration, recorded):
    chain, state = calibration.chain, calibration.estimate
    T = tip_poses(chain, calibration.session.q, calibration.placements)
    expected = T[:, :3, :3] @ state.leds[0] + T[:, :3, 3]
    logged = recorded.rows("/base/led/predicted", "Points3D:positions")
    for k, row in logged.items():
        if k != BLIND:
            np.testing.assert_allclose(row[0], expected[k], atol=1e-6)


def test_arrows_are_residuals_enlarged_by_the_stated_factor(calibration, recorded):
    (text,) = recorded.rows("/base/texts/about", "TextDocument:text")[0]
    factor = float(re.search(r"enlarged \*\*(\d+) times", text)[1])
    assert factor == build_scene(calibration).factor
    measured = recorded.all_rows("/base/led/measured", "Points3D:positions")
    predicted = recorded.all_rows("/base/led/predicted", "Points3D:positions")
    vectors = recorded.all_rows("/base/residuals/calibrated", "Arrows3D:vectors")
    np.testing.assert_allclose(vectors, factor * (predicted - measured), atol=factor * 1e-6)


def test_rays_leave_the_camera_through_the_sighting(calibration, recorded):
    for c, camera in enumerate(calibration.estimate.cameras):
        T = calibration.estimate.T_cam_frame[c] @ calibration.estimate.T_world_base
        strips = recorded.all_rows(f"/base/rays/{camera.name}", "LineStrips3D:strips")
        np.testing.assert_allclose(strips[:, 0], inverse(T)[:3, 3] + np.zeros((len(strips), 3)), atol=1e-6)
        pixels = camera.project(strips[:, 1] @ T[:3, :3].T + T[:3, 3])
        seen = calibration.session.find(Detections)
        np.testing.assert_allclose(pixels, seen.uv[seen.camera == c], atol=0.01)


def test_sightings_taken_out_of_the_fit_are_marked(calibration, recorded):
    (outlier,) = calibration.to_dict()["outliers"]
    marked = recorded.static(f"/base/cameras/{outlier['camera']}/image/outliers", "Points2D:positions")
    np.testing.assert_allclose(marked, calibration.session.find(Detections).uv[5][None] + CORNER, atol=1e-3)
    assert recorded.static("/base/led/outliers", "Points3D:positions").shape == (1, 3)


def test_links_move_with_the_calibrated_joints(calibration, recorded):
    scene = build_scene(calibration)
    link = calibration.session.urdf.joints[calibration.chain.names[-1]].child
    logged = recorded.rows(f"/base/calibrated/{link}", "Transform3D:translation")
    np.testing.assert_allclose(np.concatenate(list(logged.values())), scene.frames[:, -1, :3, 3], atol=1e-6)


@pytest.mark.no_cover
def test_a_trackers_points_are_recorded_without_cameras(calibration, tmp_path):
    session, state = calibration.session, calibration.estimate
    T = state.T_world_base @ tip_poses(session.chain, session.q, calibration.placements)
    leds = np.array([[0.02, 0.0, 0.05], [0.0, 0.03, 0.04]])
    xyz = (leds @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]).reshape(-1, 3)
    pose, led = np.divmod(np.arange(2 * POSES), 2)
    points = Points(pose, led, xyz + np.random.default_rng(0).normal(0, 1e-4, xyz.shape), 1e-4)
    tracked = calibrate(make_session(leds=(Led("a"), Led("b")), rig=Rig(), measurements=(points,)))
    write_recording(tmp_path / "points.rrd", Overview.of(tracked))
    recorded = Recorded(tmp_path / "points.rrd")
    assert not [entity for entity in recorded.entities if entity.startswith(("/base/cameras", "/base/rays"))]
    measured = recorded.all_rows("/base/led/measured", "Points3D:positions")
    T = inverse(tracked.estimate.T_world_base)
    np.testing.assert_allclose(measured, points.xyz @ T[:3, :3].T + T[:3, 3], atol=1e-5)
    rms = recorded.rows("/base/plots/residual_mm/calibrated", "Scalars:scalars")
    assert 0.05 < np.mean(np.concatenate(list(rms.values()))) < 0.3


@pytest.mark.no_cover
def test_with_one_camera_the_measured_led_lies_on_its_ray():
    session = make_session()
    one = Rig(session.rig.cameras[:1], session.rig.T_cam_world[:1])
    seen = session.find(Detections).camera == 0
    columns = {name: column[seen] for name, column in session.find(Detections).arrays.items()}
    scene = build_scene(calibrate(make_session(rig=one, measurements=(Detections(**columns),))))
    np.testing.assert_allclose(scene.leds.measured, scene.rays[:, 1])


@pytest.mark.no_cover
def test_an_arm_without_shapes_is_a_stick_figure(calibration, tmp_path):
    bare = re.sub(rb"<visual.*?</visual>", b"", calibration.session.urdf.data, flags=re.DOTALL)
    urdf = Urdf.parse(bare)
    stick = calibrate(make_session(urdf=urdf, chain=Chain.from_urdf(urdf, calibration.chain.tip_link)))
    assert write_recording(tmp_path / "stick.rrd", Overview.of(stick)) == ()
    recorded = Recorded(tmp_path / "stick.rrd")
    strips = recorded.all_rows("/base/calibrated/stick\\ figure", "LineStrips3D:strips")
    tips = tip_poses(stick.chain, stick.session.q, stick.placements)
    np.testing.assert_allclose(strips[:, -1], tips[:, :3, 3], atol=1e-6)
    assert "/base/nominal/stick\\ figure" in recorded.entities


def test_meshes_are_recorded_once_an_arm_and_missing_ones_are_named(tmp_path):
    data = find_urdf("package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf").read_bytes()
    urdf = Urdf.parse(data.replace(b"ur5/visual/forearm.dae", b"ur5/visual/lost.dae"))
    broken = calibrate(make_session("ur5", urdf=urdf))
    (warning,) = write_recording(tmp_path / "ur5.rrd", Overview.of(broken))
    assert "1 shape " in warning
    assert "lost.dae" in warning
    recorded = Recorded(tmp_path / "ur5.rrd")
    meshes = [c.entity_path for c, batch in recorded.chunks if "Asset3D:blob" in batch.schema.names]
    assert len(meshes) == len(set(meshes)) == 2 * 6
    assert "/base/calibrated/stick\\ figure" in recorded.entities


def test_ellipsoids_are_the_triangulated_covariances(calibration, recorded):
    leds = build_scene(calibration).leds
    half = recorded.all_rows("/base/led/covariance", "Ellipsoids3D:half_sizes")
    q = recorded.all_rows("/base/led/covariance", "Ellipsoids3D:quaternions")
    R = np.array([pin.Quaternion(*np.roll(row, 1)).normalized().matrix() for row in q])
    factor = build_scene(calibration).factor * 2.0
    covariance = R @ (np.eye(3) * (half[:, None] / factor) ** 2) @ np.swapaxes(R, 1, 2)
    np.testing.assert_allclose(covariance, leds.covariance, rtol=1e-3, atol=1e-12)
    depth = np.sqrt(np.linalg.eigvalsh(leds.covariance))
    assert (depth[:, 2] > 2 * depth[:, 0]).all()  # stereo tells width better than depth


def test_the_arm_is_drawn_into_the_pictures(calibration, recorded):
    for c, camera in enumerate(("cam0", "cam1")):
        for name in ("calibrated", "nominal"):
            strips = recorded.rows(f"/base/cameras/{camera}/image/arm/{name}", "LineStrips2D:strips")
            arm = calibration.nominal if name == "nominal" else calibration.estimate
            expected = arm_in_images(calibration, arm, calibration.session.q)[c]
            assert list(strips) == list(range(POSES))
            np.testing.assert_allclose(strips[BLIND][0], expected[BLIND] + CORNER, atol=1e-3)


def test_of_all_that_is_drawn_over_a_picture_its_border_alone_is_lowest(recorded):
    """The viewer hides the lowest behind the picture, which was the nominal arm."""
    lowest = recorded.static("/base/cameras/cam0/image/border", "LineStrips2D:draw_order")
    for name in ("nominal", "calibrated"):
        assert recorded.static(f"/base/cameras/cam0/image/arm/{name}", "LineStrips2D:draw_order") > lowest > -10.0


def test_what_is_predicted_is_drawn_over_what_was_detected(recorded):
    def order(name: str) -> float:
        return float(np.squeeze(recorded.static(f"/base/cameras/cam0/image/{name}", "Points2D:draw_order")))

    lines = recorded.static("/base/cameras/cam0/image/arm/nominal", "LineStrips2D:draw_order")
    assert order("predicted") > order("nominal") > order("sighted") > lines


def test_axes_of_frames_are_in_the_first_view_of_the_rows(calibration):
    scene = build_scene(calibration)
    ends = arms.dh_extent(calibration.table, scene)
    frames = scene.rows.frames.reshape(-1, 4, 4)
    for axis in range(3):
        tip = frames[:, :3, 3] + 0.08 * calibration.chain.reach * frames[:, :3, axis]
        assert all(np.linalg.norm(ends - of, axis=1).min() < 1e-9 for of in tip)


def test_common_normals_are_to_scale(calibration, recorded):
    rows = calibration.table.nominal + calibration.estimate.offsets
    for column, name in ((1, "d"), (2, "a")):
        for i, value in enumerate(rows[:, column]):
            entity = f"/base/dh/rows/{name}{i + 1}"
            if entity in recorded.entities:
                strips = recorded.all_rows(entity, "LineStrips3D:strips")
                lengths = np.linalg.norm(strips[:, 1] - strips[:, 0], axis=-1)
                np.testing.assert_allclose(lengths, abs(value), atol=1e-6)
                assert recorded.static(f"{entity}/label", "Points3D:labels")[0] == f"{name}{i + 1}"
                beside = recorded.all_rows(f"{entity}/label", "Points3D:positions") - strips.mean(axis=1)
                across = np.einsum("ni,ni->n", beside, strips[:, 1] - strips[:, 0])
                np.testing.assert_allclose(across, 0.0, atol=1e-6)
                np.testing.assert_allclose(np.linalg.norm(beside, axis=1), 0.035 * calibration.chain.reach, rtol=1e-4)
            else:
                assert abs(value) < 2e-3 * calibration.chain.reach
    assert "/base/dh/rows/a2" in recorded.entities


def test_parameters_come_with_their_band_step_by_step(calibration, recorded):
    sigmas, history = 1e3 * calibration.sigmas(), calibration.fit.history
    found = 0
    for i, joint in enumerate(calibration.chain.names):
        for k, name in enumerate(calibration.geometry.columns):
            entity = f"/base/plots/parameters/{joint}/{name}"
            assert (entity in recorded.entities) == np.isfinite(sigmas[i, k])
            if np.isfinite(sigmas[i, k]):
                rows = recorded.rows(entity, "Scalars:scalars", "iteration")
                final = 1e3 * calibration.estimate.offsets[i, k]
                assert len(rows) == len(history) + 1
                np.testing.assert_allclose(rows[0], [0.0, final - sigmas[i, k], final + sigmas[i, k]], atol=1e-12)
                np.testing.assert_allclose(rows[len(history)][0], final, atol=1e-12)
                found += 1
    assert found > 5
    for name in ("damping", "step"):
        rows = recorded.rows(f"/base/plots/{name}", "Scalars:scalars", "iteration")
        np.testing.assert_allclose([row[0] for row in rows.values()], [getattr(step, name) for step in history])


def test_verdict_table_and_workspace_are_there(calibration, recorded):
    overview = Overview.of(calibration)
    (banner,) = recorded.static("/base/banner", "Points2D:labels")
    assert calibration.assessment.sentence in banner
    assert headline(overview.document) in banner
    (table,) = recorded.static("/base/texts/rows", "TextDocument:text")
    for lost in calibration.identifiability.unidentifiable:
        assert lost in table
    assert table.count("±") == np.isfinite(calibration.sigmas()).sum()
    for name in ("nominal", "calibrated"):
        tips = recorded.static(f"/base/workspace/{name}", "Points3D:positions")
        np.testing.assert_allclose(tips, overview.workspace.tip, atol=1e-6)
    assert recorded.static("/base/texts/poses", "poses").tolist() == list(calibration.session.poses)


def test_every_bar_has_its_name_and_the_rows_a_tab_of_their_own(calibration, recorded):
    for chart in parameter_charts(calibration):
        labels = recorded.static(f"/base/charts/{chart.name}/ticks", "Points2D:labels")
        assert set(chart.y.names.values()) <= set(labels)
    tabs = layout(Overview.of(calibration)).root_container.contents
    assert [tab.name for tab in tabs][3:6] == ["Joints", "Parameters", "DH rows"]
    assert isinstance(tabs[5], rrb.Vertical), "the table needs the window's width"


def test_the_label_of_an_axis_is_below_its_numbers_and_in_the_view(calibration, recorded):
    """In a pane of 320 x 180 points a text of 24 is as high as 18 units."""
    (cost,) = (chart for chart in convergence_charts(calibration) if chart.name == "cost")
    places = recorded.static("/base/charts/cost/ticks", "Points2D:positions")
    labels = recorded.static("/base/charts/cost/ticks", "Points2D:labels").tolist()
    label, numbers = places[labels.index("iteration"), 1], places[labels.index("0"), 1]
    bounds = chart_view(cost, "base").properties["VisualBounds2D"].range.as_arrow_array().to_pylist()[0]
    assert label - numbers >= 18.0
    assert bounds["y_range"][1] - label >= 18.0


def test_a_tick_is_not_cut_at_the_edge_of_its_view():
    marks = [Mark("dots", "dots", [1.0, 2.0], [1e-4, 1e-8], CALIBRATED)]
    small = Chart("small", "small", Scale(0.0, 3.0), Scale(1e-8, 1e-4, logarithmic=True), marks)
    short = replace(small, y=Scale(0.0, 5.0))
    left = [chart_view(chart, "base").properties["VisualBounds2D"].range for chart in (small, short)]
    left = [bounds.as_arrow_array().to_pylist()[0]["x_range"][0] for bounds in left]
    assert left[0] < left[1] < 0.0


def test_the_curves_of_an_arm_that_moved_are_seen_from_the_first_frame_to_the_last(calibration, monkeypatch):
    def axis():
        arm = layout(Overview.of(calibration)).root_container.contents[0]
        curves = arm.contents[1].contents[1].contents[1]
        return curves.name, curves.properties.get("TimeAxis")

    table = build_scene(calibration).tables[0]
    largest = max(table.rms_by(table.pose, of)[1].max() for of in table.by_arm.values())
    assert axis() == (f"rms by pose: up to {largest:.2g} px", None)
    times = np.linspace(3.0, 8.0, POSES)
    monkeypatch.setattr("urdfcal.output.charts.frame_times", lambda _: times)
    name, shown = axis()
    assert name == f"rms by frame (timeline time): up to {largest:.2g} px; means"
    assert "3000000000" in str(shown.view_range.as_arrow_array())
    assert "8000000000" in str(shown.view_range.as_arrow_array())


@pytest.mark.no_cover
def test_whole_placements_are_recorded_too(tmp_path):
    full = calibrate(make_session(estimate=Estimate(geometry="full")), force=True)
    assert write_recording(tmp_path / "full.rrd", Overview.of(full)) == ()
    recorded = Recorded(tmp_path / "full.rrd")
    tips = tip_poses(full.chain, full.session.q, full.placements)[:, :3, 3]
    strips = recorded.all_rows("/base/cameras/cam0/image/arm/calibrated", "LineStrips2D:strips")
    T = full.estimate.T_world_base
    expected = full.estimate.cameras[0].project(tips @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(strips[:, -1], expected + CORNER, atol=1e-2)
    assert any("/rx" in entity for entity in recorded.entities)


def test_photographs_and_overlay(calibration, tmp_path):
    import cv2

    session = calibration.session
    for camera in session.rig.cameras:
        folder = tmp_path / "images" / camera.name
        folder.mkdir(parents=True)
        image = np.full(camera.resolution[::-1], 90, dtype=np.uint8)
        cv2.imwrite(str(folder / f"{session.poses[2]}.png"), image)
    seen = replace(calibration, session=replace(session, folder=tmp_path))
    write_recording(tmp_path / "calibration.rrd", Overview.of(seen))
    recorded = Recorded(tmp_path / "calibration.rrd")
    blobs = recorded.rows("/base/cameras/cam0/image", "EncodedImage:blob")
    assert [k for k, row in blobs.items() if len(row)] == [2]
    pictures, without = overlays(tmp_path / "calibration.rrd", session.poses[2])
    assert list(pictures) == ["cam0", "cam1"]
    assert without == ()
    assert overlays(tmp_path / "calibration.rrd", session.poses[3])[1] == ("cam0", "cam1")
    tip = arm_in_images(calibration, calibration.estimate, session.q[2:3])[0][0, -1]
    u, v = np.round(tip).astype(int)
    assert np.abs(pictures["cam0"][v, u].astype(int) - CALIBRATED[::-1]).max() < 60
    assert np.abs(pictures["cam0"][5, 5].astype(int) - 90).max() <= 2
    with pytest.raises(OutputError, match="no pose 'nowhere'"):
        overlays(tmp_path / "calibration.rrd", "nowhere")


def test_rejected_lights_are_marked_with_the_reason(calibration, tmp_path):
    session = calibration.session
    (tmp_path / "detections_rejected.csv").write_text(
        "pose,camera,led,u,v,sigma,peak,width,reason\n"
        f"{session.poses[4]},cam1,led,668,1022.0,,,,larger than an LED\n"
        f"{session.poses[4]},cam1,led,,,,,,no light\nnowhere,cam1,led,1,2,,,,of no pose\n"
    )
    write_recording(
        tmp_path / "calibration.rrd", Overview.of(replace(calibration, session=replace(session, folder=tmp_path)))
    )
    recorded = Recorded(tmp_path / "calibration.rrd")
    entity = "/base/cameras/cam1/image/rejected"
    found = recorded.rows(entity, "Points2D:positions")
    assert [k for k, row in found.items() if len(row)] == [4]
    np.testing.assert_allclose(found[4], [[668 + CORNER, 1022 + CORNER]])
    assert recorded.rows(entity, "Points2D:labels")[4].tolist() == ["larger than an LED"]
    (text,) = recorded.static("/base/texts/pixels", "TextDocument:text")
    assert "lights that detection rejected" in text


def test_without_rejected_lights_nothing_is_said_of_them_and_lines_leave_the_arrows_to_be_seen(recorded):
    (text,) = recorded.static("/base/texts/pixels", "TextDocument:text")
    assert "rejected" not in text
    nominal, arrows = (
        -recorded.static(f"/base/cameras/cam0/image/{name}", component)[0]
        for name, component in (("arm/nominal", "LineStrips2D:radii"), ("field", "Arrows2D:radii"))
    )
    assert nominal <= 2.0 * arrows


def test_dark_photographs_are_brightened(tmp_path):
    import cv2

    for name, brightness in (("dark", 10), ("light", 120)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((40, 60), brightness, dtype=np.uint8))
    dark, light = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        for data in compressed([tmp_path / "dark.png", tmp_path / "light.png"])
    )
    assert dark.mean() == pytest.approx(255 * (10 / 255) ** (1 / 2.2), abs=3)
    assert light.mean() == pytest.approx(120, abs=3)


def test_the_users_own_stream_and_path(calibration):

    stream = rr.RecordingStream("mine")
    memory = stream.memory_recording()
    urdfcal.log(stream, calibration, "cell/robot 1")
    assert memory.num_msgs() > 50


def test_a_failed_recording_leaves_nothing_behind(calibration, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("stop")

    monkeypatch.setattr(arms, "log_arms", fail)
    path = tmp_path / "calibration.rrd"
    path.write_bytes(b"earlier")
    with pytest.raises(RuntimeError, match="stop"):
        write_recording(path, Overview.of(calibration))
    assert [file.name for file in tmp_path.iterdir()] == ["calibration.rrd"]
    assert path.read_bytes() == b"earlier"
