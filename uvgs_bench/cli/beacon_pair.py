"""``uvgs beacon pair``: how constant the pose between two beacons on one rigid piece stays."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import Json, Seed


def pair(
    poses: Annotated[Path, typer.Argument(help="Poses of uvgs run with two beacons, CSV.")],
    first: Annotated[
        str, typer.Option("--first", help="Beacon whose frame is taken.", show_default="the file's first")
    ] = "",
    second: Annotated[str, typer.Option("--second", help="The other beacon.", show_default="the file's other")] = "",
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Judge a sensor by two beacons held rigidly: whatever varies between them is error, also in motion."""
    compute_on_one_core()
    from dataclasses import asdict

    from uvgs_bench.cli.console import emit_json, out
    from uvgs_bench.sessions.two_beacons import judge_two_beacons
    from uvgs_bench.units import deg_from_rad, mm_from_m

    found = judge_two_beacons(poses, first, second, seed)
    scales = {"m": ("mm", mm_from_m(1.0)), "rad": ("deg", deg_from_rad(1.0))}
    if as_json:
        emit_json(
            {
                "schema": 1,
                "first": found.first,
                "second": found.second,
                "captures_with_both": found.together,
                "captures": found.captures,
                "worth_captures": found.independent,
                "position_mm": mm_from_m(found.mean.t_m).tolist(),
                "quaternion_xyzw": found.mean.quaternion_xyzw().tolist(),
                **{
                    f"{q.key}_{scales[q.unit][0]}": asdict(q.estimate.scaled(scales[q.unit][1]))
                    for q in found.quantities
                },
            }
        )
        return
    x, y, z = mm_from_m(found.mean.t_m)
    out.print(f"{found.second} in the frame of {found.first}: {x:.3f}, {y:.3f}, {z:.3f} mm on average", markup=False)
    out.print(
        f"{found.together} of {found.captures} captures show both, worth {found.independent:.0f} independent ones"
    )
    for q in found.quantities:
        unit, factor = scales[q.unit]
        e = q.estimate.scaled(factor)
        note = f", {e.note}" if e.note else ""
        out.print(f"{q.name}: {e.value:.4g} {unit} ({e.low:.4g} to {e.high:.4g}){note}", soft_wrap=True, markup=False)
    out.print(f"Source: {found.quantities[0].source}. An error that both beacons share does not show.", soft_wrap=True)
