"""The part of ``uvgs beacon check`` that needs a camera: forecast, page, record."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from uvgs_bench.beacon import Beacon
from uvgs_bench.beacon.checks import BeaconWarning


def forecast(
    beacon: Beacon, warnings: Sequence[BeaconWarning], camera: Path, near_m: float, far_m: float, tilt_deg: float,
    sigma_px: float, report: Path | None, force: bool,
) -> tuple[list[str], dict[str, object], dict[str, str]]:  # fmt: skip
    """Compute what the beacon can do with the camera, and write its report if asked.

    Args:
        beacon: The beacon.
        warnings: Weaknesses of the geometry itself, for the report.
        camera: Camera file.
        near_m: Nearest range, m.
        far_m: Farthest range, m.
        tilt_deg: Widest tilt, degrees.
        sigma_px: Deviation of a centroid, px.
        report: Folder for the report, or None.
        force: Whether it may be replaced.

    Returns:
        Lines for people, a record, and format to file of the report.

    Raises:
        ConfigError: An option says what cannot be, or the report exists.
    """
    from uvgs_bench.report import check_replaceable, write_document
    from uvgs_bench.report.beacon_evidence import ForecastEvidence
    from uvgs_bench.report.beacon_page import build_forecast_document
    from uvgs_bench.sessions.beacon_advice import STEP_M, advise, default_ranges, widest_tilt
    from uvgs_bench.store.calibrations import read_calibration
    from uvgs_bench.units import deg_from_rad, mm_from_m

    if report is not None:
        check_replaceable(report, force=force)
    calibration = read_calibration(camera)
    advice = advise(
        beacon, calibration, ranges_m=default_ranges(near_m, far_m), tilt_rad=widest_tilt(tilt_deg), sigma_px=sigma_px
    )
    found = advice.map
    files: dict[str, str] = {}
    if report is not None:
        lens = calibration.lens
        notes = {
            "camera": f"{calibration.camera_name}: {lens.model}, {lens.width_px} × {lens.height_px} px, "
            f"fx {lens.fx_px:.3f} px",
            "camera file": str(camera),
        }
        evidence = ForecastEvidence(
            beacon, found, advice.gains, sigma_px, STEP_M, advice.lines, advice.is_safe, tuple(warnings), notes
        )
        written = write_document(build_forecast_document(evidence), report, force=force)
        files = {name: str(path) for name, path in written.items()}
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
    return list(advice.lines), record, files
