"""``--report`` of ``uvgs calibrate`` and ``uvgs camera show``: the page of a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from uvgs_bench.cli.console import print_path

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from uvgs_bench.beacon.geometry import Beacon
    from uvgs_bench.camera import Calibration, CalibrationResult


def write_calibration_report(
    folder: Path,
    calibration: Calibration,
    result: CalibrationResult | None = None,
    beacon: Beacon | None = None,
    source: str = "",
    *,
    force: bool,
) -> dict[str, str]:
    """Write ``report.html``, ``report.pdf`` and ``report.json`` of a calibration.

    Args:
        folder: Where they go; created when missing.
        calibration: The calibration.
        result: How it came to be, if known.
        beacon: A beacon to forecast the pose of.
        source: Spec of the pictures, to show the worst of them; empty when none were kept.
        force: Whether existing reports may be replaced.

    Returns:
        Format to file.

    Raises:
        ConfigError: A file exists that may not be replaced.
        UvgsError: Writing failed.
    """
    from uvgs_bench.report.calibration_evidence import CalibrationEvidence
    from uvgs_bench.report.calibration_page import build_calibration_document
    from uvgs_bench.report.write import write_document

    pictures = {} if result is None or not source else _pictures(result, source)
    document = build_calibration_document(CalibrationEvidence(calibration, result, beacon, pictures))
    return {name: str(path) for name, path in write_document(document, folder, force=force).items()}


def print_reports(files: dict[str, str]) -> None:
    """Where the reports are, one line each."""
    for name, path in files.items():
        print_path(name, path)


def _pictures(result: CalibrationResult, source: str) -> dict[str, NDArray[np.generic]]:
    """The worst pictures, taken from their source once more; those that are gone by now are left out."""
    from uvgs_bench.devices.cameras.registry import open_camera
    from uvgs_bench.errors import CaptureError
    from uvgs_bench.report.calibration_evidence import worst_views
    from uvgs_bench.report.sections.calibration_views import PICTURED

    wanted = {result.view_names[i] for i in worst_views(result, PICTURED)}
    found: dict[str, NDArray[np.generic]] = {}
    try:
        with open_camera(source) as camera:
            for capture in camera:
                name = capture.source or f"capture {capture.index}"
                # Views of a live camera go by the name of their file without its ending.
                for known in wanted & {name, Path(name).stem}:
                    found[known] = capture.image
                if len(found) == len(wanted):
                    break
    except CaptureError:
        return found
    return found
