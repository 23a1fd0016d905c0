"""Which lights of a camera's images are where the arm holds the LED."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from urdfcal.detection.prediction import FEWEST, Lights, predict
from urdfcal.detection.spots.again import Expected, look_again
from urdfcal.detection.spots.gaussian import Rows
from urdfcal.images.files import Video

if TYPE_CHECKING:
    from urdfcal.arrays import Bools, Floats, Ints
    from urdfcal.cameras.camera import Camera
    from urdfcal.detection.led_frames import LedFrames
    from urdfcal.detection.prediction import Prediction
    from urdfcal.detection.spots.detector import Spots
    from urdfcal.images.files import Colour, ImageSequence

# A reflection now and then outshines an LED whose link is right; of one on another link, next to none agree.
_ASTRAY = 0.1
# Nearer than this the arm must tell where the LED is for a second look: what looks like one is not a hand away. [px]
_NEAR = 40.0


@dataclass(frozen=True, eq=False)
class Shown:
    """The P images that a camera took of LEDs.

    Attributes:
        camera: its lens.
        images: of it.
        frames: which LED each shows, and how the arm as drawn holds it.
        stretch: (P,) the same number between moves of the camera, the base or an LED.
        colour: of the LEDs.
    """

    camera: Camera
    images: ImageSequence
    frames: LedFrames
    stretch: Ints
    colour: Colour

    def held(self, seen: Spots) -> tuple[Spots, list[str]]:
        """Reject what is not where the arm holds the LED, look again where it should be, and say what does not show.

        Raises:
            CameraError: an image cannot be read.
        """
        frames = self.frames
        names = [led.name for led in frames.leds]
        warnings = [
            f"camera {self.camera.name!r}: the arm does not tell where LED {names[i]!r} is: it stands in the world"
            for i in np.unique(frames.led[~frames.known])
        ]
        parts = []
        for stretch in np.unique(self.stretch) if frames.known.any() else ():
            mine = self.stretch == stretch
            judged, said = self._held(seen[mine[seen.image]], mine)
            parts.append(judged)
            warnings += said
        if not parts:
            return seen, warnings
        joined = Rows.join(parts)
        return replace(joined[np.argsort(joined.image, kind="stable")], still=seen.still), list(dict.fromkeys(warnings))

    def _held(self, seen: Spots, mine: Bools) -> tuple[Spots, list[str]]:
        """The lights of images (P,) between two moves."""
        camera, frames = self.camera, self.frames
        told = frames.known[seen.image]
        lights = Lights(seen.image, seen.fits.uv, seen.fits.flux)
        prediction = predict(camera, frames.leds, frames.T_mount_link, frames.led, lights[seen.good & told])
        if prediction is None:
            said = (
                f"camera {camera.name!r}: the arm did not help to tell the LED from other lights: "
                "too few images show it, or they disagree with the arm"
            )
            return seen, [said]
        misses, near = prediction.misses(lights), prediction.near(lights)
        far = np.array([f"{miss:.0f} px from where the arm holds the LED" for miss in misses], dtype=object)
        far[np.isinf(misses)] = "the arm holds the LED out of this camera's sight"
        judged = seen.rejected(told & ~near, far)
        again = self._again(judged, prediction, mine)
        return Rows.join([judged, *again]), self._astray(seen, near)

    def _astray(self, seen: Spots, near: Bools) -> list[str]:
        """LEDs that next to no image shows where the arm holds them."""
        frames, warnings = self.frames, []
        for i in np.unique(frames.led[frames.known]):
            of = seen.good & (frames.led[seen.image] == i)
            lit, agreeing = (np.unique(seen.image[rows]).size for rows in (of, of & near))
            if lit >= FEWEST and agreeing < _ASTRAY * lit:
                link = f"link {frames.leds[i].link!r}" if frames.leds[i].link else "the tip link"
                warnings.append(
                    f"camera {self.camera.name!r}: {agreeing} of {lit} images show a light where the arm holds LED "
                    f"{frames.leds[i].name!r}: is it on {link}, and are the images named after the LED that is lit?"
                )
        return warnings

    def _again(self, judged: Spots, prediction: Prediction, mine: Bools) -> list[Spots]:
        """What a second look finds in images that show no LED where it should be; a video is not looked at twice."""
        fits = judged.fits[judged.good]
        without = np.setdiff1d(np.flatnonzero(mine & self.frames.known), judged.image[judged.good])
        uv: Floats = prediction.uv[without]
        gate = prediction.gate[without]
        without = without[np.isfinite(uv[:, 0]) & self.camera.in_image(uv) & (gate < _NEAR)]
        if len(fits) < FEWEST or not len(without) or isinstance(self.images, Video):
            return []
        width, flux = float(np.median(fits.width)), float(np.median(fits.flux))
        expected = Expected(without, prediction.uv[without], prediction.gate[without], width, flux)
        found = look_again(self.images, self.camera.resolution, self.colour, self.frames.places, expected)
        return [found[prediction.near(Lights(found.image, found.fits.uv, found.fits.flux))]]
