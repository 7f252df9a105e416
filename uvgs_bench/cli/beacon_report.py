"""``--report`` of ``uvgs beacon measure``: the page of a measured beacon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uvgs_bench.beacon import Beacon
    from uvgs_bench.camera import Calibration
    from uvgs_bench.sessions.measure_beacon import MeasuredBeacon


def write_measurement_report(
    folder: Path, result: MeasuredBeacon, nominal: Beacon, calibration: Calibration, source: str, *, force: bool
) -> dict[str, str]:
    """Write ``report.html``, ``report.pdf`` and ``report.json`` of a measured beacon.

    Args:
        folder: Where they go; created when missing.
        result: The measurement.
        nominal: The beacon as meant.
        calibration: The camera.
        source: Where the pictures came from.
        force: Whether existing reports may be replaced.

    Returns:
        Format to file.

    Raises:
        ConfigError: A file exists that may not be replaced.
        UvgsError: Writing failed.
    """
    from uvgs_bench.report import write_document
    from uvgs_bench.report.beacon_evidence import MeasurementEvidence
    from uvgs_bench.report.beacon_page import build_measurement_document
    from uvgs_bench.sessions.measure_beacon import made_by

    created_utc, _, maker = made_by().partition(", ")
    lens = calibration.lens
    notes = {
        "source": source,
        "nominal": nominal.name,
        "camera": f"{calibration.camera_name}: {lens.model}, {lens.width_px} × {lens.height_px} px",
        "measured by": maker,
    }
    evidence = MeasurementEvidence(
        result.measurement, nominal, created_utc, result.captures, result.named, result.misses, notes
    )
    written = write_document(build_measurement_document(evidence), folder, force=force)
    return {name: str(path) for name, path in written.items()}
