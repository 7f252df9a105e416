"""What a measurement of a beacon is given and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from uvgs_bench.beacon.frames import FrameChoice
from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.geometry import FloatArray

By = Literal["board", "gantry", "free"]


@dataclass(frozen=True, slots=True)
class Caliper:
    """A distance between two LEDs measured by hand.

    Args:
        first: One LED.
        second: The other.
        distance_m: Distance of the emission centres, m.
        sigma_m: Its deviation, m.
    """

    first: str
    second: str
    distance_m: float
    sigma_m: float = 5e-5


@dataclass(frozen=True, slots=True)
class MeasureConfig:
    """What is known beside the pictures, and how well.

    Args:
        by: Where shape and scale come from.
        frame: The frame of the result.
        calipers: Distances; the scale with ``free``, a check otherwise.
        is_carried: With ``gantry``: whether the beacon rides the carriage, else the camera.
        station_sigma_m: With ``gantry``: deviation of a stop per axis, m.
        scale_sigma: With ``gantry``: deviation of the scale of an axis.
        squareness_sigma_rad: With ``gantry``: deviation of a squareness, rad.
        board_scale_sigma: With ``board``: deviation of the print scale.
        nominal_sigma_m: Deviation of nominal coordinates of LEDs that sit where they should, m; matters where the scale
            comes from them.
        is_lens_fixed: Take the lens as exact instead of adjusting it within its covariance.
        worst_sigma_m: A worse distance than this is no measurement, m.
        is_shift_free: Also estimate how far each emission centre travels along its axis with the view angle; positions
            are then those seen along the axis.
    """

    by: By
    frame: FrameChoice = field(default_factory=FrameChoice)
    calipers: tuple[Caliper, ...] = ()
    is_carried: bool = True
    station_sigma_m: float = 3e-5
    scale_sigma: float = 1e-4
    squareness_sigma_rad: float = 2e-4
    board_scale_sigma: float = 2e-4
    nominal_sigma_m: float = 1e-4
    is_lens_fixed: bool = False
    worst_sigma_m: float = 5e-4
    is_shift_free: bool = False


@dataclass(frozen=True, slots=True)
class Distance:
    """A distance between two LEDs; it does not depend on the frame.

    Args:
        first: One LED.
        second: The other.
        distance_m: Measured, m.
        sigma_m: Its deviation, m.
        nominal_m: Of the nominal beacon, m.
        caliper_m: By hand, m, or None.
        caliper_sigma_m: Its deviation, m, or None.
    """

    first: str
    second: str
    distance_m: float
    sigma_m: float
    nominal_m: float
    caliper_m: float | None = None
    caliper_sigma_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LedResiduals:
    """How one LED fits.

    Args:
        name: The LED.
        count: Sightings used.
        rejected: Sightings set aside.
        rms_px: Root mean square residual per axis, px.
        max_angle_rad: Widest angle between its axis and the line of sight, rad; NaN when it has no axis.
        shift_m: Travel of the emission centre along the axis from the front view to a grazing one (shift times 1 - cos
            angle), m: as adjusted where it was free, else what residuals show beyond what a fixed point explains; NaN
            when the views cannot tell.
        shift_sigma_m: Its deviation, m.
        deviation_m: Measured minus nominal after laying most LEDs onto their nominal places, m.
        angle_rad: Angle between its axis and the line of sight in each sighting used, shape (count,), rad; empty when
            it has no axis or too few sightings.
        along_axis_px: Residual of the same sightings along the picture of the axis, px; a wandering centre shows here.
    """

    name: str
    count: int
    rejected: int
    rms_px: float
    max_angle_rad: float
    shift_m: float
    shift_sigma_m: float
    deviation_m: float
    angle_rad: FloatArray
    along_axis_px: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class BeaconMeasurement:
    """A measured beacon with everything that tells how good it is.

    Args:
        beacon: The beacon in its new frame, with covariance.
        distances: All pairs.
        leds: How each LED fits.
        by: Where the shape comes from.
        scale_source: Where the scale comes from, with its deviation.
        gauge: What fixes the frame.
        view_count: Views used.
        sigma_px: Deviation of a centroid per axis as found from the residuals, px.
        redundancy: Degrees of freedom left.
        condition: Condition number of the scaled information.
        mirror_margin: How much more the mirror image costs (chi-square); inf where it cannot be mistaken.
        rejected: Sightings set aside: view, LED, residual in px.
        warnings: Lines for people.
        is_shift_free: Whether the travel of emission centres was adjusted; positions are then those along the axes.
    """

    beacon: Beacon
    distances: tuple[Distance, ...]
    leds: tuple[LedResiduals, ...]
    by: By
    scale_source: str
    gauge: str
    view_count: int
    sigma_px: float
    redundancy: float
    condition: float
    mirror_margin: float
    rejected: tuple[tuple[str, str, float], ...]
    warnings: tuple[str, ...]
    is_shift_free: bool = False

    @property
    def worst_sigma_m(self) -> float:
        """Largest deviation of a distance, m."""
        return max(distance.sigma_m for distance in self.distances)
