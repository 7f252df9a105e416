"""How good the centroids are, on drawn spots, next to the Cramér-Rao bound."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np

from uvgs_bench.devices.sim.render import read_out
from uvgs_bench.devices.sim.render_kernels import add_spots
from uvgs_bench.devices.sim.truth import TrueCamera
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.blobs import NoBlobs, find_blobs
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.centroid_bound import centroid_bound_px
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted

CASES: tuple[tuple[float, float], ...] = (
    (200.0, 0.7),
    (200.0, 0.9),
    (200.0, 1.3),
    (200.0, 2.0),
    (200.0, 3.0),
    (60.0, 1.3),
    (400.0, 1.3),
    (1000.0, 1.3),
    (1000.0, 2.5),
    (3000.0, 2.5),
)
"""Peak (DN) and width (px) of the spots; peaks beyond full scale are clipped."""


@dataclass(frozen=True, slots=True)
class CentroidRow:
    """One kind of spot.

    Args:
        peak_dn: Height before pixels integrate it, DN.
        sigma_px: Width, px.
        is_clipped: Whether most of these spots have pixels at full scale.
        spots: How many were measured.
        missed: How many were not found.
        rms_px: Root mean square error per axis, px.
        bound_px: Cramér-Rao bound, root mean square over places within a pixel, px.
        normalised_rms: Root mean square of error over stated deviation; 1 when the deviations are true.
    """

    peak_dn: float
    sigma_px: float
    is_clipped: bool
    spots: int
    missed: int
    rms_px: float
    bound_px: float
    normalised_rms: float

    @property
    def over_bound(self) -> float:
        """Error over bound."""
        return self.rms_px / self.bound_px


def study_centroids(
    sink: EventSink,
    *,
    cases: tuple[tuple[float, float], ...] = CASES,
    pictures: int = 4,
    seed: int = 0,
    config: UvgsConfig | None = None,
) -> tuple[CentroidRow, ...]:
    """Draw spots at random places within pixels, measure them, and compare.

    Args:
        sink: Where progress goes.
        cases: Peaks and widths.
        pictures: Pictures of each case, each with some 170 spots.
        seed: Seed of places and noise.
        config: Sensor parameters; the gain is told to the sensor, as it would be from a data sheet.

    Returns:
        One row for each case.
    """
    sink(StageStarted("centroids", len(cases)))
    rows = []
    for done, (peak_dn, sigma_px) in enumerate(cases, start=1):
        rows.append(_row(peak_dn, sigma_px, pictures, np.random.default_rng((seed, done)), config or UvgsConfig()))
        sink(StageAdvanced("centroids", done))
    sink(StageFinished("centroids", f"{len(rows)} kinds of spots"))
    return tuple(rows)


def _row(peak_dn: float, sigma_px: float, pictures: int, rng: np.random.Generator, config: UvgsConfig) -> CentroidRow:
    camera = TrueCamera(psf_sigma_px=sigma_px, gain_e_per_dn=config.gain_e_per_dn, full_well_e=1e9)
    grid = np.stack(np.meshgrid(np.arange(50.0, 1240.0, 80.0), np.arange(50.0, 930.0, 80.0)), -1).reshape(-1, 2)
    errors, deviations, clipped, missed = [], [], [], 0
    bounds = []
    for _ in range(pictures):
        true_px = grid + rng.uniform(-0.5, 0.5, grid.shape)
        light = np.zeros((camera.height_px, camera.width_px, 1))
        amount = np.full(len(true_px), peak_dn * 2.0 * pi * sigma_px**2)
        add_spots(light, true_px, amount, np.ones(1), sigma_px)
        image = read_out(light[:, :, 0] + camera.background_dn, camera, rng)
        found = find_blobs(Capture(image, 0), config)
        if isinstance(found, NoBlobs):
            missed += len(true_px)
            continue
        distance = np.linalg.norm(found.centroid_px[:, None] - true_px[None], axis=2)
        nearest = distance.argmin(axis=0)
        near = distance.min(axis=0) < 1.0
        missed += int((~near).sum())
        errors.append(found.centroid_px[nearest[near]] - true_px[near])
        deviations.append(found.sigma_px[nearest[near]])
        clipped.append(found.clipped_px2[nearest[near]] > 0.0)
        bounds += [_bound(o, peak_dn, sigma_px, camera) for o in true_px[:12] - grid[:12]]
    error: FloatArray = np.concatenate(errors) if errors else np.full((1, 2), np.nan)
    deviation = np.concatenate(deviations) if deviations else np.ones(1)
    return CentroidRow(
        peak_dn,
        sigma_px,
        bool(np.concatenate(clipped).mean() > 0.5) if clipped else False,
        len(error),
        missed,
        float(np.sqrt((error**2).mean())),
        float(np.sqrt(np.mean(np.square(bounds)))) if bounds else float("nan"),
        float(np.sqrt(((error / deviation[:, None]) ** 2).mean())),
    )


def _bound(offset_px: FloatArray, peak_dn: float, sigma_px: float, camera: TrueCamera) -> float:
    full_scale_dn = (1 << camera.bit_depth) - 1 - camera.black_dn
    return centroid_bound_px(
        offset_px,
        peak_dn,
        sigma_px,
        camera.background_dn,
        camera.read_noise_dn,
        camera.gain_e_per_dn,
        full_scale_dn,
    )
