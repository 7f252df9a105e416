"""The derivatives of the LED adjustment against central differences."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.spots import beacon, lens, random_pose
from uvgs_bench.beacon.length_row import LengthRow
from uvgs_bench.beacon.network import GantryModel, Network, Sightings, State, jacobians, residuals_px

STEP = 1e-6  # rad, m or lens units: truncation and rounding of px values near 1e3 stay below 1e-3 px per unit


def make(kind: str) -> tuple[Network, State]:
    rng = np.random.default_rng(3)
    views, leds = 4, beacon().positions_m
    board = np.column_stack([rng.uniform(-0.1, 0.1, (3, 2)), np.zeros(3)])
    led = np.tile([0, 1, 2, 3, -1, -1, -1] if kind == "board" else [0, 1, 2, 3], views)
    points = np.where(led[:, None] < 0, np.tile(board, (len(led) // 3 + 1, 1))[: len(led)], 0.0)
    view = np.repeat(np.arange(views), len(led) // views)
    sightings = Sightings(rng.uniform(300, 700, (len(led), 2)), np.full(len(led), 0.1), led, points, view, views)
    poses = [random_pose(rng) for _ in range(1 if kind in ("carried", "camera") else views)]
    gantry = None
    if kind in ("carried", "camera"):
        gantry = GantryModel(rng.uniform(-0.1, 0.1, (views, 3)), kind == "carried", 5e-5, 1e-4, 2e-4)
    network = Network(
        sightings, 4, np.zeros((12, 0)), gantry, (), 2e-4 if kind == "board" else 0.0, np.eye(lens().parameters.size),
        np.where((led >= 0)[:, None], rng.uniform(-0.5, 0.5, (len(led), 3)), 0.0),
    )  # fmt: skip
    state = State(
        leds, lens(), np.array([p.R for p in poses]), np.array([p.t_m for p in poses]),
        np.zeros((views if gantry else 0, 3)), np.array([1e-3, -2e-3, 1e-3, 2e-3, 3e-3, -1e-3]), 0.01,
        np.array([1e-3, -2e-3, 0.0, 3e-3]),
    )  # fmt: skip
    return network, state


@pytest.mark.parametrize("kind", ["free", "board", "carried", "camera"])
def test_jacobians_match_differences(kind: str) -> None:
    network, state = make(kind)
    _, by_global, by_local = jacobians(network, state)
    G, k, V = by_global.shape[2], by_local.shape[2], network.sightings.view_count
    for column in range(G + k):
        step, local = np.zeros(G), np.zeros((V, k))
        if column < G:
            step[column] = STEP
        else:
            local[:, column - G] = STEP
        ahead = residuals_px(network, state.moved(network, step, local))
        behind = residuals_px(network, state.moved(network, -step, -local))
        numeric = -(ahead - behind) / (2.0 * STEP)
        analytic = by_global[:, :, column] if column < G else by_local[:, :, column - G]
        # Rounding of pixels near 1e3 (1e-13) over the step, and truncation: 1e-3 px per m against some 1e3 px per m.
        np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-3)


def test_length_row_gradient_matches_differences() -> None:
    leds = beacon().positions_m
    row = LengthRow(np.array([0, 1, 2]), np.array([3, 2, 0]), np.array([0.1, 0.11, 0.12]), 1e-3)
    numeric = np.empty(12)
    for k in range(12):
        step = np.zeros(12)
        step[k] = STEP
        ahead, behind = (row.residual(leds + s.reshape(4, 3)) for s in (step, -step))
        numeric[k] = -(ahead - behind) / (2.0 * STEP)
    # 1/m: truncation and rounding of a logarithm with this step.
    np.testing.assert_allclose(row.gradient(leds), numeric, atol=1e-8)
