"""Pictures of a calibration board by the simulated camera, with the true pose of each."""

from __future__ import annotations

from math import pi

import numpy as np

from uvgs_bench.camera.boards import Board, board_texture
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.cameras.base import ClosingSource
from uvgs_bench.devices.sim.bench import true_lens
from uvgs_bench.devices.sim.render import read_out
from uvgs_bench.devices.sim.render_kernels import see_plane
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.errors import CalibrationError
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import so3_exp
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.units import rad_from_deg, s_from_ms

STEP_NS = 500_000_000
"""Time between two views, ns."""

# A good set of views: tilted up to this, the board between these shares of the picture's width, corners reached.
_TILT_DEG = (10.0, 42.0)
_TURN_DEG = 25.0
_SHARE = (0.45, 0.85)
_EDGE_PX = 6.0
_ANCHORS = ((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5))
# Finders need some white paper around the outer squares, in squares.
_SEEN_MARGIN = 0.4
_TRIES = 60
# Brightness of black ink, white paper and the wall behind, as shares of the converter's range.
_BLACK, _WHITE, _WALL = 0.08, 0.75, 0.3
_PX_PER_SQUARE = 96
_SAMPLES = 3


class SimulatedBoardSource(ClosingSource):
    """Views of a board, each at another place, tilt and distance; the same seed gives the same pixels.

    Args:
        truth: Camera and seed.
        board: The board, printed true to its declaration.
        count: Number of views.
        seed: Seed in place of the truth's.

    Raises:
        CalibrationError: The board cannot be placed whole in the picture.
        ConfigError: The true lens is impossible.
    """

    def __init__(self, truth: SimulatedTruth, board: Board, count: int, *, seed: int | None = None) -> None:
        super().__init__(f"sim-board:{board.name}", is_live=False, length=count)
        self._camera = truth.camera
        self._lens = true_lens(truth)
        self._seed = truth.seed if seed is None else seed
        self._texture, self._texel_m, self._texel_origin_m = board_texture(board, _PX_PER_SQUARE)
        self._next = 0
        self._rays: FloatArray | None = None
        rng = np.random.default_rng((self._seed, 5))
        outline_m = self._outline_m(_SEEN_MARGIN)
        self.true_camera_from_board: tuple[Pose, ...] = tuple(
            place_board(self._lens, outline_m, _ANCHORS[i % len(_ANCHORS)], rng) for i in range(count)
        )

    def grab(self) -> Capture | None:
        """The next view, or None after the last."""
        index = self._next
        if index >= len(self.true_camera_from_board):
            return None
        self._next += 1
        image = self.view(self.true_camera_from_board[index], index)
        exposure_s = s_from_ms(self._camera.exposure_ms)
        return Capture(image, index * STEP_NS, f"view_{index:02d}", index, exposure_s)

    def view(self, camera_from_board: Pose, index: int) -> ImageArray:
        """The board at a pose.

        Args:
            camera_from_board: Its pose.
            index: Number of the view; with the seed it decides the noise.

        Returns:
            Mono (H, W) or BGR (H, W, 3).
        """
        import cv2

        camera = self._camera
        if self._rays is None:
            self._rays = ray_slopes(self._lens)
        span_dn = min((1 << camera.bit_depth) - 1.0, camera.full_well_e / camera.gain_e_per_dn) - camera.black_dn
        picture = np.full((camera.height_px, camera.width_px), _WALL * span_dn)
        texture: FloatArray = span_dn * (_BLACK + (_WHITE - _BLACK) / 255.0 * self._texture.astype(np.float64))
        box = self._box(camera_from_board)
        if box[0] < box[1] and box[2] < box[3]:
            H = texel_from_ray(camera_from_board, self._texel_m, self._texel_origin_m)
            see_plane(self._rays, H, texture, picture, box, _SAMPLES)
        picture = cv2.GaussianBlur(picture, (0, 0), camera.psf_sigma_px, borderType=cv2.BORDER_REPLICATE)
        if camera.is_colour:
            picture = np.repeat(picture[:, :, None], 3, axis=2)
        return read_out(picture, camera, np.random.default_rng((self._seed, 6, index)))

    def _outline_m(self, margin_squares: float) -> FloatArray:
        """Outline of the printed board with a margin, board frame, shape (N, 3), m; the sheet's margin is 1 square."""
        rows, columns = self._texture.shape
        cut = (1.0 - margin_squares) * _PX_PER_SQUARE
        low, high = np.array([cut, cut]), np.array([columns - 1.0, rows - 1.0]) - cut
        corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        along = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None]
        sides = [a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
        plane_m = self._texel_origin_m + np.concatenate(sides) * self._texel_m
        return np.column_stack([plane_m, np.zeros(len(plane_m))])

    def _box(self, camera_from_board: Pose) -> tuple[int, int, int, int]:
        """Rows and columns that can show the sheet, without the outer ring of pixels."""
        px = self._lens.project(camera_from_board.apply(self._outline_m(1.0)))
        width, height = self._lens.width_px, self._lens.height_px
        if not np.isfinite(px).all():
            return 1, height - 1, 1, width - 1
        low, high = np.floor(px.min(axis=0)).astype(int) - 8, np.ceil(px.max(axis=0)).astype(int) + 8
        return max(1, int(low[1])), min(height - 1, int(high[1])), max(1, int(low[0])), min(width - 1, int(high[0]))


def ray_slopes(lens: Lens) -> FloatArray:
    """x/z and y/z of every pixel centre, shape (H, W, 2); NaN where the lens has no ray ahead.

    A lens bends slowly: where every ray exists, a cubic spline through every eighth pixel is exact to 1e-4 px (wide
    lenses) or far better.
    """
    from scipy.interpolate import RectBivariateSpline

    u, v = np.arange(0.0, lens.width_px), np.arange(0.0, lens.height_px)
    coarse_u, coarse_v = np.linspace(0.0, u[-1], len(u) // 8 + 4), np.linspace(0.0, v[-1], len(v) // 8 + 4)
    coarse = _slopes_on_grid(lens, coarse_u, coarse_v)
    if not np.isfinite(coarse).all():
        return _slopes_on_grid(lens, u, v)
    return np.ascontiguousarray(
        np.stack([RectBivariateSpline(coarse_v, coarse_u, coarse[:, :, k])(v, u) for k in (0, 1)], axis=-1)
    )


def _slopes_on_grid(lens: Lens, u: FloatArray, v: FloatArray) -> FloatArray:
    columns, rows = np.meshgrid(u, v)
    rays = lens.unproject(np.column_stack([columns.ravel(), rows.ravel()]))
    rays[~(rays[:, 2] > 0.0)] = np.nan
    return np.ascontiguousarray((rays[:, :2] / rays[:, 2:]).reshape(len(v), len(u), 2))


def texel_from_ray(camera_from_board: Pose, texel_m: float, texel_origin_m: FloatArray) -> FloatArray:
    """Homography from (x/z, y/z, 1) of a ray to column and row of the texture, shape (3, 3).

    Args:
        camera_from_board: Pose of the board.
        texel_m: Side of a texel, m.
        texel_origin_m: Centre of the first texel, board frame, shape (2,), m.

    Returns:
        The homography, its third entry positive where the plane is in front of the camera.
    """
    x_m, y_m = texel_origin_m
    plane_from_texel = np.array([[texel_m, 0.0, x_m], [0.0, texel_m, y_m], [0.0, 0.0, 1.0]])
    R, t_m = camera_from_board.R, camera_from_board.t_m
    ray_from_texel = np.column_stack([R[:, 0], R[:, 1], t_m]) @ plane_from_texel
    # (column, row, 1) * depth = inverse @ ray: the third entry is 1/depth, positive in front.
    return np.ascontiguousarray(np.linalg.inv(ray_from_texel))


def place_board(lens: Lens, outline_m: FloatArray, anchor: tuple[float, float], rng: np.random.Generator) -> Pose:
    """A random pose at which the whole outline is seen and touches a wanted part of the picture.

    Args:
        lens: The lens.
        outline_m: Outline that must be seen, board frame, shape (N, 3), m.
        anchor: Where in the free room the board goes: 0 is left or top, 1 is right or bottom.
        rng: Source of tilt, turn and distance.

    Returns:
        ``camera_from_board``; the board is seen from its front.

    Raises:
        CalibrationError: No such pose was found.
    """
    middle_m = 0.5 * (outline_m.min(axis=0) + outline_m.max(axis=0))
    length_m = float(np.ptp(outline_m[:, 0]))
    room_px = np.array([lens.width_px - 1.0, lens.height_px - 1.0]) - 2.0 * _EDGE_PX
    for _ in range(_TRIES):
        tilt, toward = rad_from_deg(float(rng.uniform(*_TILT_DEG))), float(rng.uniform(0.0, 2.0 * pi))
        turn = rad_from_deg(float(rng.uniform(-_TURN_DEG, _TURN_DEG)))
        R = so3_exp(tilt * np.array([np.cos(toward), np.sin(toward), 0.0])) @ so3_exp(np.array([0.0, 0.0, turn]))
        distance_m = lens.fx_px * length_m / (float(rng.uniform(*_SHARE)) * lens.width_px)
        centre_px = 0.5 * np.array([lens.width_px, lens.height_px])
        for _ in range(6):
            ray = lens.unproject(centre_px)[0]
            if not ray[2] > 0.0:
                break
            pose = Pose(R, ray / ray[2] * distance_m - R @ middle_m, "camera", "board")
            px = lens.project(pose.apply(outline_m))
            low, high = px.min(axis=0), px.max(axis=0)
            if not np.isfinite(low + high).all() or np.any(high - low > room_px):
                break
            wanted_px = _EDGE_PX + np.array(anchor) * (room_px - (high - low))
            if float(np.abs(wanted_px - low).max()) < 1.0:
                return pose
            centre_px = centre_px + (wanted_px - low)
    raise CalibrationError("the simulated board does not fit into the picture of the simulated camera at any distance")
