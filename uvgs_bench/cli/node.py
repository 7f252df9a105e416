"""``uvgs node``: the sensor as a node of ROS 1 or ROS 2."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from uvgs_bench.cli.options import Quiet
from uvgs_bench.errors import ConfigError, ExitCode

_PUBLISHED = "What is published"
_FOREVER_S = 1e9


def node(
    context: typer.Context,
    ros1: Annotated[bool | None, typer.Option("--ros1/--ros2", help="Which ROS.")] = None,
    image: Annotated[str, typer.Option("--image", help="Topic of the pictures; the only one when left out.")] = "",
    camera: Annotated[
        Path | None, typer.Option("--camera", help="Calibration; else the CameraInfo beside the pictures.")
    ] = None,
    beacon: Annotated[list[Path] | None, typer.Option("--beacon", help="Beacon; may be repeated.")] = None,
    config: Annotated[Path | None, typer.Option("--config", help="Sensor parameters, TOML.")] = None,
    name: Annotated[str, typer.Option("--name", help="Name of the node.")] = "uvgs",
    track: Annotated[
        bool, typer.Option("--track/--no-track", help="Look for the LEDs where the last pose puts them.")
    ] = True,
    hold_s: Annotated[
        float | None, typer.Option("--hold-s", min=0.0, help="Say so long that the last pose is held.")
    ] = None,
    frame: Annotated[
        str, typer.Option("--frame", help="Name of the camera's frame.", rich_help_panel=_PUBLISHED)
    ] = "camera",
    annotated: Annotated[
        bool, typer.Option("--annotated", help="Pictures of what the sensor saw.", rich_help_panel=_PUBLISHED)
    ] = False,
    astrobee: Annotated[
        Literal["v1", "v2"] | None,
        typer.Option(
            "--astrobee", help="VisualLandmarks of Astrobee, in the older or newer form.", rich_help_panel=_PUBLISHED
        ),
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option("--rate-hz", min=0.1, help="Publish no more answers a second.", rich_help_panel=_PUBLISHED),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Solve the pictures of a topic and publish poses, transforms and diagnostics under /uvgs, until Ctrl-C.

    Every parameter of the sensor is a private parameter of the node and may be changed while it runs.

    Remappings (NAME:=VALUE) and what follows --ros-args are handed to ROS.
    """
    from contextlib import ExitStack
    from functools import partial
    from time import perf_counter

    from uvgs_bench.cli.console import progress_sink
    from uvgs_bench.cli.run_setup import handover_policy, lens_of, open_captures, read_setup
    from uvgs_bench.cli.run_summary import show_summary
    from uvgs_bench.devices.ros import RosMessages, open_ros
    from uvgs_bench.interop.bag_writer import BagContents, BagPoses
    from uvgs_bench.sensor.uvgs import Uvgs
    from uvgs_bench.sessions.debug_images import draw_debug_image
    from uvgs_bench.sessions.events import Remark
    from uvgs_bench.sessions.interruption import interruptible
    from uvgs_bench.sessions.outlets import Outlet, Outlets, PoseFile
    from uvgs_bench.sessions.retune import Retuner, ros_parameters
    from uvgs_bench.sessions.stream import StreamRules, solve_source
    from uvgs_bench.sessions.tally import Tally
    from uvgs_bench.sessions.telemetry import RateLimited

    if ros1 is None:
        raise ConfigError("is needed: --ros1 or --ros2", "--ros1/--ros2")
    if not beacon:
        raise ConfigError("is needed", "--beacon")
    version: Literal["ros1", "ros2"] = "ros1" if ros1 else "ros2"
    with ExitStack() as stack:
        sink = stack.enter_context(progress_sink(quiet=quiet))
        stack.enter_context(interruptible())
        door = open_ros(version, name, _ros_arguments(context.args))
        stack.callback(door.close)
        tally = None
        try:
            known, beacons, parameters = read_setup(None, camera, beacon, config)
            sink(Remark("info", f"waiting for pictures on {image or 'a topic'}"))
            opened = open_captures(f"{version}:{image}?wait_s={_FOREVER_S:g}", None, stack, sink, 0.0)
            assert opened.live is not None
            calibration = lens_of(opened) if known is None else known
            sensors = {lights.name: Uvgs(calibration, lights, parameters, clock=perf_counter) for lights in beacons}
            tuner = Retuner(sensors, parameters, perf_counter)
            door.offer_parameters(ros_parameters(parameters), tuner.ask)
            tuner.apply()
            annotate = {n: partial(draw_debug_image, uvgs=u) for n, u in sensors.items()} if annotated else {}
            lights = {lights.name: lights for lights in beacons}
            contents = BagContents(calibration.lens, lights, astrobee, annotate=annotate)
            messages = RosMessages(door, version=astrobee, camera_frame=frame)
            outlet: Outlet = PoseFile(BagPoses(messages, contents))
            outlets = Outlets([outlet if rate_hz is None else RateLimited(outlet, rate_hz)], sink)
            for uvgs in sensors.values():
                uvgs.warm_up()
            names = tuple(sensors)
            tally = Tally(names)
            rules = StreamRules(track=track, handover=handover_policy("quality", [], hold_s, names, None))
            stream = solve_source(opened.captures, sensors, sink, rules, flags_of=opened.live.flags_of, is_live=True)
            sink(Remark("info", f"publishing under /uvgs as {door.name}"))
            for answered in stream:
                tally.take(answered.lines, opened.live.age_s(answered.capture))
                outlets.put(answered)
                if tuner.apply():
                    sink(Remark("info", "parameters changed"))
            tally.dropped = opened.live.dropped
        except KeyboardInterrupt:
            # How a node is meant to end.
            pass
    if tally is None:
        raise typer.Exit(int(ExitCode.DONE))
    show_summary(tally, (), timing=False, as_json=False)
    raise typer.Exit(int(ExitCode.DONE))


def _ros_arguments(left: list[str]) -> list[str]:
    """Remappings, and what follows ``--ros-args``."""
    own, mark, rest = left, "--ros-args", []
    if mark in left:
        place = left.index(mark)
        own, rest = left[:place], left[place + 1 :]
    for word in own:
        if ":=" not in word or word.startswith("-"):
            raise ConfigError(f"unknown argument '{word}'; see uvgs node --help", "uvgs node")
    return [*own, *rest]
