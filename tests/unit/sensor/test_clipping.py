"""Counting LEDs whose core stands at full scale."""

from __future__ import annotations

import numpy as np

from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.clipping import clipped_led_count


def test_only_leds_with_a_core_at_full_scale_count() -> None:
    image = np.zeros((40, 60), dtype=np.uint8)
    image[10, 20], image[30, 41], image[0, 0] = 255, 255, 254
    led_px = np.array([[20.2, 9.8], [40.0, 30.0], [0.0, 0.0], [np.nan, np.nan], [59.4, 39.4]])
    assert clipped_led_count(Capture(image, 0), led_px) == 2


def test_the_stated_full_scale_counts() -> None:
    image = np.zeros((40, 60), dtype=np.uint16)
    image[10, 20] = 4095
    led_px = np.array([[20.0, 10.0]])
    assert clipped_led_count(Capture(image, 0, full_scale_dn=4095.0), led_px) == 1
    assert clipped_led_count(Capture(image, 0, full_scale_dn=65535.0), led_px) == 0
