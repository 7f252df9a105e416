"""Compiled scalar kernels of the five lenses, and loops over them.

Every lens uses one parameter layout (``Lens.kernel_parameters``, shape (17,)): fx, fy, cx, cy, twelve coefficients
(unused ones zero), and the limit of the valid field: the largest tan(theta) for the polynomial lenses, the largest
theta (rad) for ``equidistant``, unused for ``fov``. So ``plumb_bob`` and ``rational_polynomial`` are ``thin_prism``
with zeros.

To add a lens: give it the next number, a branch in ``project_point_with_jacobian``, ``coefficient_columns`` and
``unproject_point``, and a line in ``LENSES``.

Source: OpenCV documentation (calib3d, fisheye): rational, thin prism, and Kannala-Brandt as ``fisheye``; F. Devernay
and O. Faugeras, Straight lines have to be straight, Machine Vision and Applications 13 (2001): ``fov``.
"""

from __future__ import annotations

from math import atan, atan2, cos, hypot, inf, nan, pi, sin, sqrt, tan

import numpy as np

from uvgs_bench.geometry import FloatArray
from uvgs_bench.geometry.compiled import compiled

PLUMB_BOB = 0
RATIONAL_POLYNOMIAL = 1
THIN_PRISM = 2
EQUIDISTANT = 3
FOV = 4

KERNEL_SIZE = 17
LIMIT = 16

# Below this ratio rho/z the series with two terms is exact to double precision.
_NEAR_AXIS = 1e-4
# The inverse must reproduce the pixel to this; the iteration aims ten times lower.
_INVERSE_TOLERANCE_PX = 1e-10


@compiled
def _polynomial(k: FloatArray, X: float, Y: float) -> tuple[float, float, float, float, float, float]:
    """Distorted normalised coordinates (a, b) and da/dX, da/dY, db/dX, db/dY of the polynomial lenses."""
    s = X * X + Y * Y
    N = 1.0 + s * (k[4] + s * (k[5] + s * k[8]))
    D = 1.0 + s * (k[9] + s * (k[10] + s * k[11]))
    per_D = 1.0 / D
    q = N * per_D
    q_s = (k[4] + s * (2.0 * k[5] + s * 3.0 * k[8]) - q * (k[9] + s * (2.0 * k[10] + s * 3.0 * k[11]))) * per_D
    p1, p2 = k[6], k[7]
    a = X * q + 2.0 * p1 * X * Y + p2 * (s + 2.0 * X * X) + s * (k[12] + k[13] * s)
    b = Y * q + p1 * (s + 2.0 * Y * Y) + 2.0 * p2 * X * Y + s * (k[14] + k[15] * s)
    mixed = 2.0 * X * Y * q_s + 2.0 * p1 * X + 2.0 * p2 * Y
    prism_a = 2.0 * (k[12] + 2.0 * k[13] * s)
    prism_b = 2.0 * (k[14] + 2.0 * k[15] * s)
    return (
        a,
        b,
        q + 2.0 * X * X * q_s + 2.0 * p1 * Y + 6.0 * p2 * X + X * prism_a,
        mixed + Y * prism_a,
        mixed + X * prism_b,
        q + 2.0 * Y * Y * q_s + 6.0 * p1 * Y + 2.0 * p2 * X + Y * prism_b,
    )


@compiled
def _equidistant_radius(k: FloatArray, theta: float) -> tuple[float, float]:
    """Distorted angle theta_d and its derivative by theta."""
    s = theta * theta
    value = theta * (1.0 + s * (k[4] + s * (k[5] + s * (k[6] + s * k[7]))))
    slope = 1.0 + s * (3.0 * k[4] + s * (5.0 * k[5] + s * (7.0 * k[6] + s * 9.0 * k[7])))
    return value, slope


@compiled
def _radial(model_id: int, k: FloatArray, rho: float, z: float) -> tuple[float, float, float, bool]:
    """Scale m with (a, b) = m (x, y), h = (dm/drho)/rho, and dm/dz, of the lenses that are radial in the angle."""
    if model_id == FOV:
        if not z > 0.0:
            return nan, nan, nan, False
        w = k[4]
        T2 = 2.0 * tan(0.5 * w)
        ru = rho / z
        slope = T2 / (w * (1.0 + T2 * T2 * ru * ru))
        if ru < _NEAR_AXIS:
            m = T2 / (w * z) * (1.0 - T2 * T2 * ru * ru / 3.0)
            h = -2.0 / 3.0 * T2 * T2 * T2 / (w * z * z * z)
        else:
            m = atan(T2 * ru) / (w * rho)
            h = (slope / z - m) / (rho * rho)
        return m, h, -slope / (z * z), True
    if rho <= 0.0 and not z > 0.0:
        return nan, nan, nan, False
    theta = atan2(rho, z)
    if not theta < k[LIMIT]:
        return nan, nan, nan, False
    value, slope = _equidistant_radius(k, theta)
    squared = rho * rho + z * z
    if z > 0.0 and rho < _NEAR_AXIS * z:
        t = rho / z
        m = (1.0 + t * t * (k[4] - 1.0 / 3.0)) / z
        h = (2.0 * k[4] - 2.0 / 3.0) / (z * z * z)
    else:
        m = value / rho
        h = (slope * z / squared - m) / (rho * rho)
    return m, h, -slope / squared, True


@compiled
def project_point_with_jacobian(
    model_id: int, parameters: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, bool, float, float, float, float, float, float]:
    """Project one point and differentiate by it.

    Args:
        model_id: Number of the lens.
        parameters: ``Lens.kernel_parameters``, shape (17,).
        x: Point in camera axes, m.
        y: As x.
        z: As x.

    Returns:
        u, v (px), whether the point is in the valid field, and du/dx, du/dy, du/dz, dv/dx, dv/dy, dv/dz (px/m); NaN
        when outside.

    Raises:
        ValueError: The parameters have another layout.
    """
    k = parameters
    if k.shape[0] != KERNEL_SIZE:
        raise ValueError("lens kernels need Lens.kernel_parameters")
    outside = (nan, nan, False, nan, nan, nan, nan, nan, nan)
    fx, fy = k[0], k[1]
    if model_id <= THIN_PRISM:
        if not z > 0.0:
            return outside
        per_z = 1.0 / z
        X = x * per_z
        Y = y * per_z
        squared = X * X + Y * Y
        if squared >= k[LIMIT] * k[LIMIT]:
            return outside
        a, b, a_X, a_Y, b_X, b_Y = _polynomial(k, X, Y)
        fx_z = fx * per_z
        fy_z = fy * per_z
        return (
            k[2] + fx * a,
            k[3] + fy * b,
            True,
            fx_z * a_X,
            fx_z * a_Y,
            -fx_z * (a_X * X + a_Y * Y),
            fy_z * b_X,
            fy_z * b_Y,
            -fy_z * (b_X * X + b_Y * Y),
        )
    m, h, m_z, is_valid = _radial(model_id, k, hypot(x, y), z)
    if not is_valid:
        return outside
    return (
        k[2] + fx * x * m,
        k[3] + fy * y * m,
        True,
        fx * (m + x * x * h),
        fx * x * y * h,
        fx * x * m_z,
        fy * x * y * h,
        fy * (m + y * y * h),
        fy * y * m_z,
    )


@compiled
def project_point(model_id: int, parameters: FloatArray, x: float, y: float, z: float) -> tuple[float, float, bool]:
    """Project one point.

    Args:
        model_id: Number of the lens.
        parameters: ``Lens.kernel_parameters``, shape (17,).
        x: Point in camera axes, m.
        y: As x.
        z: As x.

    Returns:
        u, v (px) and whether the point is in the valid field; NaN when outside.

    Raises:
        ValueError: The parameters have another layout.
    """
    result = project_point_with_jacobian(model_id, parameters, x, y, z)
    return result[0], result[1], result[2]


@compiled
def coefficient_columns(model_id: int, k: FloatArray, x: float, y: float, z: float, out: FloatArray) -> None:
    """Differentiate a valid projection by fx, fy, cx, cy and the coefficients.

    Args:
        model_id: Number of the lens.
        k: ``Lens.kernel_parameters``, shape (17,).
        x: Point in camera axes, m.
        y: As x.
        z: As x.
        out: Derivatives by the kernel parameters, filled, shape (2, 17), px per unit.
    """
    fx, fy = k[0], k[1]
    out[:, :] = 0.0
    out[0, 2] = 1.0
    out[1, 3] = 1.0
    if model_id <= THIN_PRISM:
        X = x / z
        Y = y / z
        s = X * X + Y * Y
        a, b, _, _, _, _ = _polynomial(k, X, Y)
        out[0, 0] = a
        out[1, 1] = b
        N = 1.0 + s * (k[4] + s * (k[5] + s * k[8]))
        D = 1.0 + s * (k[9] + s * (k[10] + s * k[11]))
        power = s
        for i, j in ((4, 9), (5, 10), (8, 11)):
            out[0, i] = fx * X * power / D
            out[1, i] = fy * Y * power / D
            out[0, j] = -fx * X * power * N / (D * D)
            out[1, j] = -fy * Y * power * N / (D * D)
            power *= s
        out[0, 6] = fx * 2.0 * X * Y
        out[1, 6] = fy * (s + 2.0 * Y * Y)
        out[0, 7] = fx * (s + 2.0 * X * X)
        out[1, 7] = fy * 2.0 * X * Y
        out[0, 12] = fx * s
        out[0, 13] = fx * s * s
        out[1, 14] = fy * s
        out[1, 15] = fy * s * s
        return
    rho = hypot(x, y)
    m, _, _, _ = _radial(model_id, k, rho, z)
    out[0, 0] = x * m
    out[1, 1] = y * m
    if model_id == EQUIDISTANT:
        theta = atan2(rho, z)
        # theta / rho tends to 1 / z on the axis, where the columns vanish anyway.
        power = 1.0 / z if rho == 0.0 else theta / rho
        for i in range(4, 8):
            power *= theta * theta
            out[0, i] = fx * x * power
            out[1, i] = fy * y * power
        return
    w = k[4]
    T = tan(0.5 * w)
    T2_w = 1.0 + T * T
    ru = rho / z
    by_w = T2_w / (z * w * (1.0 + 4.0 * T * T * ru * ru)) - m / w
    out[0, 4] = fx * x * by_w
    out[1, 4] = fy * y * by_w


@compiled
def _inverse_equidistant(k: FloatArray, radius: float) -> float:
    """Angle theta of a distorted angle, rad; NaN beyond the limit. Newton inside a bracket, so it cannot run away."""
    low, high = 0.0, float(k[LIMIT])
    if radius > _equidistant_radius(k, high)[0]:
        return nan
    theta = min(radius, 0.5 * high)
    for _ in range(100):
        value, slope = _equidistant_radius(k, theta)
        error = value - radius
        if error > 0.0:
            high = theta
        else:
            low = theta
        step = error / slope if slope > 0.0 else inf
        new = theta - step
        if not low <= new <= high:
            new = 0.5 * (low + high)
        if abs(new - theta) <= 1e-16 * theta:
            return new
        theta = new
    return theta


@compiled
def _inverse_polynomial_start(k: FloatArray, radius: float) -> float:
    """Undistorted radius of a distorted one by the radial terms alone, at most the limit of the valid field."""
    low, high = 0.0, float(k[LIMIT])
    if high == inf:
        high = max(1.0, 2.0 * radius)
        for _ in range(60):
            s = high * high
            D = 1.0 + s * (k[9] + s * (k[10] + s * k[11]))
            if high * (1.0 + s * (k[4] + s * (k[5] + s * k[8]))) / D >= radius:
                break
            high *= 2.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        s = middle * middle
        D = 1.0 + s * (k[9] + s * (k[10] + s * k[11]))
        if middle * (1.0 + s * (k[4] + s * (k[5] + s * k[8]))) / D < radius:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@compiled
def _newton_polynomial(
    k: FloatArray, a: float, b: float, X: float, Y: float, most_halvings: int
) -> tuple[float, float, float]:
    """Undistorted normalised coordinates by damped Newton from X, Y on the exact Jacobian, and what is left, px."""
    fx, fy = k[0], k[1]
    a_now, b_now, a_X, a_Y, b_X, b_Y = _polynomial(k, X, Y)
    error = hypot(fx * (a - a_now), fy * (b - b_now))
    for _ in range(50):
        det = a_X * b_Y - a_Y * b_X
        if error <= 0.01 * _INVERSE_TOLERANCE_PX or not det > 0.0:
            break
        da, db = a - a_now, b - b_now
        step_X = (b_Y * da - a_Y * db) / det
        step_Y = (a_X * db - b_X * da) / det
        factor = 1.0
        has_improved = False
        for _ in range(most_halvings):
            X_new, Y_new = X + factor * step_X, Y + factor * step_Y
            a_new, b_new, n1, n2, n3, n4 = _polynomial(k, X_new, Y_new)
            new = hypot(fx * (a - a_new), fy * (b - b_new))
            if new < error:
                X, Y, a_now, b_now, a_X, a_Y, b_X, b_Y, error = X_new, Y_new, a_new, b_new, n1, n2, n3, n4, new
                has_improved = True
                break
            factor *= 0.5
        if not has_improved:
            break
    return X, Y, error


@compiled
def _inverse_polynomial(k: FloatArray, a: float, b: float) -> tuple[float, float, bool]:
    """Undistorted normalised coordinates: Newton from the distorted ones, else from a bracketed radius."""
    X, Y, error = _newton_polynomial(k, a, b, a, b, 1)
    if not (error <= _INVERSE_TOLERANCE_PX and hypot(X, Y) < k[LIMIT]):
        radius = hypot(a, b)
        scale = _inverse_polynomial_start(k, radius) / radius if radius > 0.0 else 0.0
        X, Y, error = _newton_polynomial(k, a, b, a * scale, b * scale, 20)
    return X, Y, error <= _INVERSE_TOLERANCE_PX and hypot(X, Y) < k[LIMIT]


@compiled
def unproject_point(model_id: int, parameters: FloatArray, u: float, v: float) -> tuple[float, float, float, bool]:
    """Direction of the ray a pixel sees.

    Args:
        model_id: Number of the lens.
        parameters: ``Lens.kernel_parameters``, shape (17,).
        u: Column, px (raw, distorted).
        v: Row, px.

    Returns:
        Unit vector x, y, z in camera axes and whether there is one; NaN when not.

    Raises:
        ValueError: The parameters have another layout.
    """
    k = parameters
    if k.shape[0] != KERNEL_SIZE:
        raise ValueError("lens kernels need Lens.kernel_parameters")
    a, b = (u - k[2]) / k[0], (v - k[3]) / k[1]
    if model_id <= THIN_PRISM:
        X, Y, is_valid = _inverse_polynomial(k, a, b)
        if not is_valid:
            return nan, nan, nan, False
        norm = sqrt(1.0 + X * X + Y * Y)
        return X / norm, Y / norm, 1.0 / norm, True
    radius = hypot(a, b)
    if model_id == EQUIDISTANT:
        theta = _inverse_equidistant(k, radius)
    else:
        angle = radius * k[4]
        theta = atan(tan(angle) / (2.0 * tan(0.5 * k[4]))) if angle < 0.5 * pi else nan
    if not theta >= 0.0:
        return nan, nan, nan, False
    if radius == 0.0:
        return 0.0, 0.0, 1.0, True
    lateral = sin(theta) / radius
    return a * lateral, b * lateral, cos(theta), True


@compiled
def project_points(model_id: int, parameters: FloatArray, points_m: FloatArray) -> FloatArray:
    """Project points, shape (N, 3), m, in camera axes; returns (N, 2) px, NaN outside the valid field."""
    out = np.empty((points_m.shape[0], 2))
    for i in range(points_m.shape[0]):
        u, v, _ = project_point(model_id, parameters, points_m[i, 0], points_m[i, 1], points_m[i, 2])
        out[i, 0] = u
        out[i, 1] = v
    return out


@compiled
def project_points_with_jacobians(
    model_id: int, parameters: FloatArray, points_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Project points and differentiate.

    Args:
        model_id: Number of the lens.
        parameters: ``Lens.kernel_parameters``, shape (17,).
        points_m: Points in camera axes, shape (N, 3), m.

    Returns:
        Pixels (N, 2), derivative by the points (N, 2, 3), and by the kernel parameters (N, 2, 17), last column zero.
    """
    count = points_m.shape[0]
    px = np.empty((count, 2))
    by_point = np.empty((count, 2, 3))
    by_parameters = np.empty((count, 2, KERNEL_SIZE))
    for i in range(count):
        x, y, z = points_m[i, 0], points_m[i, 1], points_m[i, 2]
        u, v, is_valid, u_x, u_y, u_z, v_x, v_y, v_z = project_point_with_jacobian(model_id, parameters, x, y, z)
        px[i, 0], px[i, 1] = u, v
        by_point[i, 0, 0], by_point[i, 0, 1], by_point[i, 0, 2] = u_x, u_y, u_z
        by_point[i, 1, 0], by_point[i, 1, 1], by_point[i, 1, 2] = v_x, v_y, v_z
        if is_valid:
            coefficient_columns(model_id, parameters, x, y, z, by_parameters[i])
        else:
            by_parameters[i] = nan
    return px, by_point, by_parameters


@compiled
def unproject_points(model_id: int, parameters: FloatArray, px: FloatArray) -> FloatArray:
    """Unit rays, shape (N, 3), in camera axes, of raw pixels, shape (N, 2); NaN where there is none."""
    out = np.empty((px.shape[0], 3))
    for i in range(px.shape[0]):
        x, y, z, _ = unproject_point(model_id, parameters, px[i, 0], px[i, 1])
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
    return out
