"""Where the measurement of a beacon starts: packed sightings and values near the minimum."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.beacon.frames import fit_rigid, rigid_motions
from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.beacon.length_row import LengthRow
from uvgs_bench.beacon.network import GantryModel, Network, Sightings, State
from uvgs_bench.camera.boards import BoardView
from uvgs_bench.camera.lens import Lens
from uvgs_bench.errors import CalibrationError, TooFewViews
from uvgs_bench.geometry import FloatArray, Pose, read_only
from uvgs_bench.units import mm_from_m

if TYPE_CHECKING:
    from uvgs_bench.beacon.measure_types import MeasureConfig

# What a corner of a board is worth before the residuals have said so.
_CORNER_SIGMA_PX = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class LedView:
    """Named blobs of one pose of the beacon: one picture, or several taken at rest.

    Args:
        name: For people.
        led: Number of the LED of each blob, shape (m,).
        px: Centres, shape (m, 2), raw px.
        sigma_px: Deviations per axis, shape (m,), px; only their ratios matter once there are enough views.
        camera_from_beacon: A pose near the truth, with the nominal beacon.
        board: Corners of the board fixed to the beacon, seen at the same pose.
        carriage_m: Where the gantry says the carriage was, shape (3,), m, gantry frame.
    """

    name: str
    led: NDArray[np.intp]
    px: FloatArray
    sigma_px: FloatArray
    camera_from_beacon: Pose
    board: BoardView | None = None
    carriage_m: FloatArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "px", read_only(self.px, (len(self.led), 2)))
        object.__setattr__(self, "sigma_px", read_only(self.sigma_px, (len(self.led),)))


def initial(
    views: Sequence[LedView], nominal: Beacon, lens: Lens, config: MeasureConfig, lens_covariance: FloatArray | None
) -> tuple[Network, State]:
    """Pack the views and place everything near the minimum.

    Args:
        views: The views.
        nominal: The beacon as meant.
        lens: The lens.
        config: The source.
        lens_covariance: Doubt of the lens when it is to be adjusted.

    Returns:
        The network without statements about lengths, and the start.

    Raises:
        TooFewViews: A view lacks the board or the carriage position its source needs.
        CalibrationError: The board is not seen, or the gantry's axes are mirrored.
    """
    sightings = _pack(views, config.by == "board")
    L = nominal.positions_m
    n = len(L)
    R = np.array([view.camera_from_beacon.R for view in views])
    t = np.array([view.camera_from_beacon.t_m for view in views])
    in_camera = np.einsum("vij,nj->vni", R, L) + t[:, None]
    if config.by == "free":
        gauge = np.linalg.qr(rigid_motions(L - L.mean(axis=0)))[0]
        empty = np.zeros((0, 3))
        return (
            Network(sightings, n, gauge, lens_covariance=lens_covariance),
            State(L.copy(), lens, R, t, empty, np.zeros(6)),
        )
    if config.by == "board":
        R, t = _board_poses(views, lens)
        # The median forgives single views whose pose is the wrong one of two.
        leds_m = np.median(np.einsum("vji,vnj->vni", R, in_camera - t[:, None]), axis=0)
        network = Network(
            sightings, n, np.zeros((3 * n, 0)), None, (), config.board_scale_sigma, lens_covariance=lens_covariance
        )
        return network, State(leds_m, lens, R, t, np.zeros((0, 3)), np.zeros(6))
    gantry = GantryModel(
        _carriage(views), config.is_carried, config.station_sigma_m, config.scale_sigma, config.squareness_sigma_rad
    )
    moved = gantry.sign * gantry.carriage_m
    R_cg, t_cg = _outer(moved, in_camera.mean(axis=1))
    leds_m = np.median((in_camera - t_cg) @ R_cg - moved[:, None], axis=0)
    gauge = np.tile(np.eye(3), (n, 1)) / np.sqrt(n)
    network = Network(sightings, n, gauge, gantry, lens_covariance=lens_covariance)
    return network, State(leds_m, lens, R_cg[None], t_cg[None], np.zeros((len(views), 3)), np.zeros(6))


def _pack(views: Sequence[LedView], with_board: bool) -> Sightings:
    px, sigma, led, board, number = [], [], [], [], []
    for k, view in enumerate(views):
        px.append(view.px)
        sigma.append(view.sigma_px)
        led.append(np.asarray(view.led, dtype=np.intp))
        board.append(np.zeros((len(view.led), 3)))
        count = len(view.led)
        if with_board and view.board is not None:
            corners = len(view.board.px)
            px.append(view.board.px)
            sigma.append(np.full(corners, _CORNER_SIGMA_PX))
            led.append(np.full(corners, -1, dtype=np.intp))
            board.append(view.board.board_m)
            count += corners
        number.append(np.full(count, k, dtype=np.intp))
    return Sightings(
        np.concatenate(px), np.concatenate(sigma), np.concatenate(led), np.concatenate(board), np.concatenate(number),
        len(views),
    )  # fmt: skip


def _board_poses(views: Sequence[LedView], lens: Lens) -> tuple[FloatArray, FloatArray]:
    from uvgs_bench.camera.bundle import Corners, refine_poses
    from uvgs_bench.camera.bundle_start import planar_poses

    boards = [view.board for view in views]
    if any(board is None or len(board.px) < 6 for board in boards):
        missing = next(view.name for view, board in zip(views, boards, strict=True) if board is None)
        raise TooFewViews(f"{missing}: the board is not seen, every view needs it")
    corners = Corners.of([board for board in boards if board is not None])
    bundle = refine_poses(planar_poses(lens, corners), corners)
    return bundle.R_cb, bundle.t_cb


def _carriage(views: Sequence[LedView]) -> FloatArray:
    positions = [view.carriage_m for view in views]
    if any(position is None for position in positions):
        raise TooFewViews("every view needs the carriage position")
    return np.array(positions, dtype=np.float64)


def _outer(moved_m: FloatArray, seen_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pose of the gantry before the camera, from where the middle of the LEDs was seen."""
    R, t = fit_rigid(moved_m, seen_m)
    Rm, tm = fit_rigid(moved_m, seen_m, sign=-1.0)
    right, mirrored = (float(np.sqrt(np.mean((moved_m @ A.T + b - seen_m) ** 2))) for A, b in ((R, t), (Rm, tm)))
    if mirrored < 0.3 * right:
        raise CalibrationError(
            f"the axes of the gantry are declared mirrored: reflected they fit to {mm_from_m(mirrored):.1f} mm, as "
            f"declared to {mm_from_m(right):.1f} mm; one direction in the bench file has the wrong sign"
        )
    return R, t


def nominal_scale_row(leds_m: FloatArray, nominal: Beacon, sigma_m: float) -> tuple[LengthRow, str]:
    """The scale from nominal distances, without an LED that is not where it should be.

    Args:
        leds_m: Measured shape of unknown scale, shape (n, 3).
        nominal: The beacon as meant.
        sigma_m: Deviation of nominal coordinates, m.

    Returns:
        The statement, and the name of the LED left out or an empty string.

    Raises:
        TooFewViews: No set of all LEDs but one has the nominal shape.
    """
    P, n = nominal.positions_m, len(nominal.leds)
    spreads = []
    for left_out in (-1, *range(n)):
        pairs = np.array([pair for pair in combinations(range(n), 2) if left_out not in pair])
        first, second = pairs[:, 0], pairs[:, 1]
        stated = np.linalg.norm(P[first] - P[second], axis=1)
        ratio = np.log(np.linalg.norm(leds_m[first] - leds_m[second], axis=1) / stated)
        off = float(np.sqrt(np.mean(((ratio - ratio.mean()) * stated) ** 2)))
        row = LengthRow(first, second, stated, 1.0)
        sigma = max(float(np.linalg.norm(row.gradient(P))) * sigma_m, 1e-9)
        spreads.append((off, LengthRow(first, second, stated, sigma)))
    # A difference of two coordinates along the edge has root two of their deviation; pictures add as much.
    limit = 3.0 * np.sqrt(2.0) * sigma_m
    if spreads[0][0] <= limit:
        return spreads[0][1], ""
    best = int(np.argmin([off for off, _ in spreads[1:]]))
    off, row = spreads[1 + best]
    if off > limit:
        raise TooFewViews(
            f"the pictures do not have the nominal shape: without {nominal.leds[best].name} distances still differ by "
            f"{mm_from_m(off):.2f} mm, at most {mm_from_m(limit):.2f} mm; so the nominal geometry cannot give the "
            "scale: measure distances (--caliper) or state a larger --nominal-sigma"
        )
    return row, nominal.leds[best].name
