"""Pictures of a beacon and of a printed tag side by side, with the true pose of each.

The tag is a flat texture seen through the true lens, lit by the ambient light; the beacon's LEDs shine by themselves.
Both go through the same point spread, motion during the exposure, shot noise, full well, read noise and converter.
Not simulated: gloss and bending of the paper, flare and blooming around saturated LEDs, rolling shutter, shadows.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np

from uvgs_bench.beacon.geometry import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.board_views import ray_slopes, texel_from_ray
from uvgs_bench.devices.sim.render import DEFAULT_DIAMETER_M, Emitter, Renderer, read_out
from uvgs_bench.devices.sim.render_kernels import see_plane
from uvgs_bench.devices.sim.truth import TrueCamera
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.capture import ImageArray
from uvgs_bench.units import ms_from_s

QUIET_MODULES = 1
"""White paper around the black border, in modules: what the families ask for at least."""

BLACK_SHARE, WALL_SHARE = 0.1, 0.35
"""Light from black ink and from the wall behind, as shares of the light from white paper."""

_SAMPLES = 4
# Texels a little wider than the distance of two samples make the covered share of a pixel exact.
_TEXELS_PER_PX = 3.0
_TRAIL_STEP_PX = 0.3


@dataclass(frozen=True, slots=True)
class Tag:
    """A printed square tag. Its frame: origin in the middle, x right, y down, z away from the reader.

    Args:
        dictionary: OpenCV's name of the family, for example ``DICT_APRILTAG_36h11``.
        number: Which tag of the family.
        side_m: Side of the black square, m.
    """

    dictionary: str
    number: int
    side_m: float

    def modules(self) -> FloatArray:
        """The printed cells, quiet zone included, 1 for white, 0 for black, shape (n, n)."""
        import cv2

        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        count = int(dictionary.markerSize) + 2
        printed = cv2.aruco.generateImageMarker(dictionary, self.number, count, borderBits=1)
        return np.pad((printed > 127).astype(np.float64), QUIET_MODULES, constant_values=1.0)

    def corners_m(self) -> FloatArray:
        """Corners of the black square: top left, top right, bottom right, bottom left, shape (4, 3), m."""
        h = 0.5 * self.side_m
        return np.array([[-h, -h, 0.0], [h, -h, 0.0], [h, h, 0.0], [-h, h, 0.0]])


class SideBySide(Renderer):
    """A camera that sees the LEDs of a beacon and one tag.

    Args:
        lens: The true lens.
        camera: The true camera; its ``background_dn`` is the wall's.
        paper_dn: Light from white paper at the exposure the camera's truth names, DN.
        seed: Seed of all noise.
    """

    def __init__(self, lens: Lens, camera: TrueCamera, paper_dn: float, seed: int) -> None:
        super().__init__(lens, camera, seed)
        self._paper_dn = paper_dn
        self._rays = ray_slopes(lens)

    def view(
        self,
        beacon: Beacon,
        camera_from_beacon: Pose,
        tag: Tag | None,
        camera_from_tag: Pose,
        exposure_s: float,
        moved_m: FloatArray,
        rng: np.random.Generator,
    ) -> ImageArray:
        """Take a picture.

        Args:
            beacon: The beacon.
            camera_from_beacon: Its pose at mid-exposure.
            tag: The tag, or None for the beacon alone.
            camera_from_tag: Its pose at mid-exposure (source frame ``board``).
            exposure_s: Exposure, s.
            moved_m: How far both move during the exposure, camera axes, shape (3,), m.
            rng: Source of the noise.

        Returns:
            Mono (H, W), uint8, or uint16 for more than 8 bit.
        """
        gain = ms_from_s(exposure_s) / self.camera.peak_exposure_ms
        nearest_m = min(camera_from_beacon.t_m[2], camera_from_tag.t_m[2])
        trail_px = float(np.linalg.norm(moved_m)) * self.lens.fx_px / nearest_m
        count = max(1, ceil(trail_px / _TRAIL_STEP_PX))
        shifts_m = ((np.arange(count) + 0.5) / count - 0.5)[:, None] * moved_m
        boxes = [] if tag is None else [self._add_tag(tag, camera_from_tag, shifts_m, gain)]
        boxes += [self._add(emitter, gain) for emitter in leds_of(beacon, camera_from_beacon, shifts_m, self.camera)]
        image = self._shifted_background(gain, rng)
        for top, bottom, left, right in boxes:
            if top < bottom and left < right:
                window = (slice(top, bottom), slice(left, right))
                image[window] = read_out(self._light[window] + self.camera.background_dn * gain, self.camera, rng)
        self._light[:] = 0.0
        return image[:, :, 0]

    def _add_tag(self, tag: Tag, pose: Pose, shifts_m: FloatArray, gain: float) -> tuple[int, int, int, int]:
        """Add the tag's light above the wall's, averaged over the instants of the exposure, blurred by the lens."""
        import cv2

        modules = tag.modules()
        module_m = tag.side_m / (len(modules) - 2 * QUIET_MODULES)
        texels = max(4, ceil(_TEXELS_PER_PX * module_m * self.lens.fx_px / pose.t_m[2]))
        share = BLACK_SHARE + (1.0 - BLACK_SHARE) * np.kron(modules, np.ones((texels, texels)))
        texture = np.asarray(gain * (self._paper_dn * share - self.camera.background_dn), dtype=np.float64)
        texel_m = module_m / texels
        first_m = np.full(2, -0.5 * (len(texture) - 1) * texel_m)
        box = self._tag_box(0.5 * len(modules) * module_m, pose, shifts_m)
        if not (box[0] < box[1] and box[2] < box[3]):
            return box
        picture = np.zeros((self.camera.height_px, self.camera.width_px))
        total = np.zeros((box[1] - box[0], box[3] - box[2]))
        for shift_m in shifts_m:
            moved = Pose(pose.R, pose.t_m + shift_m, pose.target, pose.source)
            see_plane(self._rays, texel_from_ray(moved, texel_m, first_m), texture, picture, box, _SAMPLES)
            total += picture[box[0] : box[1], box[2] : box[3]]
            picture[box[0] : box[1], box[2] : box[3]] = 0.0
        mean, sigma_px = total / len(shifts_m), self.camera.psf_sigma_px
        blurred = cv2.GaussianBlur(mean, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT)
        self._light[box[0] : box[1], box[2] : box[3], 0] += blurred
        return box

    def _tag_box(self, half_m: float, pose: Pose, shifts_m: FloatArray) -> tuple[int, int, int, int]:
        """Rows and columns that the sheet's light can reach, within the picture's inner pixels."""
        outline_m = half_m * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        corners_m = pose.apply(outline_m)
        px = self.lens.project(np.concatenate([corners_m + shifts_m[0], corners_m + shifts_m[-1]]))
        height, width = self.camera.height_px, self.camera.width_px
        if not np.isfinite(px).all():
            return 1, height - 1, 1, width - 1
        # Distortion bows the sheet's edges by a few pixels.
        margin = ceil(5.0 * self.camera.psf_sigma_px) + 8
        low, high = np.floor(px.min(axis=0)).astype(int) - margin, np.ceil(px.max(axis=0)).astype(int) + margin + 1
        return max(1, int(low[1])), min(height - 1, int(high[1])), max(1, int(low[0])), min(width - 1, int(high[0]))


def leds_of(beacon: Beacon, pose: Pose, shifts_m: FloatArray, camera: TrueCamera) -> list[Emitter]:
    """The LEDs of a beacon that moves in a straight line while the shutter is open.

    Args:
        beacon: The beacon.
        pose: ``camera_from_beacon`` at mid-exposure.
        shifts_m: Where it is at each instant relative to mid-exposure, camera axes, shape (S, 3), m.
        camera: The true camera, for the brightness.

    Returns:
        One emitter per LED.
    """
    return [
        Emitter(
            centre_m=pose.apply(led.position_m) + shifts_m,
            axis=None if led.axis is None else np.tile(pose.R @ led.axis, (len(shifts_m), 1)),
            peak_dn_at_1m=camera.peak_dn_at_1m,
            diameter_m=DEFAULT_DIAMETER_M if led.diameter_m is None else led.diameter_m,
            half_angle_rad=led.half_angle_rad,
            hue=beacon.hue,
        )
        for led in beacon.leds
    ]


def facing_pose(
    lens: Lens, px: tuple[float, float], range_m: float, view_angle_rad: float, rng: np.random.Generator, source: str
) -> Pose:
    """A pose whose origin appears at a place of the picture, tilted by a view angle towards a random side.

    Args:
        lens: The lens.
        px: Where the origin appears, px.
        range_m: Distance of the origin from the camera, m.
        view_angle_rad: Angle between the line of sight and the source's z axis, rad.
        rng: Source of the side and of the turn about its own axis.
        source: Name of the source frame.

    Returns:
        ``camera_from_<source>``.
    """
    sight = lens.unproject(np.array(px))[0]
    right = np.array([sight[2], 0.0, -sight[0]]) / sqrt(sight[0] ** 2 + sight[2] ** 2)
    facing = np.column_stack([right, np.cross(sight, right), sight])
    side, turn = rng.uniform(0.0, 2.0 * np.pi, 2)
    tilt = Pose.exp(view_angle_rad * np.array([np.cos(side), np.sin(side), 0.0, 0.0, 0.0, 0.0]), "camera", "camera").R
    spin = Pose.exp(np.array([0.0, 0.0, turn, 0.0, 0.0, 0.0]), "camera", "camera").R
    return Pose(facing @ tilt @ spin, range_m * sight, "camera", source)
