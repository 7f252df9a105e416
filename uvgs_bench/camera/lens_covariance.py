"""How sure a fit is of its lens: covariance with all poses free, noise judged picture by picture.

The fit weighs all corners alike, as other programs do; a far small board with blurred corners then has too much to say.
Its own noise, not the mean noise, goes into the covariance.

Source: H. White, A heteroskedasticity-consistent covariance matrix estimator (1980), with one variance per picture and
its degrees of freedom reduced by its leverage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.camera.bundle import Bundle, Corners, information
from uvgs_bench.errors import TooFewViews
from uvgs_bench.geometry import FloatArray

# Weight of the common variance in that of one picture, in degrees of freedom: a picture of few corners knows little
# of its own noise.
_SHARED_FREEDOM = 5.0
# Standard deviations to which coefficients that cancel each other are drawn. Published lenses of these models stay
# below; nothing ordinary pictures can tell is changed by them.
_RADIAL_SIGMA, _PRISM_SIGMA = 1.0, 0.01
_RADIAL, _PRISM = ("k1", "k2", "k3", "k4", "k5", "k6"), ("s1", "s2", "s3", "s4")


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """Covariances at a minimum.

    Args:
        covariance: Of the lens parameters, shape (P, P).
        joint: Of the lens parameters and the mean twist of all poses, shape (P + 6, P + 6).
        shape_covariance: Of the board's shape, shape (3, 3), or None when it is not free.
        condition: Scaled condition number of what the pictures alone say about the common parameters.
        view_noise_px: Standard deviation of a residual component in each view, shape (V,), px.
    """

    covariance: FloatArray
    joint: FloatArray
    shape_covariance: FloatArray | None
    condition: float
    view_noise_px: FloatArray


def prior_of(names: tuple[str, ...], noise_px: float, shape_count: int = 0) -> FloatArray | None:
    """Weights that draw the coefficients of the high-order lenses to zero, as ``adjust`` takes them.

    Args:
        names: Parameter names of the lens.
        noise_px: Standard deviation of a residual component, px.
        shape_count: Number of shape parameters that follow.

    Returns:
        Weights, shape (G,), px^2 per squared unit; None for a lens that needs none.
    """
    if "k6" not in names:
        return None
    weights = np.zeros(len(names) + shape_count)
    for i, name in enumerate(names):
        if name in _RADIAL:
            weights[i] = (noise_px / _RADIAL_SIGMA) ** 2
        elif name in _PRISM:
            weights[i] = (noise_px / _PRISM_SIGMA) ** 2
    return weights


def doubt_of(
    bundle: Bundle, corners: Corners, prior: FloatArray | None = None, *, is_noise_equal: bool = False
) -> Doubt:
    """Covariances of a minimum.

    Args:
        bundle: The minimum.
        corners: What it was fitted to.
        prior: The weights it was fitted with.
        is_noise_equal: Whether all pictures share one noise, as other programs assume.

    Returns:
        The covariances.

    Raises:
        TooFewViews: The views do not tell the parameters apart.
    """
    told = information(bundle, corners)
    S = told.reduced.sum(axis=0)
    weights = np.zeros(len(S)) if prior is None else prior
    condition = _scaled(S)[2]
    H = S + np.diag(weights)
    vectors, eigenvalues, _ = _scaled(H)
    if not eigenvalues[0] > 1e-15 * eigenvalues[-1]:
        raise TooFewViews(
            f"the views do not tell the parameters of a {bundle.lens.model} lens apart: tilt the board in several "
            "directions, at several distances, or choose a lens with fewer coefficients"
        )
    scale = 1.0 / np.sqrt(np.diag(H))
    inverse = scale[:, None] * ((vectors / eigenvalues) @ vectors.T) * scale
    e = bundle.residuals_px(corners)
    squares = corners.per_view(np.einsum("ni,ni->n", e, e))
    leverage = np.einsum("vij,ji->v", told.reduced, inverse)
    freedom = 2.0 * corners.per_view(np.ones(len(e))) - 6.0 - leverage
    variance = float(squares.sum() / freedom.sum())
    of_view = (squares + _SHARED_FREEDOM * variance) / (np.maximum(freedom, 0.0) + _SHARED_FREEDOM)
    used = np.full_like(of_view, variance) if is_noise_equal else of_view
    meat = np.einsum("v,vij->ij", used, told.reduced) + variance * np.diag(weights)
    common = inverse @ meat @ inverse
    common = 0.5 * (common + common.T)
    size = bundle.lens.parameters.size
    follow = told.pose_by_common.mean(axis=0)
    own = np.einsum("v,vij->ij", used, told.pose_inverse) / corners.view_count**2
    mixed = follow @ common
    joint = np.block([[common[:size, :size], mixed[:, :size].T], [mixed[:, :size], follow @ common @ follow.T + own]])
    shape = common[size:, size:] if bundle.shape is not None else None
    return Doubt(common[:size, :size], 0.5 * (joint + joint.T), shape, condition, np.sqrt(of_view))


def _scaled(S: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Eigenvectors, eigenvalues and condition of a matrix scaled to a unit diagonal, or to 0 where nothing is told."""
    diagonal = np.diag(S)
    told = diagonal > 0.0
    scale = np.where(told, 1.0 / np.sqrt(np.where(told, diagonal, 1.0)), 0.0)
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * S * scale)
    return vectors, eigenvalues, float(eigenvalues[-1] / max(float(eigenvalues[0]), 1e-300))
