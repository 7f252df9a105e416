"""Projection models: five lenses behind one value class.

To add a lens: 1. write its compiled scalar kernels in ``lens_kernels.py`` and give it the next model number there;
2. add one line to ``LENSES``; 3. the contract tests of ``tests/unit/camera`` then run over it.

Contract: ``project`` maps points inside the valid field to pixels and everything else to NaN; ``unproject``
returns unit rays, iterated until the re-projected pixel agrees to 1e-10 px, and NaN where no ray exists;
pixel (0, 0) is the centre of the top-left pixel; parameters are ordered fx, fy, cx, cy, then the coefficients
in the order of the file format. The valid field ends where the radial map stops growing (found once per lens), and at
90 degrees for every lens but ``equidistant``, which may look behind itself.

On the axis ``fov`` takes the limit of its formula, 2 tan(w/2)/w, where Astrobee's code puts 1 for r_u <= 1e-5; the
difference is below 1e-3 px, within 0.01 px of the principal point, and without it the lens could not be inverted there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike

from uvgs_bench.camera import lens_kernels as kernels
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray, read_only


@dataclass(frozen=True, slots=True)
class LensModel:
    """One line of the lens table.

    Args:
        model_id: Number for the compiled kernels.
        coefficient_names: Names of the coefficients in the order of the file format.
    """

    model_id: int
    coefficient_names: tuple[str, ...]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all parameters, in order."""
        return ("fx", "fy", "cx", "cy", *self.coefficient_names)


_RADTAN = ("k1", "k2", "p1", "p2", "k3")
LENSES: dict[str, LensModel] = {
    "plumb_bob": LensModel(kernels.PLUMB_BOB, _RADTAN),
    "rational_polynomial": LensModel(kernels.RATIONAL_POLYNOMIAL, (*_RADTAN, "k4", "k5", "k6")),
    "thin_prism": LensModel(kernels.THIN_PRISM, (*_RADTAN, "k4", "k5", "k6", "s1", "s2", "s3", "s4")),
    "equidistant": LensModel(kernels.EQUIDISTANT, ("k1", "k2", "k3", "k4")),
    "fov": LensModel(kernels.FOV, ("w",)),
}


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """A projection model with its numbers: camera axes to raw pixels and back.

    Args:
        model: Key of ``LENSES``.
        width_px: Picture width, px.
        height_px: Picture height, px.
        parameters: fx, fy, cx, cy (px), then the coefficients of the model, shape (P,).

    Raises:
        CalibrationError: Unknown model, wrong number of parameters, a value that is not finite, a focal length or
            picture size that is not positive, or w of ``fov`` outside (0, pi).
    """

    model: str
    width_px: int
    height_px: int
    parameters: FloatArray
    kernel_parameters: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if self.model not in LENSES:
            raise CalibrationError(f"unknown lens model '{self.model}', expected one of {', '.join(LENSES)}")
        names = LENSES[self.model].parameter_names
        parameters = read_only(self.parameters)
        if parameters.shape != (len(names),):
            raise CalibrationError(f"a {self.model} lens has {len(names)} parameters, got shape {parameters.shape}")
        if not np.isfinite(parameters).all():
            raise CalibrationError(f"a {self.model} lens needs finite parameters, got {parameters.tolist()}")
        if not (parameters[0] > 0.0 and parameters[1] > 0.0 and self.width_px > 0 and self.height_px > 0):
            raise CalibrationError("focal lengths and picture size must be positive")
        if self.model == "fov" and not 0.0 < parameters[4] < pi:
            raise CalibrationError(f"the coefficient of a fov lens must be between 0 and pi rad, got {parameters[4]}")
        kernel_parameters = np.zeros(kernels.KERNEL_SIZE)
        kernel_parameters[: len(names)] = parameters
        kernel_parameters[kernels.LIMIT] = _limit(self.model_id, kernel_parameters)
        object.__setattr__(self, "parameters", parameters)
        object.__setattr__(self, "kernel_parameters", read_only(kernel_parameters))

    @property
    def model_id(self) -> int:
        """Number for the compiled kernels, which also want ``kernel_parameters``."""
        return LENSES[self.model].model_id

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of ``parameters``."""
        return LENSES[self.model].parameter_names

    @property
    def fx_px(self) -> float:
        """Focal length along columns, px."""
        return float(self.parameters[0])

    @property
    def fy_px(self) -> float:
        """Focal length along rows, px."""
        return float(self.parameters[1])

    @property
    def cx_px(self) -> float:
        """Column of the principal point, px."""
        return float(self.parameters[2])

    @property
    def cy_px(self) -> float:
        """Row of the principal point, px."""
        return float(self.parameters[3])

    @property
    def coefficients(self) -> FloatArray:
        """Distortion coefficients in the order of the file format."""
        return self.parameters[4:]

    @property
    def limit_rad(self) -> float:
        """Angle from the optical axis at which the valid field ends, rad."""
        limit = float(self.kernel_parameters[kernels.LIMIT])
        return limit if self.model == "equidistant" else float(np.arctan(limit))

    def camera_matrix(self) -> FloatArray:
        """Matrix K without skew, shape (3, 3), px."""
        fx, fy, cx, cy = self.parameters[:4]
        return read_only([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def with_parameters(self, parameters: ArrayLike) -> Lens:
        """The same model and picture size with other numbers, shape (P,). Raises CalibrationError as the class does."""
        return Lens(self.model, self.width_px, self.height_px, np.asarray(parameters, dtype=np.float64))

    def project(self, points_m: ArrayLike) -> FloatArray:
        """Raw pixels of points.

        Args:
            points_m: Points in camera axes, shape (N, 3) or (3,), m.

        Returns:
            Pixels, shape (N, 2), px; NaN outside the valid field.
        """
        return kernels.project_points(self.model_id, self.kernel_parameters, _rows(points_m, 3))

    def project_with_jacobians(self, points_m: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Raw pixels of points with their derivatives.

        Args:
            points_m: Points in camera axes, shape (N, 3) or (3,), m.

        Returns:
            Pixels (N, 2), px; derivative by the points (N, 2, 3), px/m; derivative by ``parameters`` (N, 2, P), px per
            unit of the parameter. NaN outside the valid field.
        """
        px, by_point, by_kernel = kernels.project_points_with_jacobians(
            self.model_id, self.kernel_parameters, _rows(points_m, 3)
        )
        return px, by_point, np.ascontiguousarray(by_kernel[:, :, : self.parameters.size])

    def unproject(self, px: ArrayLike) -> FloatArray:
        """Unit rays of raw pixels.

        Args:
            px: Pixels, shape (N, 2) or (2,), px.

        Returns:
            Unit vectors in camera axes, shape (N, 3); NaN where the lens has none.
        """
        return kernels.unproject_points(self.model_id, self.kernel_parameters, _rows(px, 2))

    def contains(self, px: ArrayLike, margin_px: float = 0.0) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Whether pixels lie inside the picture (which ends half a pixel beyond the outer pixel centres).

        Args:
            px: Pixels, shape (N, 2) or (2,), px; NaN lies outside.
            margin_px: Distance to keep from the edge, px.

        Returns:
            Flags, shape (N,).
        """
        u, v = _rows(px, 2).T
        low = margin_px - 0.5
        inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
            (u >= low) & (u <= self.width_px - 1.0 - low) & (v >= low) & (v <= self.height_px - 1.0 - low)
        )
        return inside


# Where the valid field is looked for the end of, by the square of the angle (rad^2) or of its tangent.
_SQUARED_ANGLES = read_only(np.linspace(0.0, pi, 1001) ** 2)
_SQUARED_SLOPES = read_only(np.tan(np.linspace(0.0, 0.5 * pi - 1e-3, 1001)) ** 2)


def _rows(values: ArrayLike, width: int) -> FloatArray:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim == 1:
        array = array.reshape(1, -1)
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"expected an array of shape (N, {width}), got {array.shape}")
    # A view that is writable and one that is not would each be compiled; the loops see one kind.
    return array if array.flags.writeable else array.copy()


def _limit(model_id: int, k: FloatArray) -> float:
    """Where the radial map stops growing: tan(theta) for the polynomial lenses, theta (rad) for ``equidistant``."""
    if model_id == kernels.FOV:
        return inf
    if model_id == kernels.EQUIDISTANT:
        slope = np.array([1.0, 3.0 * k[4], 5.0 * k[5], 7.0 * k[6], 9.0 * k[7]])
        return min(pi, sqrt(_first_root(slope, _SQUARED_ANGLES)))
    numerator = np.array([1.0, k[4], k[5], k[8]])
    denominator = np.array([1.0, k[9], k[10], k[11]])
    order = np.arange(4.0)
    # d(r N/D)/dr = ((N + 2 s N') D - 2 s N D') / D^2 with s = r^2.
    slope = np.convolve((1.0 + 2.0 * order) * numerator, denominator) - np.convolve(
        numerator, 2.0 * order * denominator
    )
    first = _first_root(slope, _SQUARED_SLOPES)
    return sqrt(min(first, _first_root(denominator, _SQUARED_SLOPES)) if denominator.any(where=order > 0) else first)


def _first_root(ascending: FloatArray, grid: FloatArray) -> float:
    """First place where a polynomial that starts at 1 is no longer positive; inf when it is positive on the whole grid.

    A scan and a bisection, because an eigenvalue root finder loses all digits to a tiny leading coefficient.
    """
    value = np.full_like(grid, ascending[-1])
    for coefficient in ascending[-2::-1]:
        value *= grid
        value += coefficient
    bad = np.flatnonzero(value <= 0.0)
    if bad.size == 0:
        return inf
    low, high = float(grid[bad[0] - 1]), float(grid[bad[0]])
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.polynomial.polynomial.polyval(middle, ascending) > 0.0:
            low = middle
        else:
            high = middle
    return low
