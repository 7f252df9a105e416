"""Synthetic pose problems with known truth: the protocol as data, the drawing, and the bound no solver can beat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import ConfigError
from uvgs_bench.geometry import FloatArray, read_only
from uvgs_bench.geometry.compiled import compiled
from uvgs_bench.sensor.pose_kernels import normal_equations
from uvgs_bench.units import deg_from_rad, mm_from_m, rad_from_deg

# Gives own Lambda Twist a mean translation error of 0.43 % with the shipped beacon.
PAPER_SIGMA_PX = 0.24


@dataclass(frozen=True, slots=True, eq=False)
class Protocol:
    """Which problems are drawn; everything that decides a figure, so that it can be printed beside it.

    Args:
        name: Its name.
        lens: The lens.
        points_m: Target points in the beacon frame, z away from the camera when facing, shape (n, 3), m.
        range_m: Nearest and farthest distance, drawn uniformly, m.
        tilt_rad: Largest angle between the beacon's axis and the line of sight, uniform in solid angle, rad.
        sigma_px: Standard deviation of each centroid coordinate, Gaussian, px.
        note: What the reader must know about the choice.
    """

    name: str
    lens: Lens
    points_m: FloatArray
    range_m: tuple[float, float]
    tilt_rad: float
    sigma_px: float
    note: str = ""

    def lines(self) -> tuple[str, ...]:
        """The protocol in words."""
        lens = self.lens
        span_m = float(np.linalg.norm(self.points_m[:, None] - self.points_m[None], axis=2).max())
        return (
            f"protocol '{self.name}': {len(self.points_m)} points, {mm_from_m(span_m):.0f} mm across; "
            f"{lens.model} lens {lens.width_px}x{lens.height_px} px, f = {lens.fx_px:.0f} px",
            f"range uniform {self.range_m[0]:g} to {self.range_m[1]:g} m, line of sight uniform over the picture, view "
            f"angle up to {deg_from_rad(self.tilt_rad):.0f} deg (uniform in solid angle), any roll",
            f"Gaussian noise {self.sigma_px:g} px per coordinate, right labels, all points inside the picture",
            *((self.note,) if self.note else ()),
        )


def standard_protocol(name: str, points_m: FloatArray) -> Protocol:
    """One of the two printed protocols.

    Args:
        name: ``ours`` or ``paper``.
        points_m: Target points, shape (n, 3), m.

    Returns:
        The protocol.

    Raises:
        ConfigError: No such protocol.
    """
    points = read_only(points_m, (-1, 3))
    if name == "ours":
        lens = Lens("plumb_bob", 1280, 960, np.array([608.0, 608.0, 639.5, 479.5, -0.05, 0.02, 0.0, 0.0, 0.0]))
        return Protocol(name, lens, points, (0.5, 3.0), rad_from_deg(60.0), 0.2)
    if name == "paper":
        lens = Lens("plumb_bob", 1280, 960, np.array([608.0, 608.0, 639.5, 479.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
        note = (
            "the paper names neither noise, ranges, target nor count: noise is set so that Lambda Twist has about the "
            "mean translation error of its Table 1 (0.431 %); everything else is read from the rows beside it"
        )
        return Protocol(name, lens, points, (0.5, 2.0), rad_from_deg(45.0), PAPER_SIGMA_PX, note)
    raise ConfigError(f"unknown protocol '{name}', expected ours or paper", key="protocol")


@dataclass(frozen=True, slots=True, eq=False)
class Problems:
    """Drawn problems, one a row.

    Args:
        protocol: Where they come from.
        R_cb: True rotations camera_from_beacon, shape (N, 3, 3).
        t_cb_m: True translations, shape (N, 3), m.
        px: Observed centroids with noise, shape (N, n, 2), raw px.
    """

    protocol: Protocol
    R_cb: FloatArray
    t_cb_m: FloatArray
    px: FloatArray

    def __len__(self) -> int:
        return len(self.px)

    def first(self, count: int) -> Problems:
        """The first ``count`` of them."""
        return Problems(self.protocol, self.R_cb[:count], self.t_cb_m[:count], self.px[:count])

    @property
    def sigma_px(self) -> FloatArray:
        """Deviation of each point, shape (n,), px."""
        return np.full(len(self.protocol.points_m), self.protocol.sigma_px)


def rotations_of(vectors: FloatArray) -> FloatArray:
    """Rotation matrices, shape (N, 3, 3), of rotation vectors, shape (N, 3), rad."""
    angle = np.linalg.norm(vectors, axis=1)
    axis = vectors / np.maximum(angle, 1e-300)[:, None]
    W = np.zeros((len(vectors), 3, 3))
    W[:, 0, 1], W[:, 0, 2], W[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    W -= W.transpose(0, 2, 1).copy()
    result: FloatArray = np.eye(3) + np.sin(angle)[:, None, None] * W + (1.0 - np.cos(angle))[:, None, None] * (W @ W)
    return result


def draw_problems(protocol: Protocol, count: int, rng: np.random.Generator) -> Problems:
    """Draw problems; those with a point outside the picture are drawn again.

    Args:
        protocol: Ranges and noise.
        count: How many.
        rng: Source of everything random.

    Returns:
        The problems.

    Raises:
        ConfigError: Fewer than one draw in a hundred fits the picture.
    """
    lens, points = protocol.lens, protocol.points_m
    kept_R: list[FloatArray] = []
    kept_t: list[FloatArray] = []
    kept_px: list[FloatArray] = []
    have = drawn = 0
    while have < count:
        n = int(1.3 * (count - have)) + 16
        drawn += n
        centre = rng.uniform([0.0, 0.0], [lens.width_px - 1.0, lens.height_px - 1.0], (n, 2))
        rays = lens.unproject(centre)
        t = rays * rng.uniform(*protocol.range_m, (n, 1))
        tilt = np.arccos(rng.uniform(np.cos(protocol.tilt_rad), 1.0, n))
        about = rng.uniform(0.0, 2.0 * np.pi, n)
        roll = rng.uniform(-np.pi, np.pi, n)
        zero = np.zeros(n)
        # Facing means along the line of sight: z of the beacon is turned onto the ray.
        lean = np.stack([-rays[:, 1], rays[:, 0], zero], axis=1)
        sine = np.linalg.norm(lean, axis=1)
        lean *= (np.arctan2(sine, rays[:, 2]) / np.maximum(sine, 1e-300))[:, None]
        R = (
            rotations_of(lean)
            @ rotations_of(tilt[:, None] * np.stack([np.cos(about), np.sin(about), zero], axis=1))
            @ rotations_of(np.stack([zero, zero, roll], axis=1))
        )
        camera = points @ R.transpose(0, 2, 1) + t[:, None, :]
        px = lens.project(camera.reshape(-1, 3)).reshape(n, -1, 2)
        inside = lens.contains(px.reshape(-1, 2)).reshape(n, -1).all(axis=1)
        kept_R.append(R[inside])
        kept_t.append(t[inside])
        kept_px.append(px[inside])
        have += int(inside.sum())
        if drawn > 10_000 and have < drawn // 100:
            raise ConfigError(f"the target of protocol '{protocol.name}' hardly ever fits the picture", key="protocol")
    R, t, px = (np.concatenate(parts)[:count] for parts in (kept_R, kept_t, kept_px))
    return Problems(protocol, R, t, px + rng.normal(size=px.shape) * protocol.sigma_px)


@compiled
def _informations(
    model_id: int, lens: FloatArray, points: FloatArray, sigma: FloatArray, R: FloatArray, t: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fisher information of (turn about the beacon, shift) at poses, out shape (N, 6, 6)."""
    g = np.empty(6)
    residual = np.empty((points.shape[0], 2))
    for i in range(R.shape[0]):
        normal_equations(model_id, lens, points, residual, sigma, R[i], t[i], t[i], out[i], g, residual)


def bounds_of(problems: Problems) -> FloatArray:
    """Cramér-Rao bound of each problem at its truth.

    Args:
        problems: The problems.

    Returns:
        Least covariance of (turn about the beacon's origin, shift) in camera axes, shape (N, 6, 6), rad and m.
    """
    protocol = problems.protocol
    information = np.empty((len(problems), 6, 6))
    _informations(
        protocol.lens.model_id, protocol.lens.kernel_parameters, protocol.points_m.copy(), problems.sigma_px,
        problems.R_cb, problems.t_cb_m, information,
    )  # fmt: skip
    return np.asarray(np.linalg.inv(information), dtype=np.float64)
