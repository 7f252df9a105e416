"""What is sent of a capture is what the sensor said, in plain JSON, and clipped pixels are told apart."""

from __future__ import annotations

import base64
import json

import cv2
import numpy as np
import pytest

from tests.helpers.live_states import BEACON, sensor, shown_state, solved
from uvgs_bench.interop.trajectories import LineNote
from uvgs_bench.sensor import Capture
from uvgs_bench.sensor.overlay import pose_marks
from uvgs_bench.view.live_state import LiveState
from uvgs_bench.view.packet import encode_jpeg, make_packet

pytestmark = pytest.mark.opencv


def packet_of(state: LiveState):
    return make_packet(state.latest(), state.past(), {BEACON: sensor()}, None)


def test_a_pose_is_sent_with_its_marks():
    packet = packet_of(shown_state())
    data = json.loads(json.dumps(packet.data, allow_nan=False))
    beacon = data["beacons"][0]
    _, outcome = solved()
    assert beacon["status"] == "ok"
    assert beacon["pose"]["t_m"] == outcome.camera_from_beacon.t_m.tolist()
    assert beacon["rms_px"] == outcome.rms_px
    assert len(data["blobs"]) == 4
    assert not any(blob["dropped"] for blob in data["blobs"])
    # A projected LED lies within the residual of an accepted fit, 2 px, of the one that was seen.
    for seen, should in zip(beacon["led_px"], beacon["marks"]["projected_px"], strict=True):
        assert np.hypot(seen[0] - should[0], seen[1] - should[1]) < 2.0
    assert [row[0] for row in data["past"]] == [1, 2, 3]


def test_marks_are_projections():
    _, outcome = solved()
    uvgs = sensor()
    marks = pose_marks(outcome.camera_from_beacon, outcome.camera_from_beacon, uvgs)
    # Residuals are against the same projection: equal to rounding, 1e-6 px.
    np.testing.assert_allclose(outcome.led_px - outcome.residual_px, marks.projected_px, atol=1e-6)
    np.testing.assert_array_equal(marks.runner_up_px, marks.projected_px)
    origin = uvgs.calibration.lens.project(outcome.camera_from_beacon.t_m[None])[0]
    np.testing.assert_allclose(marks.axes_px[0], origin)


@pytest.mark.parametrize("kind", ["miss", "held"])
def test_what_is_no_fresh_pose_has_no_deviations(kind):
    data = json.loads(json.dumps(packet_of(shown_state(kind)).data, allow_nan=False))
    beacon = data["beacons"][0]
    assert beacon["status"] == kind
    assert (beacon["pose"] is None) == (kind == "miss")
    for name in ("position_sigma_m", "rotation_sigma_rad", "rms_px", "margin"):
        assert beacon[name] is None
    assert data["past"][-1][2:] == [None] * 6


def test_pixels_at_full_scale_are_marked_in_the_zoom():
    capture, outcome = solved()
    image = capture.image.copy()
    column, row = (round(value) for value in outcome.led_px[0])
    image[row, column] = 255
    state = LiveState()
    state.put(Capture(image, 0), {BEACON: (outcome, LineNote())})
    zoom = packet_of(state).data["zooms"][0]
    grey = np.frombuffer(base64.b64decode(zoom["grey"]), np.uint8).reshape(zoom["side_px"], zoom["side_px"])
    assert zoom["clipped"] == int((grey == 255).sum()) >= 1
    left, top = zoom["corner_px"]
    assert grey[row - top, column - left] == 255


def test_the_picture_keeps_its_brightness_and_is_made_smaller():
    ramp = np.tile(np.linspace(0, 4095, 2000).astype(np.uint16), (100, 1))
    jpeg = encode_jpeg(Capture(ramp, 0, full_scale_dn=4095.0), 1280)
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (64, 1280)
    # 3 of 255: what JPEG does to a smooth ramp.
    np.testing.assert_allclose(image[32], np.linspace(0, 255, 1280), atol=3.0)
