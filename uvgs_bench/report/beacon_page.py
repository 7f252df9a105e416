"""Pictures of a beacon: its LEDs and its frame, and one page of what it can do."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.errors import ConfigError
from uvgs_bench.units import deg_from_rad, mm_from_m

if TYPE_CHECKING:
    from uvgs_bench.beacon.accuracy_map import AccuracyMap


def write_beacon_picture(path: Path, beacon: Beacon) -> None:
    """Draw the LEDs with their deviations and the frame, from the front and from the side.

    Args:
        path: PNG, PDF or SVG file.
        beacon: The beacon.

    Raises:
        ConfigError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 5.0), layout="constrained")
    _draw_views(figure.subplots(1, 2), beacon)
    figure.suptitle(_title(beacon))
    _save(figure, path)


def write_beacon_page(path: Path, beacon: Beacon, found: AccuracyMap, lines: tuple[str, ...], sigma_px: float) -> None:
    """Draw one page: the beacon, maps over range and tilt (worst side), blob sizes, and the findings in words.

    Args:
        path: PNG, PDF or SVG file.
        beacon: The beacon.
        found: Its map.
        lines: Findings.
        sigma_px: Deviation of a centroid, px.

    Raises:
        ConfigError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 13.0), layout="constrained")
    axes = figure.subplots(3, 2)
    _draw_views(axes[0], beacon)
    tilt_deg = [f"{deg_from_rad(float(tilt)):.0f}" for tilt in found.tilt_rad]
    maps = (
        (axes[1, 0], mm_from_m(_worst(found.position_sigma_m, np.nanmax)), "position, 1 sigma, mm (worst side)"),
        (axes[1, 1], deg_from_rad(_worst(found.attitude_sigma_rad, np.nanmax)), "attitude, 1 sigma, deg (worst side)"),
        (axes[2, 0], _worst(found.margin_px, np.nanmin), "nearest other labels, px (worst side)"),
    )
    for axis, values, title in maps:
        shown = axis.imshow(values, aspect="auto", origin="lower", cmap="viridis")
        axis.set_xticks(range(len(tilt_deg)), tilt_deg)
        axis.set_yticks(range(len(found.range_m)), [f"{r:.2f}" for r in found.range_m])
        axis.set(title=title, xlabel="tilt, deg", ylabel="range, m")
        for (k, i), value in np.ndenumerate(values):
            if np.isfinite(value):
                axis.text(i, k, f"{value:.3g}", ha="center", va="center", fontsize=7, color="white")
        figure.colorbar(shown, ax=axis)
    low = np.array([np.nanmin(row) if np.isfinite(row).any() else np.nan for row in found.separation_px])
    axes[2, 1].loglog(found.range_m, low, "o-", label="nearest two LEDs, worst view")
    axes[2, 1].loglog(found.range_m, found.diameter_px, "s--", label="diameter of an LED, without blur")
    axes[2, 1].set(title="size and overlap", xlabel="range, m", ylabel="px")
    axes[2, 1].legend()
    figure.suptitle(f"{_title(beacon)}; centroids ± {sigma_px:g} px\n" + "\n".join(lines), fontsize=9, ha="center")
    _save(figure, path)


def _worst(values: np.ndarray[Any, np.dtype[np.float64]], choose: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Worst over azimuths, (K, T); NaN where nothing is seen."""
    out = np.full(values.shape[:2], np.nan)
    for at in np.ndindex(out.shape):
        if np.isfinite(values[at]).any():
            out[at] = choose(values[at])
    return out


def _title(beacon: Beacon) -> str:
    if beacon.covariance_m2 is None:
        return f"{beacon.name}: not measured"
    worst = float(np.sqrt(np.diag(beacon.covariance_m2).max()))
    return f"{beacon.name}: measured, coordinates within ± {mm_from_m(worst):.3f} mm (1 sigma)"


def _draw_views(axes: Any, beacon: Beacon) -> None:
    p = mm_from_m(beacon.positions_m)
    size = float(np.ptp(p, axis=0).max())
    for axis, (a, b), title in ((axes[0], (0, 1), "from the front"), (axes[1], (2, 1), "from the side")):
        for i in range(len(p)):
            for j in range(i + 1, len(p)):
                axis.plot(p[[i, j], a], p[[i, j], b], color="0.8", lw=1, zorder=1)
        axis.scatter(p[:, a], p[:, b], color="tab:orange", zorder=3)
        for led, place in zip(beacon.leds, p, strict=True):
            axis.annotate(led.name, (place[a], place[b]), xytext=(5, 5), textcoords="offset points")
        for k, colour in ((a, "tab:red"), (b, "tab:green")):
            tip = 0.25 * size * np.eye(3)[k]
            axis.annotate("", (tip[a], tip[b]), (0.0, 0.0), arrowprops={"arrowstyle": "->", "color": colour})
            axis.text(tip[a], tip[b], "xyz"[k], color=colour)
        axis.set(title=title, xlabel=f"{'xyz'[a]}, mm", ylabel=f"{'xyz'[b]}, mm")
        axis.set_aspect("equal", "datalim")
        axis.invert_yaxis()


def _save(figure: Any, path: Path) -> None:
    if path.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ConfigError("expected a .png, .pdf or .svg file", str(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise ConfigError(f"cannot be written: {error.strerror or error}", str(path)) from None
