"""A registration that owes nothing to the sensor: a board rides where the beacon rides, and pictures of it register.

The sensor's constant errors then stay in its errors instead of hiding in the place of camera or beacon. What links the
board to the beacon is measured elsewhere; its doubt, and that of every other link, is said.

What stays hidden: an error of the lens moves board and beacon alike, so the part of it that both share cancels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.registration import Registration
from uvgs_bench.accuracy.tangent import hats
from uvgs_bench.geometry import FloatArray, Pose, read_only


@dataclass(frozen=True, slots=True)
class Link:
    """One link of the chain from the camera to the beacon.

    Args:
        name: What is linked, for tables.
        position_sigma_m: What its doubt adds to the predicted place of the beacon, root of the trace of the
            covariance, RMS over captures, m; NaN when nothing is stated.
        attitude_sigma_rad: The same of the predicted attitude, rad.
        source: Where that is known from, one line.
        is_independent: Whether it owes nothing to the sensor under test.
    """

    name: str
    position_sigma_m: float
    attitude_sigma_rad: float
    source: str
    is_independent: bool


@dataclass(frozen=True, slots=True, eq=False)
class BoardLink:
    """How the beacon sits on the board, as measured without the sensor.

    Args:
        board_from_beacon: The pose.
        covariance: Covariance of its left tangent, board axes, shape (6, 6), rad and m.
        source: Who measured it, one line.
    """

    board_from_beacon: Pose
    covariance: FloatArray
    source: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", read_only(self.covariance, (6, 6)))


@dataclass(frozen=True, slots=True, eq=False)
class Independent:
    """A registration by a board, and what links it to the beacon.

    Args:
        board: The registration of the board in the beacon's stead: its right pose ends at the board.
        link: From there to the beacon.
    """

    board: Registration
    link: BoardLink

    def registration(self) -> Registration:
        """The registration of the beacon: the board's with the link behind it, and the link's doubt in it."""
        right = self.board.right
        to_board = Pose(right.R, right.t_m, right.target, "board")
        factor = np.zeros((12, 6))
        factor[6:] = to_board.adjoint() @ _root(self.link.covariance)
        known = self.board.term_factor
        if known.size:
            padded = np.concatenate([factor, np.zeros((len(known) - 12, 6))])
            known = np.concatenate([known, padded], axis=1)
        return replace(
            self.board,
            right=to_board @ self.link.board_from_beacon,
            covariance=read_only(self.board.covariance + factor @ factor.T),
            term_factor=read_only(known),
        )

    def links(self, obs: Observations) -> tuple[Link, ...]:
        """The chain, with what each link's doubt does to the predictions.

        Args:
            obs: Captures that judge.

        Returns:
            The links, from the camera to the beacon.
        """
        whole = self.registration()
        _, t_m = whole.predict(obs)
        by_board = self.board.prediction_factor(obs)
        J = whole.prediction_jacobian(obs)[:, :, 6:]
        right = self.board.right
        by_link = J @ (Pose(right.R, right.t_m, right.target, "board").adjoint() @ _root(self.link.covariance))
        rider = "gantry" if obs.mount == "beacon_on_carriage" else "carriage"
        return (
            _link(
                f"camera_from_{rider} and {right.target}_from_board",
                by_board,
                t_m,
                f"{self.board.station_count} places of the board, seen through the same lens as the beacon",
            ),
            _carriage_link(whole, obs, t_m),
            _link("board_from_beacon", by_link, t_m, self.link.source),
        )


def links_of(registration: Registration, obs: Observations) -> tuple[Link, ...]:
    """The chain of a registration that the sensor's own poses made.

    Args:
        registration: The registration.
        obs: Captures that judge.

    Returns:
        The links; constant errors of the sensor are inside the first.
    """
    _, t_m = registration.predict(obs)
    left, right = registration.left, registration.right
    return (
        replace(
            _link(
                f"{left.target}_from_{left.source} and {right.target}_from_{right.source}",
                registration.prediction_factor(obs),
                t_m,
                f"poses of the sensor itself at {registration.station_count} places: constant errors of the sensor are "
                "inside",
            ),
            is_independent=False,
        ),
        _carriage_link(registration, obs, t_m),
    )


def _carriage_link(registration: Registration, obs: Observations, t_m: FloatArray) -> Link:
    carriage = np.zeros((obs.count, 6, 3))
    carriage[:, 3:] = registration.gantry_sigma_m * np.eye(3)
    return _link("gantry_from_carriage", carriage, t_m, "position_sigma_mm of the bench file")


def _link(name: str, factor: FloatArray, t_m: FloatArray, source: str) -> Link:
    """Size of a doubt of the left tangents of predictions, factors (N, 6, K)."""
    # Left tangent to translation in camera axes: dt = v + omega x t.
    shift = factor[:, 3:] - hats(t_m) @ factor[:, :3]
    sizes = [float(np.sqrt((part**2).sum(axis=(1, 2)).mean())) for part in (shift, factor[:, :3])]
    return Link(name, sizes[0], sizes[1], source, True)


def _root(covariance: FloatArray) -> FloatArray:
    """A factor F of a covariance that may be singular: it is ``F F^T``."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
