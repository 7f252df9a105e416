"""Registering a bench without its sensor: a run whose kept pictures show a board that rides where the beacon rides."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uvgs_bench.accuracy.board_poses import solve_board
from uvgs_bench.accuracy.independent import BoardLink, Independent
from uvgs_bench.accuracy.observations import Observations, Role
from uvgs_bench.accuracy.registration import fit_registration
from uvgs_bench.camera.boards import Board, BoardMiss, find_board
from uvgs_bench.errors import RunError
from uvgs_bench.geometry import read_only
from uvgs_bench.sessions.stream import read_run_captures, run_captures
from uvgs_bench.store.observations import observations_from_run
from uvgs_bench.store.run_writer import SETUP_CALIBRATION

if TYPE_CHECKING:
    from uvgs_bench.store.run_types import Run


def board_observations(run: Run, board: Board) -> Observations:
    """Where a board was seen at every capture of a run, as observations of it in the beacon's stead.

    Args:
        run: A run whose pictures were kept.
        board: The board.

    Returns:
        One row per sample; rows of pictures that do not show the board well are misses.

    Raises:
        RunError: The run kept no pictures, or none shows the board.
    """
    obs = observations_from_run(run)
    N = obs.count
    R, t_m, covariance = np.full((N, 3, 3), np.nan), np.full((N, 3), np.nan), np.full((N, 6, 6), np.nan)
    reason = ["board/no_picture"] * N
    kept = run_captures(run)
    for (i, name), capture in zip(kept, read_run_captures(run), strict=True):
        view = find_board(capture.image, board, name)
        if isinstance(view, BoardMiss):
            reason[i] = f"board/{view.reason}"
            continue
        solved = solve_board(view, run.calibration.lens)
        if solved is None:
            reason[i] = "board/ambiguous"
            continue
        reason[i] = ""
        R[i], t_m[i], covariance[i] = solved[0].R, solved[0].t_m, solved[1]
    if "" not in reason:
        raise RunError(f"none of its {len(kept)} kept pictures shows the board {board.name}", str(run.path))
    roles: tuple[Role, ...] = tuple("register" for _ in range(N))
    return replace(
        obs,
        role=roles,
        R_cb=read_only(R),
        t_cb_m=read_only(t_m),
        covariance=read_only(covariance),
        is_solved=np.array([not text for text in reason]),
        reason=tuple(reason),
        is_saturated=np.empty(0, dtype=np.bool_),
        rms_px=np.empty(0),
        blob_count=np.empty(0, dtype=np.int64),
        beacon_covariance=np.empty(0),
        calibration_covariance=np.empty(0),
        led_px=np.empty(0),
    )


def register_by_board(
    board_run: Run, board: Board, link: BoardLink, *, judged: Run, terms: tuple[str, ...] = ()
) -> Independent:
    """Register a bench by a board.

    Args:
        board_run: The run whose pictures show the board; may be the judged one.
        board: The board.
        link: How the beacon sits on it.
        judged: The run that will be judged by it.
        terms: Terms that may be fitted beside the poses.

    Returns:
        The registration.

    Raises:
        RunError: The runs are not of one bench, or the pictures do not show the board.
        RegistrationError: Too few places, or a carriage that did not move.
    """
    a, b = board_run.manifest, judged.manifest
    if a.mount != b.mount or len(a.axes) != len(b.axes):
        raise RunError(f"is of another bench than {judged.path}: other axes or mount", str(board_run.path))
    if a.hashes.get(SETUP_CALIBRATION) != b.hashes.get(SETUP_CALIBRATION):
        raise RunError(f"was taken with another camera calibration than {judged.path}", str(board_run.path))
    obs = board_observations(board_run, board)
    return Independent(fit_registration(obs, gantry_sigma_m=a.gantry_sigma_m, terms=terms), link)
