"""How well a centroid can be known at all: the Cramér-Rao bound of a Gaussian spot on pixels."""

from __future__ import annotations

from math import ceil, erf, exp, pi, sqrt

import numpy as np

from uvgs_bench.geometry import FloatArray

_QUANTISATION_DN2 = 1.0 / 12.0


def centroid_bound_px(
    offset_px: FloatArray,
    peak_dn: float,
    sigma_px: float,
    background_dn: float,
    read_noise_dn: float,
    gain_e_per_dn: float,
    full_scale_dn: float = 255.0,
) -> float:
    """Least standard deviation of an unbiased centroid, when height, width and background are unknown as well.

    Pixels at full scale tell nothing. Noise is shot noise, read noise and quantisation, taken as normal.

    Args:
        offset_px: Centre of the spot from the centre of a pixel, shape (2,), px.
        peak_dn: Height of the spot before pixels integrate it, DN.
        sigma_px: Standard deviation of the spot, px.
        background_dn: Light below it, DN.
        read_noise_dn: Read noise, DN.
        gain_e_per_dn: Electrons per DN.
        full_scale_dn: Largest value of a pixel, DN.

    Returns:
        The bound, root mean square of both axes, px.

    Source: the inverse of the Fisher information of normal pixels, J^T V^-1 J.
    """
    reach = ceil(6.0 * sigma_px) + 2
    at = np.arange(-reach, reach + 1, dtype=np.float64)
    parts = [_integrals(at - float(o), sigma_px) for o in offset_px]
    (gx, dx, wx), (gy, dy, wy) = parts
    flux = peak_dn * 2.0 * pi * sigma_px**2
    spot = np.outer(gy, gx)
    light = background_dn + flux * spot
    J = np.stack([
        flux * np.outer(gy, dx), flux * np.outer(dy, gx), spot,
        peak_dn * 4.0 * pi * sigma_px * spot + flux * (np.outer(wy, gx) + np.outer(gy, wx)), np.ones_like(spot),
    ]).reshape(5, -1)  # fmt: skip
    variance = read_noise_dn**2 + _QUANTISATION_DN2 + light.ravel() / gain_e_per_dn
    weight = np.where(light.ravel() < full_scale_dn, 1.0 / variance, 0.0)
    bound = np.linalg.inv((J * weight) @ J.T)
    return float(np.sqrt(0.5 * (bound[0, 0] + bound[1, 1])))


def _integrals(u: FloatArray, s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Share of a unit Gaussian in each pixel of a line, its derivative by the centre, and by the width."""
    root = sqrt(2.0) * s
    share = np.array([0.5 * (erf((v + 0.5) / root) - erf((v - 0.5) / root)) for v in u])
    high = np.array([exp(-0.5 * ((v + 0.5) / s) ** 2) for v in u]) / (sqrt(2.0 * pi) * s)
    low = np.array([exp(-0.5 * ((v - 0.5) / s) ** 2) for v in u]) / (sqrt(2.0 * pi) * s)
    return share, low - high, (low * (u - 0.5) - high * (u + 0.5)) / s
