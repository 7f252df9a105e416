"""Options of ``uvgs run`` about looking at it while it runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from uvgs_bench.errors import ConfigError

_PANEL = "Watching"
VIEW_PORT, FOXGLOVE_PORT = 8700, 8765
_PORT_HELP = "0 takes a free one."

View = Annotated[
    bool,
    typer.Option("--view", help="Serve a page on 127.0.0.1: picture, pose, curves, sliders.", rich_help_panel=_PANEL),
]
ViewPort = Annotated[
    int | None,
    typer.Option(
        "--view-port", min=0, max=65535, help=f"Port of --view, {VIEW_PORT} else; {_PORT_HELP}", rich_help_panel=_PANEL
    ),
]
Foxglove = Annotated[
    bool,
    typer.Option(
        "--foxglove", help="Serve the same to Foxglove and Lichtblick (extra 'live').", rich_help_panel=_PANEL
    ),
]
FoxglovePort = Annotated[
    int | None,
    typer.Option(
        "--foxglove-port",
        min=0,
        max=65535,
        help=f"Port of --foxglove, {FOXGLOVE_PORT} else; {_PORT_HELP}",
        rich_help_panel=_PANEL,
    ),
]
SnapshotFolder = Annotated[
    Path | None,
    typer.Option(
        "--snapshots", metavar="DIR", help="Where the page's snapshots go, reports/ else.", rich_help_panel=_PANEL
    ),
]
AllowMotion = Annotated[
    Path | None,
    typer.Option(
        "--allow-motion",
        metavar="BENCH",
        help="Let the page home and jog the gantry of a bench file. Opening its port resets the controller.",
        rich_help_panel=_PANEL,
    ),
]


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """What the command line says about looking.

    Args:
        view: Whether a page is served.
        view_port: Its port, or None for the usual.
        foxglove: Whether Foxglove is served.
        foxglove_port: Its port, or None for the usual.
        snapshots: Folder of snapshots, or None for the usual.
        allow_motion: Bench file of the gantry that the page may move, or None.
        rate_hz: Most captures a second that are shown there, or None.

    Raises:
        ConfigError: An option has nothing to act on.
    """

    view: bool = False
    view_port: int | None = None
    foxglove: bool = False
    foxglove_port: int | None = None
    snapshots: Path | None = None
    allow_motion: Path | None = None
    rate_hz: float | None = None

    def __post_init__(self) -> None:
        for option, value, needed, is_there in (
            ("--view-port", self.view_port, "--view", self.view),
            ("--snapshots", self.snapshots, "--view", self.view),
            ("--allow-motion", self.allow_motion, "--view", self.view),
            ("--foxglove-port", self.foxglove_port, "--foxglove", self.foxglove),
        ):
            if value is not None and not is_there:
                raise ConfigError(f"needs {needed}", option)

    @property
    def is_served(self) -> bool:
        """Whether anyone but the terminal is shown anything."""
        return self.view or self.foxglove
