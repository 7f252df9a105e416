"""``uvgs benchmark calibration``: how long a calibration takes, next to OpenCV."""

from __future__ import annotations

from typing import Annotated

import typer

from uvgs_bench.cli.options import Json, Quiet, Seed


def calibration(
    repeats: Annotated[int, typer.Option("--repeats", min=1, help="How often each calibrates the smaller set.")] = 15,
    seed: Seed = 0,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Time a calibration on drawn corners next to cv2.calibrateCamera on the same corners; processor time."""
    from dataclasses import asdict

    from uvgs_bench.cli.console import emit_json, out, progress_sink
    from uvgs_bench.sessions.calibration_benchmark import PEER, benchmark_calibration
    from uvgs_bench.units import ms_from_s

    with progress_sink(quiet=quiet) as sink:
        found = benchmark_calibration(sink, repeats=repeats, seed=seed)
    if as_json:
        emit_json({"seed": seed, "repeats": repeats, **asdict(found)})
        return
    out.print(f"{found.views} views of {found.corners} corners, plumb_bob, processor time, least of {repeats}")
    out.print(f"  fit with covariance    {ms_from_s(found.fit_s):8.1f} ms")
    out.print(f"  {PEER:<22} {ms_from_s(found.peer_s):8.1f} ms, without covariance")
    out.print(f"  ours over OpenCV's     {found.ratio:8.2f}    median of pairs")
    out.print(f"  RMS differ by          {found.rms_difference_px:8.0e} px")
    out.print(f"  with verdict           {ms_from_s(found.whole_s):8.1f} ms")
    out.print(
        f"{found.large_views} views of {found.large_corners} corners, rational_polynomial, "
        f"{found.large_parameters} parameters"
    )
    out.print(f"  fit with covariance    {ms_from_s(found.large_fit_s):8.0f} ms")
    out.print(f"  with verdict           {ms_from_s(found.large_whole_s):8.0f} ms")
