"""Which LED the pixels blame: what a fitted pose cannot take up of them tells one misplaced LED from another.

Four LEDs give eight numbers and a pose takes six. The two that are left know nothing of the gantry, so they say which
LED is misplaced even where every fit was refused.

Source: G. Schwarz, Estimating the dimension of a model (1978), for telling the hypotheses apart.
"""

from __future__ import annotations

import numpy as np

from uvgs_bench.accuracy.observations import Observations
from uvgs_bench.accuracy.pose_sensitivity import pose_pixel_jacobian
from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray
from uvgs_bench.sensor.batch import solve_batch

# Odds of 150 to 1, as in the search for causes.
_CLEARLY = 10.0
_LEAST_PLACES = 8
_MOST_CAPTURES = 400
_POSE = 6


def blamed_leds(obs: Observations, lens: Lens, leds_m: FloatArray) -> tuple[int, ...]:
    """LEDs that may be the misplaced one, the likeliest first.

    Args:
        obs: Captures; those whose LEDs were named, solved or refused.
        lens: The lens the sensor was told.
        leds_m: LED positions it was told, beacon frame, shape (L, 3), m.

    Returns:
        Their numbers: one when the pixels are clear, all when they say nothing or are not known.
    """
    L = len(leds_m)
    everyone = tuple(range(L))
    if obs.led_px.shape[1:] != (L, 2):
        return everyone
    known = np.flatnonzero(np.isfinite(obs.led_px).all(axis=(1, 2)))
    chosen = known[:: max(1, -(-len(known) // _MOST_CAPTURES))]
    places = len(np.unique(obs.place[chosen]))
    left_over = 2 * L - _POSE
    if places < _LEAST_PLACES or left_over < 1:
        return everyone
    px = obs.led_px[chosen]
    found = solve_batch(lens, leds_m, px, np.ones(L))
    px, R, t = px[found.converged], found.R_cb[found.converged], found.t_cb_m[found.converged]
    if len(px) < _LEAST_PLACES:
        return everyone
    J, at = pose_pixel_jacobian(lens, leds_m, R, t)
    free = np.linalg.qr(J.reshape(len(px), 2 * L, _POSE), mode="complete")[0][:, :, _POSE:].transpose(0, 2, 1)
    rest = (free @ (px - at).reshape(len(px), 2 * L, 1)).reshape(-1)
    # An LED's shift of the pixels is that of the whole beacon seen at the LED alone.
    by_led = J[:, :, :, 3:] @ R[:, None]
    squares = []
    for led in range(L):
        alone = np.zeros_like(by_led)
        alone[:, led] = by_led[:, led]
        columns = (free @ alone.reshape(len(px), 2 * L, 3)).reshape(len(rest), 3)
        squares.append(_unexplained(columns, rest))
    # Captures of a place share their errors, so places are counted.
    count = places * left_over
    cost = count * np.log(np.maximum(squares, 1e-300))
    nobody = count * float(np.log(max(float(rest @ rest), 1e-300))) - 3.0 * float(np.log(count))
    order = np.argsort(cost)
    if nobody - float(cost[order[0]]) < _CLEARLY:
        return everyone
    return tuple(int(led) for led in order if cost[led] - cost[order[0]] < _CLEARLY)


def _unexplained(columns: FloatArray, values: FloatArray) -> float:
    """Sum of squares that columns leave."""
    size = np.linalg.lstsq(columns, values, rcond=1e-10)[0]
    rest = values - columns @ size
    return float(rest @ rest)
