"""The panel in the terminal beside a running stream."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from time import monotonic

from rich.console import Console, ConsoleOptions, RenderResult
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from uvgs_bench.units import deg_from_rad, mm_from_m, ms_from_s
from uvgs_bench.view.live_state import BeaconLine, GantryShown, LiveState, PastPoint, Shown

REDRAWS_HZ = 4.0
"""How often the panel is drawn: each time takes some milliseconds from the stream."""

_BARS = "▁▂▃▄▅▆▇█"
_GAP = "·"
_STALE_S = 1.0
_STYLES = {"ok": "bold green", "held": "bold yellow", "miss": "bold red"}


class LivePanel:
    """What rich draws each time it looks: always the newest capture.

    Args:
        state: What is shown.
    """

    def __init__(self, state: LiveState) -> None:
        self._state = state
        self.waiting = "opening"
        """What is said before the first capture."""

    def __rich_console__(self, _console: Console, options: ConsoleOptions) -> RenderResult:
        """Draw into the width there is."""
        shown = self._state.latest()
        if shown is None:
            yield Text(f"{self.waiting} ...", style="dim", overflow="ellipsis", no_wrap=True)
            return
        ask = self._state.gantry
        gantry = None if ask is None else ask()
        width = max(options.max_width - 4, 20)
        yield Panel(_table(shown, self._state.past(), gantry, width, is_over=self._state.is_over), expand=False)


def sparkline(values: Sequence[float], width: int) -> str:
    """The last values as bars between their least and greatest; what is not finite is a dot.

    Args:
        values: Values in order.
        width: Most characters.

    Returns:
        One character per value.
    """
    last = list(values)[-width:]
    finite = [value for value in last if isfinite(value)]
    low, span = min(finite, default=0.0), max(finite, default=0.0) - min(finite, default=0.0)
    top = len(_BARS) - 1
    return "".join(
        _GAP if not isfinite(value) else _BARS[round(top * (value - low) / span) if span > 0.0 else 0] for value in last
    )


def _table(shown: Shown, past: Sequence[PastPoint], gantry: GantryShown | None, width: int, *, is_over: bool) -> Table:
    table = Table.grid(padding=(0, 1))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold", max_width=max(width - 10, 10))
    for line in shown.lines:
        for name, words in _beacon_rows(line, alone=len(shown.lines) == 1):
            table.add_row(name, words)
    table.add_row("range", _curve(past, max(width - 34, 8)))
    table.add_row("captures", _counts(shown))
    table.add_row("rate", _pace(shown, is_over=is_over))
    if gantry is not None:
        words = Text("  ".join(f"{name} {value}" for name, value in gantry.positions))
        words.append(f"  {gantry.activity}", style="bold")
        if not gantry.is_homed:
            words.append("  not homed: positions mean nothing", style="yellow")
        table.add_row("gantry", words)
    return table


def _beacon_rows(line: BeaconLine, *, alone: bool) -> list[tuple[str, Text]]:
    head = Text(line.status.upper(), style=_STYLES[line.status])
    if not alone:
        head.append(f"  {line.name}{' (active)' if line.is_active else ''}", style="bold")
    if line.status == "held":
        head.append(f"  an old pose, repeated for {line.held_age_s:.2f} s", style="yellow")
    if line.reason:
        head.append(f"  {line.reason}", style="yellow" if line.status == "held" else "red")
    if line.flags:
        head.append(f"  {' '.join(line.flags)}", style="yellow")
    rows = [("", head)]
    if line.status == "miss":
        return [*rows, ("why", Text(line.detail or line.reason)), ("blobs", Text(str(line.blob_count)))]
    assert line.pose is not None
    angles_rad = line.euler_zyx_rad
    assert angles_rad is not None
    position = [mm_from_m(float(value)) for value in line.pose.t_m]
    attitude = [deg_from_rad(value) for value in angles_rad]
    sigma = None if line.position_sigma_m is None else [mm_from_m(float(value)) for value in line.position_sigma_m]
    turn = None if line.rotation_sigma_rad is None else [deg_from_rad(float(v)) for v in line.rotation_sigma_rad]
    rows += [
        ("x y z", _numbers(position, sigma, "mm", 2)),
        ("yaw p r", _numbers(attitude, None, "deg", 3)),
    ]
    if turn is not None:
        rows.append(("σ turn", _numbers(turn, None, "deg", 3)))
    if line.status == "ok":
        margin = f"{line.margin:.3g}" if isfinite(line.margin) else "no runner-up"
        fit = f"rms {line.rms_px:.3f} px  margin {margin}  blobs {line.blob_count}"
        rows.append(("fit", Text(fit)))
    return rows


def _numbers(values: Sequence[float], sigmas: Sequence[float] | None, unit: str, digits: int) -> Text:
    text = Text()
    for k, value in enumerate(values):
        text.append(f"{value:{digits + 6}.{digits}f}")
        if sigmas is not None:
            text.append(f" ±{sigmas[k]:.{digits}f}", style="dim")
    return text.append(f" {unit}", style="dim")


def _curve(past: Sequence[PastPoint], width: int) -> Text:
    ranges = [sum(value * value for value in point.t_m) ** 0.5 for point in past]
    seen = [value for value in ranges[-width:] if isfinite(value)]
    text = Text(sparkline(ranges, width), style="cyan", no_wrap=True)
    if seen:
        text.append(f" {mm_from_m(min(seen)):.1f} to {mm_from_m(max(seen)):.1f} mm", style="dim")
    return text


def _counts(shown: Shown) -> Text:
    of_all = "" if shown.total is None else f" of {shown.total}"
    text = Text(f"{shown.captures}{of_all}, {shown.poses} with a pose")
    if shown.dropped:
        text.append(f", {shown.dropped} dropped", style="yellow")
    return text


def _pace(shown: Shown, *, is_over: bool) -> Text:
    text = Text(f"{shown.rate_hz:.1f} Hz  solved in {ms_from_s(shown.work_s):.1f} ms")
    if shown.latency_s is not None:
        text.append(f"  latency {ms_from_s(shown.latency_s):.1f} ms")
    if shown.capture.exposure_s is not None:
        text.append(f"  exposure {ms_from_s(shown.capture.exposure_s):.3g} ms")
    age_s = monotonic() - shown.shown_s
    if age_s > _STALE_S and not is_over:
        text.append(f"  nothing new for {age_s:.0f} s", style="bold red")
    return text
