from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from tests.browser import Browser
from urdfcal.cameras.rig import Rig
from urdfcal.estimation.measurements import Detections
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.output.arms import Shape
from urdfcal.output.charts import parameter_charts
from urdfcal.output.figures import _magnitudes, _projections, figures
from urdfcal.output.findings import Overview, headline, look_up
from urdfcal.output.portrait import portrait, triangles
from urdfcal.output.pose_texts import pose_texts
from urdfcal.output.report import _correlated_pairs, write_report
from urdfcal.output.worst import worst
from urdfcal.pipeline import calibrate
from urdfcal.session.knowledge import Estimate
from urdfcal.simulation.simulate import simulate

CHROMIUM = shutil.which("chromium")


class Page(HTMLParser):
    """The numbers, texts, links and elements of a page."""

    def __init__(self, text):
        super().__init__()
        self.numbers, self.words, self.elements, self.links = [], [], [], []
        self._number = None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.elements.append((tag, attributes.get("class", "")))
        self.links += [attributes[a] for a in ("src", "href", "xlink:href", "action") if a in attributes]
        if tag == "data":
            self._number = attributes

    def handle_data(self, data):
        if self._number is not None:
            self.numbers.append((self._number["data-key"], self._number["value"], data))
            self._number = None
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def a_session(rig="elbow3r", lens=1.0, outlier=True):
    session = simulate(read_rig(find_rig(rig)), seed=4, poses=20).session
    if outlier:
        uv = np.array(session.find(Detections).uv)
        uv[5] += 40.0
        session = replace(session, measurements=(replace(session.find(Detections), uv=uv),))
    cameras = tuple(replace(c, intrinsics=c.intrinsics * [lens, lens, 1, 1]) for c in session.rig.cameras)
    return replace(session, rig=Rig(cameras, session.rig.T_cam_world))


@pytest.fixture(scope="module")
def calibration():
    return calibrate(a_session())


@pytest.fixture(scope="module")
def path(calibration, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, Overview.of(calibration))
    calibration.save(path.with_name("calibration.json"))
    return path


@pytest.fixture(scope="module")
def page(path):
    return Page(path.read_text())


def test_every_number_is_that_of_the_json(path, page):
    document = json.loads(path.with_name("calibration.json").read_text())
    assert len(page.numbers) > 40
    for key, value, shown in page.numbers:
        expected = look_up(document, key.split("/"))
        assert float(value) == expected, key
        scale = 1000.0 if key.startswith(("dh/", "leds/", "T_world_base/")) else 1.0
        assert float(shown.replace("\N{MINUS SIGN}", "-")) == pytest.approx(scale * expected, rel=5.1e-3, abs=5.1e-4), (
            key
        )


def test_every_estimated_row_is_shown(path, page):
    document = json.loads(path.with_name("calibration.json").read_text())
    shown = {key for key, _, _ in page.numbers}
    for i, entry in enumerate(document["dh"]):
        assert f"dh/{i}/nominal" in shown
        assert (f"dh/{i}/offset" in shown) == (entry["status"] == "estimated")
    assert {f"leds/{name}/position/2" for name in document["leds"]} <= shown


def test_verdict_stands_first_and_what_is_lost_is_said(calibration, page):
    document = calibration.to_dict()
    text = page.text
    assert text.index(calibration.assessment.sentence) < text.index("In numbers")
    for sentence in (*document["identifiability"]["lost"], *document["warnings"]):
        assert sentence in text
    for hash_ in document["provenance"]["sha256"].values():
        assert hash_ in text
    (outlier,) = document["outliers"]
    assert f"{outlier['residual']:.2f} px" in text


def test_what_is_known_of_the_arm_is_said_and_no_folder_of_this_machine(calibration, tmp_path):
    session = replace(calibration.session, about={"serial": "00<42>"}, urdf_reference="/home/me/secret/arm.urdf")
    session = replace(session, sha256={"/home/me/secret/arm.urdf": "0" * 64}, folder=Path("/home/me/secret/s"))
    warnings = ("/home/me/secret/s/joints.csv:3:1: odd",)
    assessment = replace(calibration.assessment, warnings=warnings)
    write_report(tmp_path / "report.html", Overview.of(replace(calibration, session=session, assessment=assessment)))
    page = Page((tmp_path / "report.html").read_text())
    assert "serial 00<42>" in page.text
    assert "arm.urdf" in page.text
    assert "joints.csv:3:1: odd" in page.text
    assert "secret" not in (tmp_path / "report.html").read_text()
    shown = pose_texts(Overview.of(replace(calibration, session=session, assessment=assessment)))[0]
    assert shown.index("- joints.csv:3:1: odd") < shown.index("Blue ghost"), "what is to be checked stands first"
    assert "secret" not in shown


def test_the_worst_measurements_are_listed_by_how_unlikely_they_are(calibration, page):
    table = Overview.of(calibration).scene.tables[0]
    found = worst(Overview.of(calibration))
    assert [miss.sigmas for miss in found] == sorted(table.size, reverse=True)[:10]
    assert found[0].outlier
    assert found[0].pose == calibration.session.poses[int(table.pose[np.argmax(table.size)])]
    k = int(np.argmax(table.size))
    assert found[0].residual == pytest.approx(np.linalg.norm((table.predicted - table.measured)[k]))
    assert "Worst first" in page.text
    assert f"{found[1].residual:.3f}" in page.text


def test_they_are_shown_on_their_pictures(calibration, tmp_path):
    import cv2

    session, first = calibration.session, worst(Overview.of(calibration))[0]
    folder = tmp_path / "images" / first.camera
    folder.mkdir(parents=True)
    camera = session.rig.cameras[session.rig.index(first.camera)]
    cv2.imwrite(str(folder / f"{first.pose}.png"), np.full(camera.resolution[::-1], 90, dtype=np.uint8))
    overview = Overview.of(replace(calibration, session=replace(session, folder=tmp_path)))
    assert [bool(miss.crop) for miss in worst(overview)] == [
        (miss.pose, miss.camera) == (first.pose, first.camera) for miss in worst(overview)
    ]
    crop = ElementTree.fromstring(worst(overview)[0].crop)  # noqa: S314  # our own
    side = float(crop.get("viewBox").split()[2])
    ring, cross = crop.find("{*}circle"), crop.find("{*}path").get("d")
    assert float(ring.get("cx")) == pytest.approx(side / 2, abs=1.0)
    x = np.mean([float(x) for x in re.findall(r"M([-\d.]+)", cross)][1:])
    assert abs(x - float(ring.get("cx"))) <= first.residual
    write_report(tmp_path / "report.html", overview)
    assert "data:image/png" in (tmp_path / "report.html").read_text()


def test_parameters_that_go_together_are_named(calibration):
    pairs = _correlated_pairs(calibration)
    parameters, covariance = calibration.fit.parameters, calibration.fit.covariance
    names = np.array(parameters.names)[parameters.active].tolist()
    for one, other, value in pairs:
        i, j = names.index(one), names.index(other)
        assert value == pytest.approx(covariance[i, j] / np.sqrt(covariance[i, i] * covariance[j, j]))
        assert abs(value) > 0.9
        assert any(name.startswith(tuple(calibration.geometry.labels)) for name in (one, other))
    assert pairs == sorted(pairs, key=lambda pair: -abs(pair[2]))


def test_an_led_whose_place_is_hardly_known_is_explained(calibration, tmp_path):
    overview = Overview.of(calibration)
    write_report(tmp_path / "known.html", overview)
    leds = {name: {**led, "sigma": [0.06, 0.06, 0.001]} for name, led in overview.document["leds"].items()}
    write_report(tmp_path / "report.html", replace(overview, document={**overview.document, "leds": leds}))
    said = "is hardly known by itself"
    assert [said in (tmp_path / f"{name}.html").read_text() for name in ("known", "report")] == [False, True]


def test_residuals_before_and_after_are_in_one_scale_beside_an_arrow_of_a_known_length(calibration):
    scene = Overview.of(calibration).scene
    rows = figures(Overview.of(calibration))["fields"].rows
    charts = [chart for row in rows for chart in row]
    assert {chart.title.split(", ")[-1] for chart in charts} == {f"{scene.pixel_factor:g} x"}
    for chart in charts:
        marks, ((_, _, text),) = {mark.name: mark for mark in chart.marks}, chart.labels
        (arrow,) = marks["reference"].x
        assert (arrow[1] - arrow[0]) / scene.pixel_factor == pytest.approx(float(text.removesuffix(" px")))
    nominal = np.concatenate([chart.marks[1].x[:, 1] - chart.marks[1].x[:, 0] for chart in rows[0]])
    after = np.concatenate([chart.marks[1].x[:, 1] - chart.marks[1].x[:, 0] for chart in rows[1]])
    assert np.std(after) < 0.5 * np.std(nominal)


def test_frames_are_not_called_poses(calibration, tmp_path):
    overview = Overview.of(calibration)
    cameras = {
        name: {**camera, "time_offset": {"value": 0.0, "sigma": None}}
        for name, camera in overview.document["cameras"].items()
    }
    for of, one in (
        (overview, "pose"),
        (replace(overview, document={**overview.document, "cameras": cameras}), "frame"),
    ):
        write_report(tmp_path / "report.html", of)
        text = Page((tmp_path / "report.html").read_text()).text
        assert f"20 {one}s with" in text
        assert f"the timeline has the {one}s by these numbers" in text
        assert f"rms error on held-out {one}s" in text
        assert f"held-out {one}s, 95 % below" in text


def test_what_was_seen_outside_of_the_image_is_told_and_the_first_row_belongs_to_it(calibration):
    """Pixel 0 reaches from -0.5 to 0.5; and what lies beyond the image is no share of it."""
    overview = Overview.of(calibration)
    pixels = overview.scene.pixels

    def drawn(measured):
        moved = replace(pixels, measured=measured, predicted=measured + 0.1)
        return figures(replace(overview, scene=replace(overview.scene, pixels=moved)))

    at_the_top = pixels.measured.copy()
    at_the_top[:, 1] = -0.26
    for chart in drawn(at_the_top)["magnitudes"].rows[0]:
        assert chart.y.high == pytest.approx(0.0), "no cell stands on top of the image"
        assert "outside" not in chart.title
    # The last row of cells is cut where the image ends.
    low = replace(pixels, measured=pixels.measured * [1.0, 1000.0 / 1024.0])
    cameras = [replace(camera, resolution=(1280, 1000)) for camera in overview.calibration.estimate.cameras]
    assert [(chart.x.high, chart.y.low) for chart in _magnitudes(low, cameras)] == [(1280.0, -1000.0)] * 2
    wide = pixels.measured.copy()
    first = np.flatnonzero(pixels.camera == 0)
    wide[first[: len(first) // 2], 0] += 1e4
    found = drawn(wide)
    share = 100.0 * (len(first) // 2) / len(first)
    assert found["magnitudes"].rows[0][0].title.endswith(f"; {share:.2g} % outside")
    assert "outside" not in found["magnitudes"].rows[0][1].title
    for name in ("fields", "magnitudes"):
        one, other = found[name].rows[0][:2]
        assert (one.x, one.y) == (other.x, other.y), "images of one size are in one scale"


@pytest.mark.no_cover
def test_where_a_lens_was_used_outside_of_the_image_it_has_an_uncertainty_too(simulated):
    session = simulated("elbow3r").session
    overview = Overview.of(calibrate(replace(session, estimate=replace(session.estimate, intrinsics="free"))))
    pixels = overview.scene.pixels
    inside = _projections(overview.scene, overview.calibration)
    assert [(chart.x.low, chart.y.high) for chart in inside] == [(0.0, 0.0)] * 2
    wide = pixels.measured.copy()
    wide[np.flatnonzero(pixels.camera == 0)[0]] = [-100.0, 1100.0]
    beyond = _projections(replace(overview.scene, pixels=replace(pixels, measured=wide)), overview.calibration)
    assert all(chart.x.low <= -100.0 and chart.x.high == inside[0].x.high for chart in beyond)
    cells, _ = beyond[1].marks
    assert all(chart.y.low <= -1100.0 + cells.size / 2 and chart.y.high == 0.0 for chart in beyond)
    assert inside[0].y.low > -1100.0 + cells.size / 2
    assert np.min(cells.x) < -90.0


def test_tolerances_stand_beside_the_corrections(calibration):
    for chart in parameter_charts(calibration):
        marks = {mark.name: mark for mark in chart.marks}
        widest = np.abs(marks["tolerances"].x).max()
        assert widest == pytest.approx(1.0 if chart.name == "lengths" else 5.0)


@pytest.mark.parametrize("shape", [
    Shape("box", (0.2, 0.4, 0.6), np.eye(4)),
    Shape("cylinder", (0.1, 0.5), np.eye(4)),
    Shape("sphere", (0.3,), np.eye(4)),
])  # fmt: skip
def test_shapes_have_surfaces_of_their_size(shape):
    found = triangles(shape).reshape(-1, 3)
    size = {"box": shape.size, "cylinder": (2 * shape.size[0],) * 2 + shape.size[-1:], "sphere": (0.6,) * 3}[shape.kind]
    np.testing.assert_allclose(np.ptp(found, axis=0), size, rtol=0.06)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=0.02)


def test_an_arm_with_meshes_has_its_picture_with_rods_for_those_that_cannot_be_read(monkeypatch):
    import cv2

    ur5 = calibrate(simulate(read_rig(find_rig("ur5")), seed=1, poses=15).session, force=True)
    overview = Overview.of(ur5)

    def drawn() -> np.ndarray:
        data = np.frombuffer(base64.b64decode(portrait(overview)), np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)

    picture = drawn()
    assert max(picture.shape[:2]) == pytest.approx(480, abs=3)
    opaque = picture[..., 3] > 128
    assert 0.02 < opaque.mean() < 0.6
    grey = opaque & (np.ptp(picture[..., :3], axis=2) < 40)
    assert grey.mean() > 0.01, "the arm, not only the LEDs"

    def ends_alone(shape):
        unread = shape.mesh is not None and shape.mesh.stem in ("upperarm", "forearm")
        return np.zeros((0, 3, 3)) if unread else triangles(shape)

    monkeypatch.setattr("urdfcal.output.portrait.triangles", ends_alone)
    arm = (drawn()[..., 3] > 128).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(arm)
    before = cv2.connectedComponentsWithStats(opaque.astype(np.uint8))[2]
    tallest, whole = (max(of[1:, cv2.CC_STAT_HEIGHT]) for of in (stats, before))
    assert tallest > 0.8 * whole, "no hand hangs in the air"
    monkeypatch.setattr("urdfcal.output.portrait._MOST_TRIANGLES", 500)
    _, _, stats, _ = cv2.connectedComponentsWithStats((drawn()[..., 3] > 128).astype(np.uint8))
    assert max(stats[1:, cv2.CC_STAT_HEIGHT]) > 0.6 * whole, "an arm of too fine meshes is drawn by rods"


def test_the_page_needs_nothing_else(path, page):
    assert "script" not in {tag for tag, _ in page.elements}
    assert [link for link in page.links if not link.startswith(("#", "data:"))] == []
    assert "http" not in re.sub(r'xmlns(:\w+)?="[^"]*"', "", path.read_text()).replace("http-equiv", "")
    assert "url(" not in re.sub(r"url\(#\w+\)", "", path.read_text())


def test_figures_are_well_formed_and_without_clashing_ids(calibration, path):
    drawn = re.findall(r"<svg.*?</svg>", path.read_text(), flags=re.DOTALL)
    assert len(drawn) == sum(len(row) for of in figures(Overview.of(calibration)).values() for row in of.rows)
    definitions = {}
    for figure in drawn:
        for element in ElementTree.fromstring(figure).iter():  # noqa: S314  # our own
            if name := element.get("id"):
                content = ElementTree.tostring(element)
                assert definitions.setdefault(name, content) == content


def test_a_wrong_lens_does_not_get_a_good_verdict(tmp_path):
    session = a_session(lens=1.02)
    doubtful = calibrate(replace(session, estimate=Estimate("dh", "fixed")), force=True)
    assert doubtful.assessment.level == "bad"
    write_report(tmp_path / "report.html", Overview.of(doubtful))
    page = Page((tmp_path / "report.html").read_text())
    assert ("section", "verdict bad") in page.elements
    for sentence in (doubtful.assessment.sentence, *doubtful.assessment.reasons):
        assert page.text.count(sentence) == 1


@pytest.mark.no_cover
def test_a_clean_session_gets_a_good_verdict_and_a_warning_makes_it_doubtful():
    session = a_session("ur5", outlier=False)
    assert calibrate(session).assessment.level == "good"
    found = calibrate(replace(session, warnings=("joint E never moves",))).assessment
    assert (found.level, found.reasons) == ("doubtful", ("joint E never moves",))


def test_held_out_figures_are_the_headline_with_their_interval(calibration, tmp_path):
    validation = {
        "folds": 5,
        "rms_nominal_mm": 1.5,
        "rms_mm": 0.25,
        "max_mm": 0.5,
        "p95_mm": 0.4,
        "interval_mm": [0.2, 0.3],
    }
    overview = Overview.of(calibration)
    document = {**overview.document, "validation": validation}
    assert headline(document) == "1.5 -> 0.25 mm"
    overview = replace(overview, document=document)
    write_report(tmp_path / "report.html", overview)
    page = Page((tmp_path / "report.html").read_text())
    assert "1.5 → 0.25 mm (95 %: 0.2 to 0.3 )" in page.text
    assert "held-out poses, 95 % below" in page.text


@pytest.mark.no_cover
def test_names_are_text_and_no_markup(tmp_path):
    session = a_session()
    leds = tuple(replace(led, name="<b>&") for led in session.leds)
    write_report(tmp_path / "report.html", Overview.of(calibrate(replace(session, leds=leds))))
    text = (tmp_path / "report.html").read_text()
    assert "<b>&<" not in text
    assert "&lt;b&gt;&amp;" in text


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_browser_shows_it_without_errors_or_requests(path, tmp_path):
    log, net = tmp_path / "log.txt", tmp_path / "net.json"
    ended = subprocess.run(
        [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'home'}",
            "--enable-logging=stderr", "--v=0", f"--log-net-log={net}", "--disable-background-networking",
            "--disable-component-update", f"--screenshot={tmp_path / 'page.png'}", "--window-size=1280,2000",
            path.as_uri(),
        ],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    log.write_text(ended.stderr)
    assert (tmp_path / "page.png").stat().st_size > 20_000
    assert "CONSOLE" not in ended.stderr, ended.stderr
    assert requested(net) == set()


@pytest.mark.no_cover
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_on_a_telephone_nothing_runs_off_the_page_and_dark_is_dark(path, tmp_path):
    import cv2

    browser = Browser(tmp_path / "home")
    try:
        browser.open(path.as_uri())
        browser.emulate(400, dark=True)
        assert browser.content_width() == 400
        picture = cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
        for width in (400, 1280):  # a table of many rows is wider than the page on any screen
            browser.emulate(width, dark=True)
            assert browser.style(".wide", "backgroundImage").count("gradient") == 4
    finally:
        browser.close()
    assert np.median(picture) < 60


def requested(net):
    """Hosts of the requests in Chromium's own log, those of the browser's housekeeping left out."""
    text = net.read_text()
    hosts = set(re.findall(r'"url":"(https?://[^/"]+)', text))
    return {host for host in hosts if not re.search(r"google|gvt1|chromium", host)}


@pytest.mark.no_cover
def test_a_nominal_arm_that_is_kept_has_a_report_too(tmp_path):
    """Its error against itself is zero everywhere, and there is nothing to correct."""
    session = replace(simulate(read_rig(find_rig("elbow3r")), seed=1, poses=12).session, estimate=Estimate("none"))
    kept = calibrate(session, force=True)
    write_report(tmp_path / "report.html", Overview.of(kept))
    page = (tmp_path / "report.html").read_text()
    assert "Corrections with 95 % intervals" not in page
    assert not re.search(r"\bnan\b", page, re.IGNORECASE)
