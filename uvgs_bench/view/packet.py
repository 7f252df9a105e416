"""One capture as other programs draw it: the picture as JPEG, everything over and beside it as plain data.

Floats are in SI and end in their unit; what is not a number is None. Pixel (0, 0) is the centre of the first pixel.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite

import numpy as np

from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.sensor.blobs import Blobs, NoBlobs, find_blobs, full_scale_of
from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.overlay import blob_notes, pose_marks
from uvgs_bench.sensor.preprocess import intensity
from uvgs_bench.sensor.uvgs import Uvgs
from uvgs_bench.units import s_from_ns
from uvgs_bench.view.live_state import BeaconLine, GantryShown, PastPoint, Shown

_WIDEST_PX = 1280
_QUALITY = 85
_MOST_BLOBS = 40
_MOST_ZOOMS = 6
_ZOOM_HALF_PX = 11
# Grey of a zoom's pixel; the last value is kept for pixels at full scale.
_CLIPPED, _WHITE = 255, 254


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """One capture, ready to be sent.

    Args:
        number: How many captures there were with it.
        data: Everything but the picture.
        jpeg: The picture.
        shown: What it was made of.
    """

    number: int
    data: dict[str, object]
    jpeg: bytes
    shown: Shown

    @property
    def is_full_size(self) -> bool:
        """Whether the JPEG has as many pixels as the capture."""
        return self.shown.capture.width_px <= _WIDEST_PX


def make_packet(
    shown: Shown, past: Sequence[PastPoint], sensors: Mapping[str, Uvgs], gantry: GantryShown | None
) -> Packet:
    """Prepare a capture for sending.

    Args:
        shown: The capture.
        past: Points of curves that are new.
        sensors: One sensor per beacon, by the beacon's name.
        gantry: The gantry, or None.

    Returns:
        The packet.
    """
    capture, active = shown.capture, shown.active
    blobs: list[dict[str, object]] = []
    zooms: list[dict[str, object]] = []
    if active is not None and active.name in sensors:
        uvgs = sensors[active.name]
        found = find_blobs(capture, replace(uvgs.config, max_area_px2=max(uvgs.config.max_area_px2, 1e6)))
        blobs = [] if isinstance(found, NoBlobs) else _blobs(found, uvgs)
        zooms = _zooms(capture, active, uvgs, None if isinstance(found, NoBlobs) else found)
    data: dict[str, object] = {
        "number": shown.captures,
        "index": capture.index,
        "source": capture.source,
        # As text: browsers keep 53 bits of a number.
        "t_ns": str(capture.t_ns),
        "width_px": capture.width_px,
        "height_px": capture.height_px,
        "exposure_s": capture.exposure_s,
        "poses": shown.poses,
        "total": shown.total,
        "dropped": shown.dropped,
        "rate_hz": shown.rate_hz,
        "latency_s": shown.latency_s,
        "work_s": shown.work_s,
        "beacons": [_beacon(line, sensors.get(line.name)) for line in shown.lines],
        "blobs": blobs,
        "zooms": zooms,
        "past": past_rows(past),
        "gantry": None if gantry is None else asdict(gantry),
    }
    return Packet(shown.captures, data, encode_jpeg(capture, _WIDEST_PX), shown)


def past_rows(past: Sequence[PastPoint]) -> list[list[float | None]]:
    """Points of curves as rows: number, instant in s, x, y, z in m, yaw, pitch, roll in rad; None for a miss."""
    return [[point.number, s_from_ns(point.t_ns), *_plain((*point.t_m, *point.euler_zyx_rad))] for point in past]


def encode_jpeg(capture: Capture, widest_px: int | None) -> bytes:
    """The picture with 8 bits.

    Args:
        capture: The capture.
        widest_px: It is made smaller when it is wider than this, px; None keeps all pixels.

    Returns:
        A JPEG file.
    """
    import cv2

    image, full = capture.image, full_scale_of(capture)
    if image.dtype != np.uint8:
        image = cv2.convertScaleAbs(image, alpha=255.0 / full)
    if widest_px is not None and capture.width_px > widest_px:
        height_px = max(round(capture.height_px * widest_px / capture.width_px), 1)
        image = cv2.resize(image, (widest_px, height_px), interpolation=cv2.INTER_AREA)
    done, payload = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done, "a picture of 8 bit can always be encoded"
    return payload.tobytes()


def _beacon(line: BeaconLine, uvgs: Uvgs | None) -> dict[str, object]:
    marks = None
    if uvgs is not None and line.pose is not None:
        drawn = pose_marks(line.pose, line.runner_up, uvgs)
        marks = {
            "axes_px": _rows(drawn.axes_px),
            "projected_px": _rows(drawn.projected_px),
            "runner_up_px": None if drawn.runner_up_px is None else _rows(drawn.runner_up_px),
        }
    return {
        "name": line.name,
        "status": line.status,
        "reason": line.reason,
        "detail": line.detail,
        "is_active": line.is_active,
        "flags": list(line.flags),
        "pose": _pose(line.pose),
        "runner_up": _pose(line.runner_up),
        "euler_zyx_rad": line.euler_zyx_rad,
        "position_sigma_m": None if line.position_sigma_m is None else _plain(line.position_sigma_m.tolist()),
        "rotation_sigma_rad": None if line.rotation_sigma_rad is None else _plain(line.rotation_sigma_rad.tolist()),
        "led_px": None if line.led_px is None else _rows(line.led_px),
        "rms_px": _finite(line.rms_px),
        "margin": _finite(line.margin),
        "blob_count": line.blob_count,
        "held_age_s": _finite(line.held_age_s),
        "marks": marks,
    }


def _blobs(blobs: Blobs, uvgs: Uvgs) -> list[dict[str, object]]:
    notes = blob_notes(blobs, uvgs)
    brightest = np.argsort(-blobs.peak_dn, kind="stable")[:_MOST_BLOBS].tolist()
    return [
        {
            "index": i,
            "centroid_px": _plain(blobs.centroid_px[i].tolist()),
            "box_px": _plain(blobs.box_px[i].tolist()),
            "area_px2": float(blobs.area_px2[i]),
            "peak_dn": float(blobs.peak_dn[i]),
            "dropped": notes[i].dropped,
        }
        for i in sorted(brightest)
    ]


def _zooms(capture: Capture, line: BeaconLine, uvgs: Uvgs, blobs: Blobs | None) -> list[dict[str, object]]:
    """The LEDs of the active beacon enlarged; of a miss the brightest blobs."""
    spots: list[tuple[str, FloatArray]] = []
    if line.led_px is not None and len(line.led_px) == len(uvgs.beacon.leds):
        named = zip(uvgs.beacon.leds, line.led_px, strict=True)
        spots = [(led.name, px) for led, px in named if np.isfinite(px).all()]
    if not spots and blobs is not None:
        spots = [(f"#{i}", blobs.centroid_px[i]) for i in np.argsort(-blobs.peak_dn, kind="stable")]
    raw, full = intensity(capture.image), full_scale_of(capture)
    return [_zoom(name, px, raw, full) for name, px in spots[:_MOST_ZOOMS]]


def _zoom(name: str, px: FloatArray, raw: np.ndarray, full_scale_dn: float) -> dict[str, object]:
    half = _ZOOM_HALF_PX
    height, width = raw.shape
    column = min(max(round(float(px[0])), 0), width - 1)
    row = min(max(round(float(px[1])), 0), height - 1)
    rows = np.clip(np.arange(row - half, row + half + 1), 0, height - 1)
    columns = np.clip(np.arange(column - half, column + half + 1), 0, width - 1)
    part = raw[np.ix_(rows, columns)].astype(np.float64)
    low, high = float(part.min()), float(part.max())
    grey = np.round((part - low) * (_WHITE / max(high - low, 1.0))).astype(np.uint8)
    clipped = part >= full_scale_dn
    grey[clipped] = _CLIPPED
    return {
        "name": name,
        "corner_px": [column - half, row - half],
        "side_px": 2 * half + 1,
        "centre_px": _plain(px.tolist()),
        "peak_dn": high,
        "full_scale_dn": full_scale_dn,
        "clipped": int(clipped.sum()),
        "grey": b64encode(grey.tobytes()).decode("ascii"),
    }


def _pose(pose: Pose | None) -> dict[str, object] | None:
    return None if pose is None else {"t_m": _plain(pose.t_m.tolist()), "R": _plain(pose.R.ravel().tolist())}


def _rows(values: FloatArray) -> list[list[float | None] | None]:
    return [_plain(row) if np.isfinite(row).all() else None for row in values.tolist()]


def _plain(values: Sequence[float]) -> list[float | None]:
    return [_finite(value) for value in values]


def _finite(value: float) -> float | None:
    return float(value) if isfinite(value) else None
