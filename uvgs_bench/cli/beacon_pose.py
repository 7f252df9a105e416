"""What a calibration does to the pose of a beacon, as a table and as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uvgs_bench.beacon.geometry import Beacon
    from uvgs_bench.camera import Calibration


def pose_summary(calibration: Calibration, beacon: Beacon) -> dict[str, object]:
    """Deviations of the pose of a beacon on the optical axis that faces the camera, by range, as one JSON object."""
    import numpy as np

    from uvgs_bench.camera.pose_doubt import FORECAST_RANGES_M, LED_NOISE_PX, doubt_ahead
    from uvgs_bench.errors import CalibrationError
    from uvgs_bench.units import mm_from_m, mrad_from_rad

    rows: list[dict[str, object]] = []
    for range_m in FORECAST_RANGES_M:
        row: dict[str, object] = {"range_m": range_m}
        rows.append(row)
        try:
            doubt = doubt_ahead(calibration, beacon.positions_m, range_m)
        except CalibrationError as error:
            row["problem"] = str(error)
            continue
        if doubt is None:
            row["problem"] = "not whole in the picture"
            continue
        for part, sigmas in (("calibration", doubt.calibration_sigmas), ("noise", doubt.noise_sigmas)):
            row[f"{part}_sigma_mm"] = np.asarray(mm_from_m(sigmas[3:])).tolist()
            row[f"{part}_sigma_mrad"] = np.asarray(mrad_from_rad(sigmas[:3])).tolist()
    factor = calibration.doubt_factor if calibration.halves_ratio is not None else None
    return {"beacon": beacon.name, "led_noise_px": LED_NOISE_PX, "doubt_factor": factor, "ranges": rows}


def print_pose_summary(calibration: Calibration, beacon: Beacon) -> None:
    """Print the same.

    Args:
        calibration: The calibration.
        beacon: The beacon.
    """
    from rich.table import Table

    from uvgs_bench.cli.console import out

    found, too_small = pose_summary(calibration, beacon), calibration.doubt_factor
    out.print(f"pose of {beacon.name} facing the camera, 1σ; what the calibration does is the same in every picture",
              markup=False)  # fmt: skip
    table = Table(box=None, pad_edge=False)
    for name in ("range", "x, y, z mm", "mrad", f"LEDs ±{found['led_noise_px']} px: mm", "mrad"):
        table.add_column(name, justify="right")
    problems = []
    rows = found["ranges"]
    assert isinstance(rows, list)
    for row in rows:
        if "problem" in row:
            problems.append(f"  {row['range_m']:g} m: {row['problem']}")
            continue
        cells = [
            cell
            for part in ("calibration", "noise")
            for cell in (
                " ".join(f"{value:.2f}" for value in row[f"{part}_sigma_mm"]),
                f"{max(row[f'{part}_sigma_mrad']):.2f}",
            )
        ]
        table.add_row(f"{row['range_m']:g} m", *cells)
    if len(problems) < len(rows):
        out.print(table)
    for line in problems:
        out.print(line, markup=False)
    if too_small > 1.0 and len(problems) < len(rows):
        out.print(
            f"two halves disagree {too_small:.2f} times more than predicted: so much larger may its part be in truth"
        )
