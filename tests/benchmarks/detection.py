"""How well LEDs are found in images: accuracy against the Cramer-Rao bound, wrong and missed detections, speed.

    python tests/benchmarks/detection.py [accuracy] [bias] [detections] [light] [dim] [speed] [whole]
        [--count 400] [--poses 250]

- accuracy: rms error of rendered spots over width, peak, depth of the pixels and saturation, with the bound (all of
  peak, width, background and its slope unknown), and what share of them was not found at all;
- bias: mean error over the pixel grid, 9 x 9 places;
- detections: a simulated UR5 before two cameras, with lamps, reflections, hot pixels, streaks and a hidden LED; a
  detection is wrong if it is off by more than 0.5 px and 6 sigma, or the LED was not to be seen;
- light: the same with an arm of 0.6 of white;
- dim: without any of that, an LED of 30, 60 and 120 electrons at its peak, 3 to 12 counts;
- speed: 200 images, against a loop that reads each with OpenCV, thresholds it and labels connected components; by the
  clock, and in the processor's time, which other programs disturb less;
- whole: tip error of a calibration from images, against one from ideal centroids with the same sigmas.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.centroid_bound import centroid_bound
from urdfcal.detection.detect import detect
from urdfcal.detection.spots.centroid import HALF, Crops, fit_spots
from urdfcal.estimation.evaluation import compare
from urdfcal.io.folder import read_rig
from urdfcal.io.shipped_rigs import find_rig
from urdfcal.pipeline import calibrate
from urdfcal.simulation.images import TRUTH, Exposure, write_simulated_images
from urdfcal.simulation.render import Light, Scenery, Sensor
from urdfcal.simulation.simulate import simulate

SIDE = 2 * HALF + 1
BACKGROUND = 15.0


def crops_of(sensor: Sensor, peak: float, sigma: float, places: np.ndarray, rng: np.random.Generator) -> Crops:
    """One rendered crop for each place (n, 2), relative to its middle pixel."""
    scenery = Scenery.flat((SIDE, SIDE), BACKGROUND, (0.1, -0.05))
    values = np.array([sensor.expose(scenery.expected([Light(HALF + p, peak, sigma)]), rng) for p in places])
    return Crops(
        np.zeros((len(places), 2), dtype=np.intp),
        values.astype(np.float32),
        np.ones(values.shape, dtype=bool),
        values >= sensor.white,
    )


def sensor_for(peak: float, bits: int, saturated: float) -> Sensor:
    """A sensor whose range ends 1.3 times above the peak, or ``saturated`` times below it."""
    full = (peak + BACKGROUND) * 1.3 if not saturated else peak / saturated
    return Sensor((SIDE, SIDE), bits, full / (2**bits - 5.0), black=4.0)


def accuracy(count: int) -> None:
    print("bits  sigma  peak  saturated     rms    bound  rms/bound  error/claimed  not found")
    rng = np.random.default_rng(0)
    worst = 0.0
    for bits in (8, 16):
        for sigma in (1.0, 1.5, 2.0, 3.0):
            for peak, saturated in ((40, 0), (100, 0), (400, 0), (4000, 0), (4000, 2), (4000, 4)):
                sensor = sensor_for(peak, bits, saturated)
                places = rng.uniform(-0.5, 0.5, (count, 2))
                fits = fit_spots(crops_of(sensor, peak, sigma, places, rng))
                found = fits.found & (fits.significance > 5.0)
                error = (fits.uv - places)[found]
                rms = np.sqrt(np.mean(error**2))
                bounds = [centroid_bound(sensor, Light(p, peak, sigma), BACKGROUND) for p in places[:8]]
                bound = np.sqrt(np.mean(np.square(bounds)))
                claimed = np.sqrt(np.mean((error / fits.sigma[found, None]) ** 2))
                worst = max(worst, rms / bound if not saturated else 0.0)
                print(
                    f"{bits:4}  {sigma:5.1f} {peak:5}  {saturated or '':>9}  {rms:.4f}   {bound:.4f}"
                    f"  {rms / bound:9.2f}  {claimed:13.2f}  {1.0 - found.mean():9.1%}"
                )
    print(f"worst rms/bound where unsaturated: {worst:.3f}")


def bias(count: int) -> None:
    print("sigma  saturated  largest mean error (px) of 9 x 9 places in the pixel  its standard error")
    rng = np.random.default_rng(1)
    grid = np.linspace(-0.5, 0.5, 9)
    places = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    for sigma in (0.7, 1.0, 1.5, 2.0, 3.0):
        for saturated in (0, 4):
            sensor = sensor_for(4000.0, 8, saturated)
            many = np.repeat(places, count // 8, axis=0)
            fits = fit_spots(crops_of(sensor, 4000.0, sigma, many, rng))
            error = (fits.uv - many).reshape(len(places), -1, 2)
            spread = np.max(error.std(axis=1)) / np.sqrt(error.shape[1])
            print(f"{sigma:5.1f}  {saturated or '':>9}  {np.abs(error.mean(axis=1)).max():.4f}  {spread:.4f}")


def detections(folder: Path, poses: int, rigs: list[str], exposure: Exposure) -> None:
    for rig in rigs:
        session = folder / f"{rig} {exposure.peak:g} {exposure.arm:g}"
        simulated = simulate(read_rig(find_rig(rig)), poses=poses, seed=1)
        write_simulated_images(session, simulated, exposure)
        detected = detect(session)
        with (session / TRUTH).open() as file:
            truth = {
                (row["pose"], row["camera"], row["led"]): np.array([float(row["u"]), float(row["v"])])
                for row in csv.DictReader(file)
            }
        found, positions = detected.detections, detected.positions
        wrong, errors, right = 0, [], set()
        for pose, camera, led, uv, sigma in zip(
            found.pose, found.camera, found.led, found.uv, found.sigma, strict=True
        ):
            key = positions.poses[pose], positions.rig.names[camera], positions.led_names[led]
            off = np.linalg.norm(uv - truth[key]) if key in truth else np.inf
            if off > max(0.5, 6.0 * sigma):
                wrong += 1
            else:
                right.add(key)
                errors.append((uv - truth[key]) / sigma)
        missed = len(truth) - len(right)
        print(
            f"{rig}: {detected.index.count} images, LED to be found in {len(truth)}: {len(found)} detections, "
            f"{wrong} wrong, {missed} missed ({missed / len(truth):.2%}), "
            f"error/claimed {np.sqrt(np.mean(np.square(errors))):.2f}"
        )
        print(f"  rejected: {detected.summary()}")
        for warning in detected.warnings:
            print(f"  {warning}")


def whole(folder: Path, poses: int, seeds: int) -> None:
    """Tip error of a calibration from images, against one from ideal centroids of the sigmas that were claimed."""
    rows = []
    for seed in range(seeds):
        simulated = simulate(read_rig(find_rig("ur5")), poses=poses, seed=seed)
        session = folder / f"whole{seed}"
        write_simulated_images(session, simulated, Exposure())
        seen = detect(session).detections
        with (session / TRUTH).open() as file:
            truth = {(r["pose"], r["camera"]): (float(r["u"]), float(r["v"])) for r in csv.DictReader(file)}
        of = simulated.session
        places = [truth[of.poses[p], of.rig.names[c]] for p, c in zip(seen.pose, seen.camera, strict=True)]
        noise = seen.sigma[:, None] * np.random.default_rng(seed + 1000).standard_normal(seen.uv.shape)
        errors = []
        for detections in (seen, replace(seen, uv=np.array(places) + noise)):
            calibration = calibrate(replace(of, measurements=(detections,)))
            nominal = calibration.chain
            q = nominal.random_values(500, np.random.default_rng(seed))
            true, built = (nominal.with_placements(M) for M in (simulated.truth.placements, calibration.placements))
            errors.append(1e3 * np.sqrt(np.mean(compare(built, true, q).position ** 2)))
        rows.append(errors)
        print(f"seed {seed}: {errors[0]:.4f} mm from images, {errors[1]:.4f} mm from ideal centroids", flush=True)
    images, ideal = np.sqrt(np.mean(np.square(rows), axis=0))
    print(f"rms over {seeds} seeds: {images:.4f} and {ideal:.4f} mm, ratio {images / ideal:.3f}")


def speed(folder: Path, distractors: bool) -> None:
    import cv2

    session = folder / f"speed{distractors}"
    simulated = simulate(read_rig(find_rig("ur5")), poses=100, seed=2)
    write_simulated_images(session, simulated, Exposure(distractors=distractors))
    paths = sorted((session / "images").glob("*/*.png"))
    for path in paths:  # into the system's cache, for both
        path.read_bytes()
    ratios = []
    for _ in range(3):
        marks = [(time.perf_counter(), time.process_time())]
        for path in paths:
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            _, above = cv2.threshold(image, 60, 255, cv2.THRESH_BINARY)
            cv2.connectedComponentsWithStats(above)
        marks.append((time.perf_counter(), time.process_time()))
        detect(session)
        marks.append((time.perf_counter(), time.process_time()))
        plain, ours = np.diff(marks, axis=0)
        ratios.append(ours / plain)
        print(
            f"{len(paths)} images: OpenCV {plain[0]:.2f} s, urdfcal {ours[0]:.2f} s, ratio {ratios[-1][0]:.2f}; "
            f"processor {plain[1]:.2f} s, {ours[1]:.2f} s, ratio {ratios[-1][1]:.2f}"
        )
    clock, processor = np.median(ratios, axis=0)
    print(f"{'with' if distractors else 'without'} distractors: median ratio {clock:.2f}, processor {processor:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="*", default=["accuracy", "bias", "detections", "light", "dim", "speed", "whole"])
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--poses", type=int, default=250)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rigs", nargs="*", default=["ur5"])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for what in arguments.what:
            print(f"== {what}")
            if what == "accuracy":
                accuracy(arguments.count)
            elif what == "bias":
                bias(arguments.count)
            elif what == "detections":
                detections(Path(folder), arguments.poses, arguments.rigs, Exposure(distractors=True))
            elif what == "light":
                detections(Path(folder), arguments.poses, arguments.rigs, Exposure(arm=0.6, distractors=True))
            elif what == "dim":
                for peak in (30.0, 60.0, 120.0):
                    detections(Path(folder), arguments.poses, arguments.rigs, Exposure(peak=peak))
            elif what == "whole":
                whole(Path(folder), 50, arguments.seeds)
            elif what == "speed":
                speed(Path(folder), distractors=False)
                speed(Path(folder), distractors=True)


if __name__ == "__main__":
    main()
