"""The part of ``uvgs beacon check`` that needs a camera: forecast, page, record."""

from __future__ import annotations

from pathlib import Path

from uvgs_bench.beacon import Beacon
from uvgs_bench.errors import ConfigError


def forecast(
    beacon: Beacon, camera: Path, near_m: float, far_m: float, tilt_deg: float, sigma_px: float, page: Path | None,
    force: bool,
) -> tuple[list[str], dict[str, object]]:  # fmt: skip
    """Compute what the beacon can do with the camera, and draw it if asked.

    Args:
        beacon: The beacon.
        camera: Camera file.
        near_m: Nearest range, m.
        far_m: Farthest range, m.
        tilt_deg: Widest tilt, degrees.
        sigma_px: Deviation of a centroid, px.
        page: Picture to write, or None.
        force: Whether it may be replaced.

    Returns:
        Lines for people, and a record.

    Raises:
        ConfigError: An option says what cannot be, or the page exists.
    """
    from uvgs_bench.report.beacon_page import write_beacon_page
    from uvgs_bench.sessions.beacon_advice import advise, default_ranges, widest_tilt
    from uvgs_bench.store.calibrations import read_calibration
    from uvgs_bench.units import deg_from_rad, mm_from_m

    if page is not None and page.exists() and not force:
        raise ConfigError("exists already; use --force to replace it", str(page))
    calibration = read_calibration(camera)
    advice = advise(
        beacon, calibration, ranges_m=default_ranges(near_m, far_m), tilt_rad=widest_tilt(tilt_deg), sigma_px=sigma_px
    )
    if page is not None:
        write_beacon_page(page, beacon, advice.map, advice.lines, sigma_px)
    found = advice.map
    record: dict[str, object] = {
        "sigma_px": sigma_px,
        "is_safe": advice.is_safe,
        "findings": list(advice.lines),
        "range_m": found.range_m,
        "tilt_deg": deg_from_rad(found.tilt_rad),
        "azimuth_deg": deg_from_rad(found.azimuth_rad),
        "position_sigma_mm": mm_from_m(found.position_sigma_m),
        "attitude_sigma_deg": deg_from_rad(found.attitude_sigma_rad),
        "margin_px": found.margin_px,
        "separation_px": found.separation_px,
        "diameter_px": found.diameter_px,
        "moves": [
            {
                "led": gain.led,
                "direction": gain.direction,
                "attitude_ratio": gain.attitude_ratio,
                "position_ratio": gain.position_ratio,
                "margin_px": gain.margin_px,
            }
            for gain in advice.gains
        ],
    }
    return list(advice.lines), record
