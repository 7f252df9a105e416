"""``uvgs register``: how the frames of a run sit together, and how well the data tell."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import Force, IntervalSeed, Json
from uvgs_bench.cli.registering import BoardFile, BoardRun, LinkFile, Terms, judge_registered
from uvgs_bench.errors import RegistrationError

if TYPE_CHECKING:
    from uvgs_bench.accuracy import Judgement, Registration


def register(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    terms: Terms = None,
    board_file: BoardFile = None,
    link_file: LinkFile = None,
    board_run: BoardRun = None,
    out_file: Annotated[Path | None, typer.Option("--out", help="Write the registration as TOML.")] = None,
    force: Force = False,
    seed: IntervalSeed = None,
    as_json: Json = False,
) -> None:
    """Register camera, gantry and beacon of a run; say what is seen, what is not, and what errors remain."""
    compute_on_one_core()
    from uvgs_bench.cli.console import emit_json, print_path
    from uvgs_bench.store.registrations import registration_tables, write_registration
    from uvgs_bench.store.run import read_run

    found = read_run(run)
    judgement = judge_registered(found, seed, terms, board_file, link_file, board_run)
    registration = judgement.registration
    if registration is None:
        raise RegistrationError(next(alert.text for alert in judgement.alerts if alert.level == "error"))
    if out_file is not None:
        write_registration(out_file, registration, found.manifest.id, force=force)
    if as_json:
        emit_json(
            registration_tables(registration, found.manifest.id)
            | {"split": judgement.split, "links": [_plain(link) for link in judgement.links]}
            | _errors(judgement)
        )
        return
    _print_registration(judgement)
    if out_file is not None:
        print_path("written", out_file)


def _plain(value: Any) -> dict[str, Any]:
    from dataclasses import asdict

    return asdict(value)


def _errors(judgement: Judgement) -> dict[str, Any]:
    """RMS figures in sample and held out, with intervals, in mm and degrees."""
    from uvgs_bench.units import deg_from_rad, mm_from_m

    figures: dict[str, Any] = {}
    for key, summary in (("in_sample", judgement.in_sample_summary), ("held_out", judgement.summary)):
        if summary is None:
            figures[key] = None
            continue
        position, attitude = summary.components["position"].rms, summary.components["attitude"].rms
        in_mm, in_deg = position.scaled(mm_from_m(1.0)), attitude.scaled(deg_from_rad(1.0))
        figures[key] = {
            "stations": summary.station_count,
            "captures": summary.capture_count,
            "position_rms_mm": [in_mm.value, in_mm.low, in_mm.high],
            "attitude_rms_deg": [in_deg.value, in_deg.low, in_deg.high],
        }
    return figures


def _term_lines(registration: Registration) -> list[str]:
    """Fitted terms with half of their 95 % intervals."""
    from uvgs_bench.units import mrad_from_rad, ms_from_s, percent_from_fraction

    lines = []
    axes = registration.axis_terms
    if axes is not None:
        for k, axis in enumerate("xyz"):
            value, half = (percent_from_fraction(float(v[k])) for v in (axes.scale, axes.half_widths))
            lines.append(f"axis {axis} travels {value:.4f} ± {half:.4f} % farther" if half else f"axis {axis} held")
        for k, pair in enumerate(("xy", "xz", "yz")):
            value, half = (mrad_from_rad(float(v)) for v in (axes.shear_rad[k], axes.half_widths[3 + k]))
            lines.append(f"axes {pair} lean {value:.3f} ± {half:.3f} mrad" if half else f"axes {pair} held")
    if registration.time_offset_s is not None:
        found = registration.time_offset_s.scaled(ms_from_s(1.0))
        lines.append(f"captures are stamped {found.value:.2f} ms late ({found.low:.2f} to {found.high:.2f})")
    return lines


def _print_registration(judgement: Judgement) -> None:
    from rich.markup import escape

    from uvgs_bench.cli.console import out
    from uvgs_bench.geometry.se3 import euler_zyx_from_rotation, is_near_gimbal_lock
    from uvgs_bench.units import deg_from_rad, mm_from_m

    registration = judgement.registration
    assert registration is not None
    for pose, (turn, shift) in (
        (registration.left, registration.sigmas("left")),
        (registration.right, registration.sigmas("right")),
    ):
        doubts = [f"± {mm_from_m(float(s)):.3f}" if s > 1e-9 else "held" for s in shift]
        offsets = [
            f"{axis} {round(mm_from_m(float(v)), 3) + 0.0:.3f} {d}"
            for axis, v, d in zip("xyz", pose.t_m, doubts, strict=True)
        ]
        angles = zip(("yaw", "pitch", "roll"), euler_zyx_from_rotation(pose.R), strict=True)
        turns = [f"{deg_from_rad(float(s)):.4f}" for s in turn]
        out.print(f"[bold]{pose.target}_from_{pose.source}[/]")
        out.print(f"  offset mm  {', '.join(offsets)}")
        out.print(f"  turn deg   {', '.join(f'{name} {deg_from_rad(angle):.4f}' for name, angle in angles)} (Z-Y-X)")
        out.print(f"             ± {', '.join(turns)} about {pose.target} x, y, z")
        if is_near_gimbal_lock(pose.R):
            out.print("             pitch beyond 80 deg: only the sum or difference of roll and yaw means anything")
    out.print(f"sees {registration.rank} of 12 directions; gauge: {escape(registration.gauge)}")
    for text in registration.blind_spots:
        out.print(f"- {escape(text)}")
    for note in registration.term_notes:
        out.print(f"- {escape(note)}")
    for line in _term_lines(registration):
        out.print(f"  {line}")
    for link in judgement.links:
        own = "" if link.is_independent else ", not independent of the sensor"
        size = f"± {mm_from_m(link.position_sigma_m):.3f} mm, {deg_from_rad(link.attitude_sigma_rad):.4f} deg"
        out.print(f"link {escape(link.name)}: {size} ({escape(link.source)}{own})")
    out.print(f"{judgement.split}; noise level {registration.variance_factor**0.5:.2f} of what the sensor states")
    for key, figure in _errors(judgement).items():
        if figure is not None:
            mm, deg = figure["position_rms_mm"], figure["attitude_rms_deg"]
            out.print(
                f"{key.replace('_', ' '):<10} RMS {mm[0]:.3f} mm ({mm[1]:.3f} to {mm[2]:.3f}), "
                f"{deg[0]:.4f} deg ({deg[1]:.4f} to {deg[2]:.4f}), {figure['stations']} places"
            )
    for alert in judgement.alerts:
        if alert.level != "note":
            out.print(f"[yellow]{alert.level}:[/] {escape(alert.text)}")
