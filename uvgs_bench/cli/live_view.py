"""What is seen of ``uvgs run`` while it runs: a panel in the terminal, a page, Foxglove."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from uvgs_bench.cli.view_options import FOXGLOVE_PORT, VIEW_PORT, ViewOptions

if TYPE_CHECKING:
    from uvgs_bench.cli.gantry_door import Setup
    from uvgs_bench.cli.run_setup import OpenedSource
    from uvgs_bench.cli.view_controls import RunControls
    from uvgs_bench.sensor.capture import Capture
    from uvgs_bench.sensor.config import UvgsConfig
    from uvgs_bench.sensor.uvgs import Uvgs
    from uvgs_bench.sessions.events import Event, EventSink
    from uvgs_bench.sessions.stream import Answered
    from uvgs_bench.view.live_state import LiveState

_SENSOR_FILE = Path("reports/sensor.toml")
_SNAPSHOTS = Path("reports")


@contextmanager
def panel_sink(state: LiveState, *, quiet: bool = False) -> Iterator[EventSink]:
    """A sink beside a panel on stderr, or one that writes lines where there is no terminal.

    Args:
        state: What the panel shows.
        quiet: Draw nothing but warnings.

    Yields:
        The sink to hand to the session.
    """
    from uvgs_bench.cli.console import console, progress_sink
    from uvgs_bench.sessions.events import Remark, StageFinished, StageStarted

    if quiet or not console.is_terminal:
        with progress_sink(quiet=quiet) as plain:
            yield plain
        return
    from rich.live import Live
    from rich.markup import escape

    from uvgs_bench.view.terminal import REDRAWS_HZ, LivePanel

    panel = LivePanel(state)

    def draw(event: Event) -> None:
        match event:
            case StageStarted(_, total):
                state.total = total
                panel.waiting = "waiting for the first capture"
            case StageFinished(stage, detail):
                state.end()
                console.print(escape(f"{stage}: {detail}"), soft_wrap=True)
            case Remark(level, text):
                colour = "yellow" if level == "warning" else "cyan"
                console.print(f"[{colour}]{level}:[/] {escape(text)}", soft_wrap=True)
            case _:
                pass

    with Live(panel, console=console, refresh_per_second=REDRAWS_HZ, transient=False):
        yield draw


class LiveOutlet:
    """Shows every answer.

    Args:
        state: Where it is shown.
        opened: The source of the stream.
    """

    def __init__(self, state: LiveState, opened: OpenedSource) -> None:
        self._state = state
        self._live = opened.live

    @property
    def paths(self) -> tuple[Path, ...]:
        """No files."""
        return ()

    def put(self, answered: Answered) -> None:
        """Show an answer."""
        live = self._live
        self._state.put(
            answered.capture,
            answered.lines,
            latency_s=None if live is None else live.age_s(answered.capture),
            dropped=0 if live is None else live.dropped,
        )

    def close(self) -> None:
        """Say that no more come."""
        self._state.end()


def own_twin(source: str, options: ViewOptions, stack: ExitStack) -> tuple[str, Setup | None]:
    """Find the gantry that may be moved; on a simulated bench the camera ``sim:`` looks at that very gantry.

    Args:
        source: The source as written.
        options: What was asked for.
        stack: Ends the simulated bench.

    Returns:
        The source to open, and the gantry or None.

    Raises:
        ConfigError: The bench file is broken or missing.
    """
    if options.allow_motion is None:
        return source, None
    from uvgs_bench.cli.view_motion import found_gantry

    setup = found_gantry(options.allow_motion, stack)
    return (setup.twin.camera_spec if source == "sim:" and setup.twin is not None else source), setup


def open_controls(
    sensors: dict[str, Uvgs],
    parameters: UvgsConfig,
    opened: OpenedSource,
    config: Path | None,
    sink: EventSink,
    clock: Callable[[], float],
    *,
    has_record: bool,
    has_exposure_loop: bool,
) -> RunControls:
    """What the page may change.

    Args:
        sensors: The sensors by beacon.
        parameters: Their parameters.
        opened: The source.
        config: The sensor file, or None.
        sink: Where changes are told.
        clock: Clock of stage times.
        has_record: Whether a record is written or solved again: its parameters must hold for all of it.
        has_exposure_loop: Whether the exposure is set by itself.

    Returns:
        The controls.
    """
    from uvgs_bench.cli.view_controls import RunControls
    from uvgs_bench.sessions.retune import Retuner

    return RunControls(
        Retuner(sensors, parameters, clock),
        opened.exposure,
        _SENSOR_FILE if config is None else config,
        sink,
        fixed="a record holds one set of parameters: change them in a run without it" if has_record else "",
        exposure_fixed="--auto-exposure sets the exposure" if has_exposure_loop else "",
    )


def serve(
    stack: ExitStack,
    options: ViewOptions,
    state: LiveState,
    sensors: dict[str, Uvgs],
    controls: RunControls,
    gantry: Setup | None,
    sink: EventSink,
) -> None:
    """Open the page and Foxglove, if they are wanted.

    Args:
        stack: Closes them; a moving gantry is stopped first.
        options: What was asked for.
        state: What is shown.
        sensors: The sensors by beacon.
        controls: What may be changed.
        gantry: The gantry that may be moved, or None.
        sink: Where their addresses are told.

    Raises:
        ConfigError: A port is taken, or Foxglove's package is missing.
        GantryError: The gantry does not answer.
    """
    if not options.is_served:
        return
    # Here, whole: the stream asks a loaded OpenCV for its threads, and must not meet it half loaded by another thread.
    import cv2  # noqa: F401

    from uvgs_bench.sessions.events import Remark
    from uvgs_bench.view.broadcast import MOST_HZ, Broadcast

    broadcast = Broadcast(state, sensors, min(MOST_HZ, options.rate_hz or MOST_HZ))
    stack.callback(broadcast.close)
    if options.foxglove:
        from uvgs_bench.view.foxglove import FoxgloveServer

        port = FOXGLOVE_PORT if options.foxglove_port is None else options.foxglove_port
        server = FoxgloveServer(broadcast, port)
        stack.callback(server.close)
        sink(Remark("info", f"Foxglove: connect to {server.address}"))
    if options.view:
        from uvgs_bench.view.page import LivePage

        desk = None
        if gantry is not None:
            from uvgs_bench.cli.view_motion import open_desk, shown_gantry

            desk = open_desk(gantry, stack)
            state.gantry = lambda: shown_gantry(desk)
        page = LivePage(
            broadcast,
            controls,
            _SNAPSHOTS if options.snapshots is None else options.snapshots,
            port=VIEW_PORT if options.view_port is None else options.view_port,
            motion=desk,
        )
        stack.callback(page.close)
        # Last in, first out: motion ends before anything else is closed.
        if desk is not None:
            stack.callback(desk.close)
        sink(Remark("info", f"look at {page.address}"))


def all_flags(*sources: Callable[[Capture], tuple[str, ...]] | None) -> Callable[[Capture], tuple[str, ...]]:
    """What all of them say about a capture."""
    asked = [source for source in sources if source is not None]
    return lambda capture: tuple(flag for source in asked for flag in source(capture))
