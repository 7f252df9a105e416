"""How a run is registered: options of every command that judges a run, and what they mean."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from uvgs_bench.errors import ConfigError

if TYPE_CHECKING:
    from uvgs_bench.accuracy import Judgement
    from uvgs_bench.store.run_types import Run


class Term(StrEnum):
    """What may be fitted beside the two poses."""

    AXIS_SCALE = "axis_scale"
    SQUARENESS = "squareness"
    TIME_OFFSET = "time_offset"
    TIME_RATE = "time_rate"


_PANEL = "Registration"
Terms = Annotated[
    list[Term] | None,
    typer.Option(
        "--terms", help="Fit this, too, if the data ask for it; may be given several times.", rich_help_panel=_PANEL
    ),
]
BoardFile = Annotated[
    Path | None,
    typer.Option(
        "--board",
        help="Register by this board on the carriage, not by the sensor's poses.",
        rich_help_panel=_PANEL,
        show_default=False,
    ),
]
LinkFile = Annotated[
    Path | None,
    typer.Option(
        "--link",
        help="With --board: where the beacon sits on the board, as measured.",
        rich_help_panel=_PANEL,
        show_default=False,
    ),
]
BoardRun = Annotated[
    Path | None,
    typer.Option(
        "--board-run",
        help="With --board: run whose pictures show it.",
        rich_help_panel=_PANEL,
        show_default="RUN",
    ),
]


def judge_registered(
    run: Run,
    seed: int | None,
    terms: list[Term] | None,
    board_file: Path | None,
    link_file: Path | None,
    board_run: Path | None,
) -> Judgement:
    """Judge a run, registered as the options ask.

    Args:
        run: The run.
        seed: Seed of the intervals, or None for the run's own.
        terms: Terms that may be fitted beside the poses.
        board_file: File of the board that registers, or None for the sensor's own poses.
        link_file: File that says where the beacon sits on the board.
        board_run: Folder of the run whose pictures show the board, or None for the judged one.

    Returns:
        The judgement.

    Raises:
        ConfigError: Half of a board's options, or a file that cannot be meant.
        RunError: The pictures do not show the board, or are of another bench.
        RegistrationError: Too few places show it.
    """
    from uvgs_bench.store.judging import judge_run

    asked = tuple(term.value for term in terms or ())
    if board_file is None:
        if link_file is not None or board_run is not None:
            raise ConfigError("needs --board, the board that rides the carriage", key="--link --board-run")
        return judge_run(run, seed=seed, terms=asked)
    if link_file is None:
        raise ConfigError("needs --link, where the beacon sits on the board and who measured it", key="--board")
    from uvgs_bench.sessions.register import register_by_board
    from uvgs_bench.store.board_links import read_board_link
    from uvgs_bench.store.boards import read_board
    from uvgs_bench.store.run import read_run

    board = read_board(board_file)
    link = read_board_link(link_file, board.name, run.beacon.name)
    shows = run if board_run is None else read_run(board_run)
    by_board = register_by_board(shows, board, link, judged=run, terms=asked)
    return judge_run(run, seed=seed, terms=asked, independent=by_board)
