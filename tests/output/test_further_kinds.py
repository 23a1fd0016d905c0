"""Kinds of measurement and joint models that nobody has written yet, through to the result folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from urdfcal.estimation.blocks.base import VectorBlock
from urdfcal.estimation.blocks.base_pose import BASE
from urdfcal.estimation.measurements import Measurement
from urdfcal.estimation.measurements.base import BlockSet, ByFrame
from urdfcal.estimation.measurements.point_geometry import by_frames, led_points, put_leds, seen_from
from urdfcal.estimation.state import Key
from urdfcal.output.findings import Overview
from urdfcal.output.recording import write_results
from urdfcal.pipeline import calibrate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from urdfcal.arrays import Floats, Ints
    from urdfcal.estimation.linearize import Jacobian
    from urdfcal.estimation.links import Links
    from urdfcal.estimation.observations import Observations
    from urdfcal.estimation.start import Start
    from urdfcal.estimation.state import State

HEIGHT: Key[np.ndarray] = Key("table")


@dataclass(frozen=True, eq=False)
class Heights(Measurement):
    """How far LEDs are above a table whose height in the world is unknown: one number, in micrometres."""

    kind: ClassVar[str] = "heights"
    keys: ClassVar[tuple[str, ...]] = ("pose", "led")
    dimension: ClassVar[int] = 1
    columns: ClassVar[tuple[str, ...]] = ("height",)
    array: ClassVar[str] = "height"
    noise: ClassVar[str] = "height"
    usual: ClassVar[float] = 1e-5
    unit: ClassVar[str] = "m"
    report: ClassVar[tuple[str, float]] = ("um", 1e6)

    led: Ints
    height: Floats
    sigma: Floats

    def predict(self, observed: Observations, links: Links, state: State) -> Floats:
        _, p_base = led_points(observed, links, state)
        return seen_from(links, p_base, np.zeros_like(observed.row))[..., 2:] - state[HEIGHT]

    def linearise(self, observed: Observations, links: Links, state: State, J: Jacobian) -> ByFrame:
        lever, p_base = led_points(observed, links, state)
        world = np.zeros_like(observed.row)
        E = np.broadcast_to(state[BASE][2:3, :3], (world.size, 1, 3)).copy()
        E[~observed.valid.ravel()] = 0.0
        put_leds(J, observed, links, E, lever, state)
        J.put(HEIGHT, -np.broadcast_to(observed.valid.reshape(-1, 1, 1), (world.size, 1, 1)).astype(float))
        led_frame = links.attachments.led[observed.index["led"]]
        return ByFrame(self.predict(observed, links, state), by_frames(links, E, lever, p_base, led_frame, world))

    def blocks(self, *_: object) -> BlockSet:
        block = VectorBlock(HEIGHT, ("table.height",), ("m",), np.array([1.0]), np.array([0.1]), "the table's height")
        return BlockSet((block,))

    def start(self, at: Start, state: State) -> State:
        del at
        return state.replace({HEIGHT: np.array([1.0])})


def test_one_number_in_its_own_unit_reaches_document_report_and_recording(simulated: Callable, tmp_path: Path) -> None:
    session = simulated("ur5", poses=20).session
    height = np.random.default_rng(0).normal(0.2, 1e-5, (20, 1))
    table = Heights(np.arange(20), np.zeros(20, dtype=int), height, np.array(1.0))  # it weighs next to nothing
    calibration = calibrate(replace(session, measurements=(*session.measurements, table)), force=True)
    paths, _ = write_results(calibration, tmp_path / "out", Overview.of(calibration))
    data = json.loads((tmp_path / "out" / "calibration.json").read_text())
    pixels, heights = data["fit"]["residuals"]
    assert (pixels["kind"], pixels["unit"]) == ("detections", "px")
    assert pixels["rms"] == data["fit"]["rms_px"]
    assert (heights["kind"], heights["unit"]) == ("heights", "um")
    assert heights["rms"] > 1e3
    assert 0.0 < data["fit"]["rms_mm"] < 1.0  # of points in space, not of heights
    (entry,) = data["parameters"]
    assert entry["name"] == "table.height"
    assert entry["nominal"] == 1.0
    report = next(path for path in paths if path.suffix == ".html").read_text()
    assert "residual, heights, rms [um]" in report
    assert "table.height" in report
    assert next(path for path in paths if path.suffix == ".rrd").stat().st_size > 0
