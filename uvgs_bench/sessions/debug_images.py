"""One picture per capture that shows what each stage of the sensor saw: for looking, not for measuring.

In the picture: bright tiles or the binary mask, every blob with its number and area or the reason it was dropped,
LED names, residual arrows, the beacon's axes, the runner-up. Beside it: each light enlarged. Above it: the outcome.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.blobs import Blobs, NoBlobs, bright_tiles, find_blobs, full_scale_of
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sensor.overlay import BlobNote, arrow_gain, blob_notes, pose_marks
from uvgs_bench.sensor.preprocess import intensity, segment
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.store.documents import write_atomically
from uvgs_bench.units import deg_from_rad, mm_from_m

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

GREEN, ORANGE, BLUE, MAGENTA, WHITE, GREY, RED = (
    (90, 220, 90), (40, 140, 255), (255, 170, 60), (230, 80, 230), (245, 245, 245), (150, 150, 150), (80, 80, 255),
)  # fmt: skip
_HEADER_PX, _LEGEND_PX, _SIDE_PX, _INSET_PX = 84, 30, 216, 196
_INSETS = 4
_LEAST_WIDTH_PX, _MOST_WIDTH_PX = 960, 1600
_GREATEST_AREA_PX2 = 1e6
_BAR = (38, 34, 30)
# Dim things become visible; the pixels of a debug image are not for measuring.
_GAMMA = 0.55


def draw_debug_image(capture: Capture, outcome: Outcome, uvgs: Uvgs) -> Picture:
    """Draw what each stage saw.

    Args:
        capture: The picture.
        outcome: What the sensor answered.
        uvgs: The sensor that answered.

    Returns:
        BGR, shape (H, W, 3): the capture, enlarged when small, with bars around it.
    """
    import cv2

    scale = _scale_of(capture.width_px)
    raw = intensity(capture.image)
    base = _brightened(capture)
    size = (round(capture.width_px * scale), round(capture.height_px * scale))
    way = cv2.INTER_NEAREST if scale >= 1.0 else cv2.INTER_AREA
    canvas: Picture = cv2.resize(base, size, interpolation=way)
    pen = _Pen(canvas, scale)
    # Lights far beyond the largest area are not even measured in earnest; here they are shown as too large.
    widest = max(uvgs.config.max_area_px2, _GREATEST_AREA_PX2)
    blobs = find_blobs(capture, replace(uvgs.config, max_area_px2=widest))
    _draw_bright_places(pen, capture, uvgs.config)
    if not isinstance(blobs, NoBlobs):
        _draw_blobs(pen, blobs, blob_notes(blobs, uvgs), outcome)
    if isinstance(outcome, PoseEstimate):
        _draw_pose(pen, outcome, uvgs)
    side = _side_bar(raw, canvas.shape[0], blobs, outcome, uvgs)
    body = np.hstack([canvas, side])
    return np.vstack([_header(body.shape[1], capture, outcome, uvgs, blobs), body, _legend(body.shape[1])])


class DebugImages:
    """A folder that gets one debug image per capture.

    Args:
        folder: The folder; made when the first image is written.
        uvgs: The sensor whose outcomes are drawn.
        force: Whether existing files may be replaced.
    """

    def __init__(self, folder: Path, uvgs: Uvgs, *, force: bool = False) -> None:
        self.folder = folder
        self._uvgs = uvgs
        self._force = force

    def write(self, capture: Capture, outcome: Outcome) -> Path:
        """Draw and write one image, named after the capture's number and its outcome.

        Raises:
            ConfigError: The file exists and may not be replaced.
            UvgsError: It cannot be written.
        """
        import cv2

        word = "pose" if isinstance(outcome, PoseEstimate) else f"miss_{outcome.stage}_{outcome.reason}"
        path = self.folder / f"{capture.index:06d}_{word}.png"
        done, payload = cv2.imencode(".png", draw_debug_image(capture, outcome, self._uvgs))
        assert done, "a BGR picture of 8 bit can always be encoded"
        write_atomically(path, payload.tobytes(), force=self._force)
        return path


class _Pen:
    """Draws on a canvas in the pixels of the capture."""

    def __init__(self, canvas: Picture, scale: float) -> None:
        self.canvas = canvas
        self.scale = scale

    def at(self, px: FloatArray) -> tuple[int, int]:
        """Canvas pixel of a capture pixel (whole numbers are pixel centres)."""
        x, y = (px + 0.5) * self.scale - 0.5
        limit = 30_000.0
        return round(float(np.clip(x, -limit, limit))), round(float(np.clip(y, -limit, limit)))

    def line(self, a: FloatArray, b: FloatArray, colour: Colour, width: int = 1) -> None:
        import cv2

        cv2.line(self.canvas, self.at(a), self.at(b), colour, width, cv2.LINE_AA)

    def arrow(self, a: FloatArray, b: FloatArray, colour: Colour) -> None:
        import cv2

        cv2.arrowedLine(self.canvas, self.at(a), self.at(b), colour, 2, cv2.LINE_AA, tipLength=0.25)

    def cross(self, px: FloatArray, colour: Colour, size: int = 9) -> None:
        import cv2

        cv2.drawMarker(self.canvas, self.at(px), colour, cv2.MARKER_TILTED_CROSS, size, 1, cv2.LINE_AA)

    def box(self, box_px: FloatArray, margin: float, colour: Colour) -> None:
        import cv2

        a, b = self.at(box_px[:2] - margin), self.at(box_px[2:] + margin)
        cv2.rectangle(self.canvas, a, b, colour, 1)

    def text(self, px: FloatArray, words: str, colour: Colour, dx: int = 0, dy: int = 0, size: float = 0.5) -> None:
        x, y = self.at(px)
        _write(self.canvas, words, (x + dx, y + dy), colour, size)


def _write(canvas: Picture, words: str, at: tuple[int, int], colour: Colour, size: float = 0.5) -> None:
    """Text with a dark rim, inside the canvas."""
    import cv2

    plain = words.replace("²", "2").replace("°", " deg").encode("ascii", "replace").decode()
    (width, height), _ = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    x = int(np.clip(at[0], 2, max(2, canvas.shape[1] - width - 2)))
    y = int(np.clip(at[1], height + 2, max(height + 2, canvas.shape[0] - 4)))
    # Thicker letters are also wider in some releases of OpenCV, so the rim is the same letters moved.
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        cv2.putText(canvas, plain, (x + dx, y + dy), cv2.FONT_HERSHEY_SIMPLEX, size, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(canvas, plain, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def _scale_of(width_px: int) -> float:
    if width_px < _LEAST_WIDTH_PX:
        return float(-(-_LEAST_WIDTH_PX // width_px))
    return min(1.0, _MOST_WIDTH_PX / width_px)


def _brightened(capture: Capture) -> Picture:
    relative = capture.image.astype(np.float32) / full_scale_of(capture)
    shown: Picture = (np.power(np.clip(relative, 0.0, 1.0), _GAMMA) * 235.0).astype(np.uint8)
    return np.repeat(shown[:, :, None], 3, axis=2) if shown.ndim == 2 else shown


def _draw_bright_places(pen: _Pen, capture: Capture, config: UvgsConfig) -> None:
    """The paper's binary mask as outlines, or the tiles in which the fast pipeline looks for peaks."""
    import cv2

    if config.detection == "paper":
        raw = intensity(capture.image)
        if float(raw.max()) <= float(raw.min()):
            return
        seen = segment(raw, config)
        size = (pen.canvas.shape[1], pen.canvas.shape[0])
        mask = cv2.resize(seen.binary, size, interpolation=cv2.INTER_NEAREST)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(pen.canvas, contours, -1, BLUE, 1)
        return
    from uvgs_bench.sensor import peak_kernels as pk

    for row, column in np.argwhere(bright_tiles(capture, config)):
        corner = np.array([column, row], dtype=np.float64) * pk.TILE_PX
        pen.box(np.concatenate([corner, corner + pk.TILE_PX - 1]), 0.4, (90, 70, 40))


def _draw_blobs(pen: _Pen, blobs: Blobs, notes: tuple[BlobNote, ...], outcome: Outcome) -> None:
    seen = outcome.led_px if isinstance(outcome, PoseEstimate) else np.empty((0, 2))
    # Of very many only the brightest are named, so that the picture stays readable.
    named = set(np.argsort(-blobs.peak_dn, kind="stable")[:40].tolist())
    for note in notes:
        i = note.blob
        is_led = len(seen) > 0 and bool(np.nanmin(np.linalg.norm(seen - blobs.centroid_px[i], axis=1)) < 1.0)
        colour = ORANGE if note.dropped else GREEN
        pen.box(blobs.box_px[i], 3.0, colour)
        if is_led or i not in named:
            continue
        corner = np.array([blobs.box_px[i, 2] + 4.0, blobs.box_px[i, 1]])
        words = f"#{note.index} {blobs.area_px2[i]:.0f}px2 {note.dropped}".rstrip()
        pen.text(corner, words, colour, dx=3, dy=4, size=0.5)


def _draw_pose(pen: _Pen, pose: PoseEstimate, uvgs: Uvgs) -> None:
    marks = pose_marks(pose.camera_from_beacon, pose.runner_up, uvgs)
    if marks.runner_up_px is not None:
        other = marks.runner_up_px
        middle = np.nanmean(other, axis=0)
        for px in other[np.isfinite(other).all(axis=1)]:
            pen.line(middle, px, MAGENTA)
            pen.cross(px, MAGENTA, 13)
    gain = arrow_gain(pose.residual_px)
    for led, px, residual in zip(uvgs.beacon.leds, pose.led_px, pose.residual_px, strict=True):
        if not np.isfinite(px).all():
            continue
        pen.text(px, led.name, WHITE, dx=12, dy=-10, size=0.55)
        pen.arrow(px - residual, px - residual + gain * residual, RED)
    px = marks.axes_px
    for k, colour in ((1, (60, 60, 255)), (2, (60, 220, 60)), (3, (255, 120, 60))):
        if np.isfinite(px[[0, k]]).all():
            pen.line(px[0], px[k], colour, 2)
            pen.text(px[k], "xyz"[k - 1], colour, dx=4, dy=4)


def _header(width: int, capture: Capture, outcome: Outcome, uvgs: Uvgs, blobs: Blobs | NoBlobs) -> Picture:
    bar = np.full((_HEADER_PX, width, 3), _BAR, dtype=np.uint8)
    count = 0 if isinstance(blobs, NoBlobs) else len(blobs)
    if isinstance(outcome, Miss):
        first, colour = f"MISS  {outcome.stage}: {outcome.reason}", ORANGE
        second = outcome.detail
    else:
        t, gain = outcome.camera_from_beacon.t_m, arrow_gain(outcome.residual_px)
        margin = "no runner-up" if outcome.runner_up is None else f"runner-up {outcome.margin:.3g} times worse"
        first, colour = f"POSE  rms {outcome.rms_px:.4f} px, residual arrows x{gain}, {margin}", GREEN
        sigma = mm_from_m(outcome.position_sigma_m)
        second = (
            f"x {mm_from_m(t[0]):.1f}  y {mm_from_m(t[1]):.1f}  z {mm_from_m(t[2]):.1f} mm, "
            f"sigma {sigma[0]:.3f} {sigma[1]:.3f} {sigma[2]:.3f} mm, "
            f"tilt {_tilt_deg(outcome.camera_from_beacon):.1f} deg"
        )
    third = (
        f"{capture.source or 'capture'}  no. {capture.index}   {uvgs.beacon.name}   {uvgs.config.detection}   "
        f"{count} blobs, {outcome.blob_count} candidates"
    )
    _write(bar, first, (12, 25), colour, 0.7)
    _write(bar, second, (12, 51), WHITE, 0.55)
    _write(bar, third, (12, 75), GREY, 0.5)
    return bar


def _tilt_deg(pose: Pose) -> float:
    """Angle between the beacon's z axis and the line of sight, degrees."""
    sight = pose.t_m / np.linalg.norm(pose.t_m)
    return float(deg_from_rad(float(np.arccos(np.clip(pose.R[:, 2] @ sight, -1.0, 1.0)))))


def _legend(width: int) -> Picture:
    bar = np.full((_LEGEND_PX, width, 3), _BAR, dtype=np.uint8)
    x = 12
    for words, colour in (
        ("candidate", GREEN), ("dropped, and why", ORANGE), ("residual, from the projected LED", RED),
        ("runner-up", MAGENTA), ("bright tile / mask", BLUE), ("picture brightened", GREY),
    ):  # fmt: skip
        _write(bar, words, (x, 20), colour, 0.48)
        x += 24 + round(8.6 * len(words))
    return bar


def _side_bar(
    raw: NDArray[np.uint8] | NDArray[np.uint16],
    height: int,
    blobs: Blobs | NoBlobs,
    outcome: Outcome,
    uvgs: Uvgs,
) -> Picture:
    """The LEDs of a pose, or the brightest blobs of a miss, enlarged: pixels, observed centre, projected LED."""
    import cv2

    bar = np.full((height, _SIDE_PX, 3), _BAR, dtype=np.uint8)
    spots: list[tuple[str, FloatArray, FloatArray | None]] = []
    if isinstance(outcome, PoseEstimate):
        rows = zip(uvgs.beacon.leds, outcome.led_px, outcome.residual_px, strict=True)
        spots = [(led.name, px, px - residual) for led, px, residual in rows if np.isfinite(px).all()]
    elif not isinstance(blobs, NoBlobs):
        brightest = np.argsort(-blobs.peak_dn * np.sqrt(blobs.area_px2), kind="stable")
        spots = [(f"#{i}", blobs.centroid_px[i], None) for i in brightest]
    top = 6
    for name, px, expected in spots[:_INSETS]:
        if top + _INSET_PX + 22 > height:
            break
        half = _half_side(blobs, px)
        zoom = _INSET_PX / (2 * half + 1)
        column, row = round(float(px[0])), round(float(px[1]))
        padded = cv2.copyMakeBorder(raw, half, half, half, half, cv2.BORDER_REPLICATE)
        part = padded[row : row + 2 * half + 1, column : column + 2 * half + 1].astype(np.float32)
        # From its darkest to its brightest pixel, so that dim lights are seen as well.
        grey = ((part - part.min()) * (235.0 / max(float(part.max() - part.min()), 1.0))).astype(np.uint8)
        cut = np.repeat(grey[:, :, None], 3, axis=2)
        inset: Picture = cv2.resize(cut, (_INSET_PX, _INSET_PX), interpolation=cv2.INTER_NEAREST)
        pen = _Pen(inset, zoom)
        corner = np.array([column - half, row - half], dtype=np.float64)
        pen.cross(px - corner, GREEN, 15)
        if expected is not None:
            cv2.circle(inset, pen.at(expected - corner), 7, RED, 1, cv2.LINE_AA)
        bar[top : top + _INSET_PX, 10 : 10 + _INSET_PX] = inset
        near = raw[max(0, row - half) : row + half + 1, max(0, column - half) : column + half + 1]
        _write(bar, f"{name}  x{zoom:.0f}  peak {float(near.max()):.0f} DN", (12, top + _INSET_PX + 15), WHITE, 0.45)
        top += _INSET_PX + 26
    return bar


def _half_side(blobs: Blobs | NoBlobs, px: FloatArray) -> int:
    """Half side of the cut-out, px: the blob with as much again around it."""
    if isinstance(blobs, NoBlobs) or not len(blobs):
        return 12
    nearest = int(np.argmin(np.linalg.norm(blobs.centroid_px - px, axis=1)))
    sides = blobs.box_px[nearest, 2:] - blobs.box_px[nearest, :2] + 1.0
    return int(np.clip(np.ceil(float(sides.max())) + 4, 8, 60))
