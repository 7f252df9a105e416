"""``uvgs plan``: propose a procedure for a wanted interval, with what to expect of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.cli.one_core import compute_on_one_core
from uvgs_bench.cli.options import DEFAULT_BENCH, BenchFile, Force, Json, Quiet, Seed

if TYPE_CHECKING:
    from uvgs_bench.devices.bench import Bench
    from uvgs_bench.geometry import Pose
    from uvgs_bench.sessions.plan_advice import Advice, Wish


_NOISE_PX, _PLACE_NOISE_PX = 0.05, 0.03


def plan(
    half_width: Annotated[
        float, typer.Option("--half-width", help="Half of the 95 % interval wanted, in the unit of the quantity.")
    ],
    quantity: Annotated[
        str, typer.Option("--quantity", help="position_rms_mm, depth_rms_mm, attitude_rms_deg, position_p95_mm ...")
    ] = "position_rms_mm",
    bench: BenchFile = DEFAULT_BENCH,
    registration: Annotated[
        Path | None,
        typer.Option(help="Where camera and beacon sit, as uvgs register wrote it; a simulated bench knows."),
    ] = None,
    from_run: Annotated[
        Path | None, typer.Option("--from", help="Learn noise and registration from this run.", show_default=False)
    ] = None,
    noise_px: Annotated[
        float | None,
        typer.Option(
            "--noise-px", help="Noise of a centroid, anew in every capture, px.", show_default="0.05, or learned"
        ),
    ] = None,
    place_noise_px: Annotated[
        float | None,
        typer.Option(
            "--place-noise-px",
            help="Error of a centroid that captures of a place share, px.",
            show_default="0.03, or learned",
        ),
    ] = None,
    out_file: Annotated[Path | None, typer.Option("--out", help="Write the procedure, for uvgs gantry-sweep.")] = None,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Propose the shortest procedure whose interval is narrow enough on nine simulated benches of ten.

    Places are spread over what the gantry reaches and the camera sees; a third registers, the others judge; the order
    is shuffled, and every tenth station returns to the first place, so that a drift shows. Ends with 3 when the
    interval cannot be had.
    """
    compute_on_one_core()
    import math

    from uvgs_bench.cli.console import emit_json, progress_sink
    from uvgs_bench.errors import ConfigError
    from uvgs_bench.sessions.plan_advice import PLANNABLE, Wish, advise, learned_from, procedure_tables
    from uvgs_bench.store.beacons import read_beacon
    from uvgs_bench.store.bench import read_bench
    from uvgs_bench.store.calibrations import read_calibration
    from uvgs_bench.store.documents import check_writable, write_atomically
    from uvgs_bench.store.toml_text import toml_text

    if quantity not in PLANNABLE:
        raise ConfigError(f"must be one of {', '.join(PLANNABLE)}, got '{quantity}'", key="--quantity")
    for key, value, least in (
        ("--half-width", half_width, "positive"),
        ("--noise-px", noise_px, "positive"),
        ("--place-noise-px", place_noise_px, "not negative"),
    ):
        if value is not None and not (
            math.isfinite(value) and (value > 0.0 or (value == 0.0 and least == "not negative"))
        ):
            raise ConfigError(f"must be finite and {least}, got {value}", key=key)
    if out_file is not None:
        check_writable(out_file, force=force)
    setup = read_bench(bench)
    learned = None if from_run is None else learned_from(from_run, setup.mount)
    if learned is not None and registration is None:
        poses = learned.poses
    else:
        poses = _poses(setup, registration)
    if learned is not None:
        noise_px = learned.noise.centroid_sigma_px if noise_px is None else noise_px
        place_noise_px = learned.noise.place_sigma_px if place_noise_px is None else place_noise_px
    wish = Wish(
        quantity,
        half_width,
        _NOISE_PX if noise_px is None else noise_px,
        _PLACE_NOISE_PX if place_noise_px is None else place_noise_px,
        learned.words if learned is not None else "",
    )
    with progress_sink(quiet=quiet) as sink:
        advice = advise(
            setup, read_calibration(setup.camera_file).lens, read_beacon(setup.beacon_file), poses, wish, seed, sink
        )
    if out_file is not None:
        write_atomically(out_file, toml_text(procedure_tables(advice, wish)), force=force)
    if as_json:
        emit_json(_facts(advice, wish) | {"procedure": None if out_file is None else str(out_file)})
    else:
        _print(advice, wish, out_file)


def _poses(bench: Bench, registration: Path | None) -> tuple[Pose, Pose]:
    from uvgs_bench.accuracy.registration import FRAMES_BY_MOUNT
    from uvgs_bench.errors import ConfigError
    from uvgs_bench.store.registrations import read_registered_poses

    if registration is not None:
        return read_registered_poses(registration, bench.mount)
    if bench.simulated is None or not bench.is_simulated:
        raise ConfigError(
            "where the camera stands is not known: register the frames once with a short sweep "
            "(uvgs register RUN --out FILE) and name the file",
            key="--registration",
        )
    left, right = FRAMES_BY_MOUNT[bench.mount]
    return bench.simulated.camera_from_gantry.pose(*left), bench.simulated.carriage_from_beacon.pose(*right)


def _facts(advice: Advice, wish: Wish) -> dict[str, object]:
    from uvgs_bench.accuracy.judgement import QUANTITIES
    from uvgs_bench.units import mm_from_m

    plan, forecast = advice.plan, advice.forecast
    return {
        "quantity": wish.quantity,
        "unit": QUANTITIES[wish.quantity][2],
        "half_width_wanted": wish.half_width,
        "centroid_sigma_px": wish.centroid_sigma_px,
        "place_sigma_px": wish.place_sigma_px,
        "noise_source": wish.source,
        "places": plan.waypoint_count,
        "register_places": plan.register_waypoint_count,
        "stations": len(plan.stations),
        "captures": plan.capture_count,
        "duration_s": plan.duration_s,
        "seen_share": advice.seen_share,
        "range_min_mm": mm_from_m(advice.range_min_m),
        "range_max_mm": mm_from_m(advice.range_max_m),
        "expected_value": forecast.value,
        "expected_half_width": forecast.half_width,
        "expected_half_width_worst_tenth": forecast.half_width_most,
        "reached_benches": forecast.reached,
        "simulated_benches": forecast.benches,
        "expected_availability": forecast.availability,
        "registration_share": forecast.registration_share,
    }


def _print(advice: Advice, wish: Wish, out_file: Path | None) -> None:
    from uvgs_bench.accuracy.judgement import QUANTITIES
    from uvgs_bench.cli.console import out, print_path
    from uvgs_bench.units import mm_from_m

    plan, forecast, unit = advice.plan, advice.forecast, QUANTITIES[wish.quantity][2]
    captures = plan.procedure.captures_per_station
    minutes, seconds = divmod(round(plan.duration_s), 60)
    lines = {
        "places": f"{plan.waypoint_count}, of which {plan.register_waypoint_count} register and the others judge",
        "stations": f"{len(plan.stations)} with returns to the first place, {captures} "
        f"capture{'s' if captures > 1 else ''} each, about {minutes} min {seconds} s",
        "seen": f"all LEDs in {advice.seen_share:.0%} of the reach; places {mm_from_m(advice.range_min_m):.0f} to "
        f"{mm_from_m(advice.range_max_m):.0f} mm away",
        "expected": f"{wish.quantity} {forecast.value:.3g} {unit}, half interval {forecast.half_width:.2g} {unit}, "
        f"{forecast.half_width_most:.2g} {unit} in the worst tenth",
        "reached": f"{wish.half_width:g} {unit} in {forecast.reached} of {forecast.benches} simulated benches",
        "share": f"the registration makes up {forecast.registration_share:.0%} of the squared errors",
        "taken": f"centroid noise {wish.centroid_sigma_px:.3g} px, {wish.place_sigma_px:.3g} px shared by a place"
        + (f" ({wish.source})" if wish.source else "")
        + ", nothing wrong with the bench: a worse sensor has wider intervals",
    }
    for name, text in lines.items():
        out.print(f"{name:<12} {text}", soft_wrap=True)
    if out_file is not None:
        print_path("procedure", out_file)
        print_path("next", f"uvgs gantry-sweep {out_file}")
