"""One camera: a pinhole behind a lens, with the derivatives that calibration needs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from urdfcal.arrays import Bools, Floats, frozen
from urdfcal.cameras.lens import COEFFICIENTS, LENGTHS, Lens
from urdfcal.errors import CameraError

# A focal length of 5 % of the image's longer side means a half field of view of 84°. In pixels every lens is
# above (a 180° fisheye has 32 %); in millimetres or multiples of the image's width it is below (16 mm on
# 640 px is 2.5 %).
_SHORTEST_FOCAL = 0.05
# Within 1 % of the corner in both directions: 6.4 mm on 1280 px is 0.5 %, half a width is 0.04 %, an offset
# from the image's centre is near 0. Even a cropped image's axis has no reason to meet the corner so closely.
_CORNER = 0.01
# Strongly cropped images have their principal point outside; half an image away is beyond any of them.
_OUTSIDE = 0.5
# A twentieth of a degree across the image.
_LONGEST_FOCAL = 1000.0
# The narrower the view, the larger the coefficients that still bend something: thousands at five degrees.
_LARGEST = 1e6
# A rolling shutter reads 480 to 4,000 rows in 5 to 50 ms. [s]
_LONGEST_LINE = 1e-3
# Interlaced and anamorphic sensors reach 2:1.
_PIXEL_ASPECT = 3.0


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: frame with z forward, x right, y down; (0, 0) is the centre of the top-left pixel.

    Attributes:
        name: the camera's name in the session.
        resolution: (width, height) in px.
        intrinsics: (4,) fx, fy, cx, cy in px.
        distortion_model: "radtan", "equidistant" or "none".
        distortion: (k,) as in OpenCV and Kalibr: radtan k1 k2 p1 p2 [k3], equidistant k1 k2 k3 k4.
        line_time: how much later each row of an image is taken than the one above; 0 of a global shutter. [s]
        line_time_sigma: how well that is known; 0 exactly. [s]

    Raises:
        CameraError: the values are not those of a camera, or look like millimetres or normalised ones.
    """

    name: str
    resolution: tuple[int, int]
    intrinsics: Floats
    distortion_model: str = "none"
    distortion: Floats = field(default_factory=lambda: np.zeros(0))
    line_time: float = 0.0
    line_time_sigma: float = 0.0
    _lens: Lens = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name.strip():
            raise CameraError(f"a camera is named {self.name!r}", remedy="Give every camera a name.")
        whole, sides = (int, np.integer), tuple(self.resolution)
        if len(sides) != 2 or not all(isinstance(s, whole) and not isinstance(s, bool) and s > 0 for s in sides):
            raise self._error(f"resolution {list(sides)} is not [width, height] in whole positive pixels")
        object.__setattr__(self, "resolution", (int(sides[0]), int(sides[1])))
        object.__setattr__(self, "intrinsics", self._numbers("intrinsics", self.intrinsics))
        object.__setattr__(self, "distortion", self._numbers("distortion", self.distortion))
        self._check_lens()
        self._check_pinhole()
        self._check_shutter()
        object.__setattr__(self, "_lens", Lens.from_coefficients(self.distortion_model, self.distortion))

    @property
    def rolling(self) -> bool:
        """Whether its rows are taken one after the other, or may be."""
        return self.line_time != 0.0 or self.line_time_sigma > 0.0

    @property
    def parameters(self) -> Floats:
        """(4 + k,) intrinsics, then distortion coefficients."""
        return frozen(np.concatenate([self.intrinsics, self.distortion]))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of :attr:`parameters`: fx, fy, cx, cy, k1, ..."""
        return ("fx", "fy", "cx", "cy", *COEFFICIENTS[self.distortion_model][: len(self.distortion)])

    @property
    def matrix(self) -> Floats:
        """(3, 3) camera matrix, px."""
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def with_parameters(self, values: Floats) -> Camera:
        """The same camera with other :attr:`parameters`, ``values`` (4 + k,).

        Raises:
            CameraError: the values are not those of a camera.
        """
        values = np.asarray(values, dtype=np.float64)
        if values.shape != self.parameters.shape:
            expected = len(self.parameters)
            raise self._error(f"{expected} parameters are needed, the array's shape is {values.shape}")
        return replace(self, intrinsics=values[:4], distortion=values[4:])

    def project(self, points: Floats) -> Floats:
        """Pixels of ``points`` (..., 3) in the camera frame (m) -> (..., 2) px.

        NaN where a point is at or behind the camera, or beyond the angle up to which the lens model is
        one-to-one: past it the polynomial turns back, and things far out of view would appear in the image.
        """
        xy, hidden = self._onto_plane(np.asarray(points, dtype=np.float64))
        uv = self._lens.distort(xy) * self.intrinsics[:2] + self.intrinsics[2:]
        uv[hidden] = np.nan
        return uv

    def project_with_jacobian(self, points: Floats) -> tuple[Floats, Floats]:
        """:meth:`project` and its derivative wrt the points: (..., 2) px and (..., 2, 3) px/m."""
        return self._linearised(points)[:2]

    def project_with_derivatives(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """:meth:`project` with all its derivatives.

        Args:
            points: (..., 3) in the camera frame, m.

        Returns:
            uv (..., 2) px, d_uv/d_point (..., 2, 3) px/m and d_uv/d_parameters (..., 2, 4 + k), its columns
            in the order of :attr:`parameters`. All NaN where :meth:`project` is.
        """
        uv, J_point, xy, hidden, distorted = self._linearised(points)
        J_parameters = np.zeros((*uv.shape, 4 + len(self.distortion)))
        J_parameters[..., 0, 0] = distorted[..., 0]
        J_parameters[..., 1, 1] = distorted[..., 1]
        J_parameters[..., 0, 2] = J_parameters[..., 1, 3] = 1.0
        J_parameters[..., 4:] = self._lens.coefficient_jacobian(xy) * self.intrinsics[:2, None]
        J_parameters[hidden] = np.nan
        return uv, J_point, J_parameters

    def unproject(self, uv: Floats) -> Floats:
        """Rays through pixels ``uv`` (..., 2) -> (..., 3) in the camera frame, with z = 1.

        NaN where ``uv`` is NaN or no ray within the lens model's one-to-one range meets that pixel.
        """
        uv = np.asarray(uv, dtype=np.float64)
        rays = np.ones((*uv.shape[:-1], 3))
        rays[..., :2] = self._lens.undistort((uv - self.intrinsics[2:]) / self.intrinsics[:2])
        rays[np.isnan(rays[..., 0])] = np.nan
        return rays

    def in_image(self, uv: Floats, margin: float = 0.0) -> Bools:
        """Which of ``uv`` (..., 2) lie in the image, at least ``margin`` px from its border; NaN does not."""
        inside = (uv >= margin - 0.5) & (uv <= np.array(self.resolution) - 0.5 - margin)
        return np.asarray(inside.all(axis=-1))

    def _onto_plane(self, points: Floats) -> tuple[Floats, Bools]:
        """Normalised (x, y), zero where the camera cannot see the point, and the mask of those points."""
        with np.errstate(all="ignore"):
            xy = points[..., :2] / points[..., 2:]
            within = np.hypot(xy[..., 0], xy[..., 1]) <= self._lens.radius
        hidden = ~(within & (points[..., 2] > 0.0) & np.isfinite(points[..., 2]))
        xy[hidden] = 0.0
        return xy, hidden

    def _linearised(self, points: Floats) -> tuple[Floats, Floats, Floats, Bools, Floats]:
        """Pixels, their derivative wrt the points, (x, y), which of them are hidden, and what the lens makes of it."""
        points = np.asarray(points, dtype=np.float64)
        xy, hidden = self._onto_plane(points)
        distorted, J_lens = self._lens.distort_with_jacobian(xy)
        focal = self.intrinsics[:2]
        uv = distorted * focal + self.intrinsics[2:]
        # d(x, y)/d(X, Y, Z) = [1 | -(x, y)] / Z
        J = np.empty((*uv.shape, 3))
        J[..., :2] = J_lens
        J[..., 2] = -(J_lens[..., 0] * xy[..., :1] + J_lens[..., 1] * xy[..., 1:])
        J *= (focal / np.where(hidden, 1.0, points[..., 2])[..., None])[..., None]
        uv[hidden] = np.nan
        J[hidden] = np.nan
        return uv, J, xy, hidden, distorted

    def _error(self, what: str, remedy: str = "") -> CameraError:
        return CameraError(what, where=f"camera '{self.name}'", remedy=remedy)

    def _numbers(self, what: str, values: Floats) -> Floats:
        try:
            array = frozen(values)
        except (TypeError, ValueError):
            array = frozen(np.nan)
        if array.ndim != 1 or not np.isfinite(array).all():
            shown = values.tolist() if isinstance(values, np.ndarray) else values
            raise self._error(f"{what} {shown} must be a list of finite numbers")
        return array

    def _check_lens(self) -> None:
        if self.distortion_model not in LENGTHS:
            remedy = f"Use one of: {', '.join(LENGTHS)}."
            raise self._error(f"distortion model '{self.distortion_model}' is not known", remedy)
        names, given = COEFFICIENTS[self.distortion_model], len(self.distortion)
        if given not in LENGTHS[self.distortion_model]:
            count = " or ".join(map(str, LENGTHS[self.distortion_model]))
            what = f"{self.distortion_model} distortion takes {count} coefficients, {given} are given"
            raise self._error(what, f"Their order is {' '.join(names)}." if names else "")
        if given and np.abs(self.distortion).max() > _LARGEST:
            what = f"a distortion coefficient is {self.distortion[np.abs(self.distortion).argmax()]:g}"
            raise self._error(f"{what}: no lens bends rays so far", f"Their order is {' '.join(names)}.")

    def _check_shutter(self) -> None:
        if not (abs(self.line_time) < _LONGEST_LINE and 0.0 <= self.line_time_sigma < _LONGEST_LINE):
            what = f"line_time {self.line_time:g} +- {self.line_time_sigma:g} s is no time from one row to the next"
            raise self._error(what, "It is in seconds: 2.1e-5 of 1080 rows in 23 ms.")

    def _check_pinhole(self) -> None:
        if len(self.intrinsics) != 4:
            raise self._error(f"intrinsics need the 4 numbers fx fy cx cy, {len(self.intrinsics)} are given")
        focal, centre, size = self.intrinsics[:2], self.intrinsics[2:], np.array(self.resolution, dtype=float)
        image = f"the {self.resolution[0]} x {self.resolution[1]} image"
        if (focal <= 0.0).any():
            raise self._error(f"focal length {_pair(focal)} px must be positive")
        if (focal < _SHORTEST_FOCAL * size.max()).any():
            what = f"focal length {_pair(focal)} px is too short for {image}; it looks like millimetres or normalised"
            raise self._error(what, "Give it in pixels: millimetres divided by the pixel pitch.")
        if (focal > _LONGEST_FOCAL * size.max()).any():
            what = f"focal length {_pair(focal)} px is a telescope's for {image}"
            raise self._error(what, "Give it in pixels: millimetres divided by the pixel pitch.")
        if focal.max() > _PIXEL_ASPECT * focal.min():
            remedy = "The order is fx fy cx cy."
            raise self._error(f"focal lengths {_pair(focal)} px differ by more than a factor {_PIXEL_ASPECT:g}", remedy)
        if (np.abs(centre) <= _CORNER * size).all():
            raise self._error(
                f"principal point {_pair(centre)} px lies in the corner of {image}; "
                "it looks like millimetres, normalised, or an offset from the image's centre",
                "Give it in pixels from the top-left pixel.",
            )
        if ((centre < -_OUTSIDE * size) | (centre > (1.0 + _OUTSIDE) * size)).any():
            remedy = "Check the resolution [width, height] and the order fx fy cx cy."
            raise self._error(f"principal point {_pair(centre)} px lies far outside {image}", remedy)


def _pair(values: Floats) -> str:
    return f"({values[0]:g}, {values[1]:g})"
