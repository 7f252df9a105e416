"""Every parameter of the sensor, with the paper's names where the paper has one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class UvgsConfig:
    """How a picture becomes a pose; also the schema of a sensor file (``schema = 1``).

    Args:
        detection: ``fast`` (only near bright places, on raw pixels) or ``paper`` (sections 2.1 and 2.2 to the letter).
        alpha: Decimation factor of the ``paper`` pipeline, in (0, 1]; 1 keeps all pixels.
        blur_sigma_px: Standard deviation of the Gaussian filter of the ``paper`` pipeline, decimated px; 0 = none.
        window_px: Side of the local window of the threshold, px, odd; several blob diameters.
        threshold_k: k of the threshold ``mean + k * sigma`` in the local window.
        threshold_floor: Least height above the local background, as a fraction of the picture's range.
        element_px: Side of the structuring element of opening and closing (``paper``), px, odd; 1 = none.
        min_contrast: Least range of a picture worth looking at, as a fraction of full scale.
        min_area_px2: Smallest blob, px^2.
        max_area_px2: Largest blob, px^2; where the diameters of the LEDs are known, their size at the nearest range
            with the widest blur bounds it too.
        widest_blur_px: Standard deviation of the widest point spread at which LEDs shall be found, px.
        min_circularity: Least 4 pi area / perimeter^2.
        hue_deg: Accepted hues (low, high), degrees, wrapping when low > high; None takes the beacon's.
        min_separation_px: Blobs closer than this to a brighter one cannot be two LEDs, px.
        min_range_m: Nearest beacon, m; bounds the distance between two blobs of one beacon from above.
        max_range_m: Farthest beacon, m; bounds the size of four blobs of one beacon from below.
        max_blobs: More candidates than this are refused rather than searched.
        centroid: ``weighted`` (raw pixels above local background) or ``binary`` (first moments of the binary blob).
        gain_e_per_dn: Electrons per grey step of an 8-bit picture, for the shot noise of the centroid deviations.
        correspondence: ``scored`` (all labelings) or ``paper`` (section 2.4).
        min_margin: Below this margin (1 + log likelihood ratio of best and runner-up) the answer is ``ambiguous``.
        max_chance_fits: Refuse a fit when more than this many as likely are expected from lights strewn at random.
        model_error_px: What lens and beacon files may be wrong by, px; used to judge fits, not in the covariance.
        max_chi2_per_dof: Largest chi-square per degree of freedom of an accepted fit.
        max_rms_px: Largest root mean square residual of an accepted fit, px per axis.
        emission_slack_deg: How far beyond its half angle an LED may still be seen, degrees.
        solver: Name in ``SOLVERS``.
        max_iterations: Most iterations of the solver. Of random views (60 degree cone, 0.5 to 3 m, 6000 per noise)
            30 would cut off 0.02 % at 0.5 px, 0.6 % at 1 px and 4 % at 2 px; 100 cuts off none, none and 0.2 %.
        track: Whether a prior lets the sensor look in windows around the predicted LEDs first; of the solvers only
            ``uvgs_lm`` does.
        track_captures: After so many captures solved from windows the whole picture is searched again.
        max_speed_mps: The beacon moves no faster than this before the camera, m/s; sizes the windows.
        max_turn_deg_s: It turns no faster than this, degrees per second.
        emission_exponent: An LED shines as the cosine to its axis to this power, when brightness is compared.
        led_brightness_sigma: Deviation of the natural logarithm of brightness between good LEDs; 0 does not compare it.
        led_width_sigma: The same for the width of their spots.
        rate_hz: Most captures per second that are looked at, the others are passed over; 0 looks at all.

    Raises:
        ValueError: A value outside its meaning.
    """

    detection: Literal["fast", "paper"] = "fast"
    alpha: float = 1.0
    blur_sigma_px: float = 1.0
    window_px: int = 61
    threshold_k: float = 2.0
    threshold_floor: float = 0.08
    element_px: int = 3
    min_contrast: float = 0.05
    min_area_px2: float = 3.0
    max_area_px2: float = 4000.0
    widest_blur_px: float = 4.0
    min_circularity: float = 0.5
    hue_deg: tuple[float, float] | None = None
    min_separation_px: float = 3.0
    min_range_m: float = 0.1
    max_range_m: float = 20.0
    max_blobs: int = 16
    centroid: Literal["weighted", "binary"] = "weighted"
    gain_e_per_dn: float = 40.0
    correspondence: Literal["scored", "paper"] = "scored"
    min_margin: float = 4.0
    max_chance_fits: float = 0.5
    model_error_px: float = 0.15
    max_chi2_per_dof: float = 7.0
    max_rms_px: float = 2.0
    emission_slack_deg: float = 5.0
    solver: str = "uvgs_lm"
    max_iterations: int = 100
    track: bool = True
    track_captures: int = 50
    max_speed_mps: float = 0.3
    max_turn_deg_s: float = 30.0
    emission_exponent: float = 1.0
    led_brightness_sigma: float = 0.3
    led_width_sigma: float = 0.2
    rate_hz: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.alpha <= 1.0:
            raise ValueError(f"alpha must be in (0, 1], got {self.alpha}")
        for name in ("window_px", "element_px"):
            value = getattr(self, name)
            if value < 1 or value % 2 == 0:
                raise ValueError(f"{name} must be odd and positive, got {value}")
        for name in (
            "min_area_px2",
            "widest_blur_px",
            "min_range_m",
            "gain_e_per_dn",
            "max_chi2_per_dof",
            "max_rms_px",
        ):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in (
            "blur_sigma_px",
            "threshold_k",
            "threshold_floor",
            "min_contrast",
            "min_circularity",
            "max_chance_fits",
            "model_error_px",
            "min_separation_px",
            "emission_slack_deg",
            "max_speed_mps",
            "max_turn_deg_s",
            "emission_exponent",
            "led_brightness_sigma",
            "led_width_sigma",
            "rate_hz",
        ):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not self.max_area_px2 > self.min_area_px2:
            raise ValueError(f"max_area_px2 must exceed min_area_px2, got {self.max_area_px2} <= {self.min_area_px2}")
        if not self.max_range_m > self.min_range_m:
            raise ValueError(f"max_range_m must exceed min_range_m, got {self.max_range_m} <= {self.min_range_m}")
        if not 4 <= self.max_blobs <= 64:
            raise ValueError(f"max_blobs must be between 4 and 64, got {self.max_blobs}")
        if not self.min_margin >= 1.0:
            raise ValueError(f"min_margin must be at least 1, got {self.min_margin}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations must be positive, got {self.max_iterations}")
