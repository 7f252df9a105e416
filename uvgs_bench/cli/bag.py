"""``uvgs bag``: what is in ROS bags, are they healthy, convert them, extract their pictures."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from uvgs_bench.cli.options import Force, Json, Quiet
from uvgs_bench.errors import ExitCode

_HELP = "Look into ROS bags, check, convert and extract them; ROS itself is not needed."
app = typer.Typer(no_args_is_help=True, help=_HELP)

Bags = Annotated[
    list[Path],
    typer.Argument(help="ROS 1 bags, MCAP or SQLite files of ROS 2, or rosbag2 folders; several are read as one."),
]
Topic = Annotated[str, typer.Option("--topic", help="Topic of the pictures, its end, or the camera's namespace.")]


@app.callback()
def bag() -> None:
    """Look into ROS bags, check, convert and extract them; ROS itself is not needed."""


@app.command("info")
def info(bags: Bags, as_json: Json = False) -> None:
    """Topics, types, counts, rates, span, size, compression, pictures; and what is damaged."""
    from uvgs_bench.cli.bag_tables import print_info
    from uvgs_bench.cli.console import emit_json
    from uvgs_bench.sessions.bag_info import describe_bags

    found = describe_bags(bags)
    if as_json:
        emit_json(asdict(found) | {"duration_s": found.duration_s})
    else:
        print_info(found)


@app.command("check")
def check(
    bags: Bags,
    camera: Annotated[
        Path | None, typer.Option("--camera", help="Calibration that the pictures and landmarks are compared with.")
    ] = None,
    topic: Topic = "",
    min_landmarks: Annotated[
        int, typer.Option("--min-landmarks", min=1, help="min_num_matches_per_measurement of Astrobee's localizer.")
    ] = 5,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Stamps, drops, clocks, pictures, lenses, Astrobee landmarks: healthy (exit code 0), not (1), inconclusive (3)."""
    from uvgs_bench.cli.bag_tables import print_health
    from uvgs_bench.cli.console import emit_json, progress_sink
    from uvgs_bench.interop.astrobee import LocalizerSettings
    from uvgs_bench.sessions.bag_check import check_bags
    from uvgs_bench.sessions.camera_tools import read_camera
    from uvgs_bench.sessions.interruption import interruptible

    calibration = None if camera is None else read_camera(camera)
    with progress_sink(quiet=quiet) as sink, interruptible():
        settings = LocalizerSettings(min_landmarks=min_landmarks)
        found = check_bags(bags, sink, topic=topic, calibration=calibration, settings=settings)
    if as_json:
        emit_json({"verdict": found.verdict} | asdict(found))
    else:
        print_health(found)
    codes = {"healthy": ExitCode.DONE, "not_healthy": ExitCode.LIMITS_MISSED, "inconclusive": ExitCode.INCONCLUSIVE}
    raise typer.Exit(int(codes[found.verdict]))


@app.command("convert")
def convert(
    bags: Bags,
    out: Annotated[
        Path,
        typer.Option("--out", help="New bag: .bag is ROS 1, .mcap and .db3 ROS 2, a name without ending a folder."),
    ],
    compression: Annotated[
        Literal["none", "bz2", "lz4", "zstd", "messages", "file"],
        typer.Option("--compression", help="bz2, lz4: .bag; zstd: .mcap, folders; messages, file (zstd): folders."),
    ] = "none",
    storage: Annotated[Literal["mcap", "sqlite3"], typer.Option("--storage", help="Storage of a folder.")] = "mcap",
    topic: Annotated[list[str] | None, typer.Option("--topic", help="Only this topic; may be repeated.")] = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write bags anew in another container, compression or ROS; several become one. The originals stay."""
    from uvgs_bench.cli.console import emit_json, print_path, progress_sink
    from uvgs_bench.cli.console import out as printed
    from uvgs_bench.sessions.bag_convert import convert_bags
    from uvgs_bench.sessions.interruption import interruptible

    with progress_sink(quiet=quiet) as sink, interruptible():
        done = convert_bags(bags, out, sink, compression=compression, storage=storage, topics=topic or (), force=force)
    if as_json:
        emit_json(asdict(done))
        return
    printed.print(f"{done.kind}: {done.messages} messages of {len(done.topics)} topics", soft_wrap=True)
    print_path("written", done.path)


@app.command("extract")
def extract(
    bags: Bags,
    out: Annotated[Path, typer.Option("--out", help="Folder for the pictures (PNG) and stamps.csv.")],
    topic: Topic = "",
    stamps: Annotated[
        Literal["header", "log"], typer.Option("--stamps", help="Instants: of the headers, or the bag's own times.")
    ] = "header",
    every: Annotated[int, typer.Option("--every", min=1, help="Take every N-th picture only.")] = 1,
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Take at most so many pictures.")] = None,
    force: Force = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Write the pictures of a topic as PNG with their instants; uvgs run images:FOLDER gives the same poses."""
    from uvgs_bench.cli.console import emit_json, print_path, progress_sink
    from uvgs_bench.cli.console import out as printed
    from uvgs_bench.devices.cameras.bag import BagImages
    from uvgs_bench.sessions.bag_extract import extract_pictures
    from uvgs_bench.sessions.interruption import interruptible

    with (
        BagImages.of(bags, topic=topic, is_log_time=stamps == "log") as source,
        progress_sink(quiet=quiet) as sink,
        interruptible(),
    ):
        done = extract_pictures(source, out, sink, every=every, limit=limit, force=force)
    if as_json:
        emit_json(asdict(done))
    else:
        printed.print(f"{done.pictures} {'picture' if done.pictures == 1 else 'pictures'}")
        print_path("written", done.folder)
    raise typer.Exit(int(ExitCode.DONE if done.pictures else ExitCode.INPUT))
