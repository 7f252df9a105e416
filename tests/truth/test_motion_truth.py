"""Captures in motion share errors with those before them: intervals over blocks of time still cover the truth."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.accuracy.clusters import Estimate
from uvgs_bench.accuracy.observations import Role
from uvgs_bench.accuracy.pose_error import ErrorTable
from uvgs_bench.accuracy.statistics import summarise

SIGMA_M, SIGMA_RAD = 1e-3, 2e-3
STEP_NS = 50_000_000
# 95th percentile and median of the length of three independent normal errors.
LENGTH_95, LENGTH_50 = 2.7955, 1.5382


def moving_table(count: int, memory: float, rng: np.random.Generator, stations: int = 0) -> ErrorTable:
    """Errors of captures in motion with a correlation of exp(-1 / memory) from one to the next; some stations first."""
    rho = np.exp(-1.0 / memory) if memory > 0.0 else 0.0
    drawn = rng.normal(size=(count, 6))
    moving = np.empty((count, 6))
    moving[0] = drawn[0]
    for k in range(1, count):
        moving[k] = rho * moving[k - 1] + np.sqrt(1.0 - rho**2) * drawn[k]
    errors = np.concatenate([rng.normal(size=(3 * stations, 6)), moving])
    n = len(errors)
    is_moving = np.arange(n) >= 3 * stations
    place = np.where(is_moving, np.arange(n), np.arange(n) // 3)
    nothing = np.ones(n)
    judge: Role = "judge"
    return ErrorTable(
        station=place,
        place=place,
        role=(judge,) * n,
        t_ns=np.arange(n, dtype=np.int64) * STEP_NS,
        axis_position=np.zeros((n, 3)),
        is_solved=np.ones(n, dtype=np.bool_),
        reason=("",) * n,
        predicted_R=np.broadcast_to(np.eye(3), (n, 3, 3)),
        predicted_t_m=np.broadcast_to([0.0, 0.0, 1.0], (n, 3)),
        translation_error_m=SIGMA_M * errors[:, 3:],
        rotation_error_rad=SIGMA_RAD * errors[:, :3],
        range_m=nothing,
        field_angle_rad=0.0 * nothing,
        view_angle_rad=0.0 * nothing,
        nees=(errors**2).sum(axis=1),
        registration_factor=np.zeros((n, 6, 12)),
        is_moving=is_moving,
        session=np.zeros(n, dtype=np.int64),
    )


def covered(trials: int, count: int, memory: float, seed: int) -> dict[str, float]:
    """How often intervals hold the truth, by figure."""
    hits: dict[str, list[bool]] = {}

    def note(name: str, found: Estimate, truth: float) -> None:
        hits.setdefault(name, []).append(found.low <= truth <= found.high)

    for k in range(trials):
        rng = np.random.default_rng([seed, k])
        summary = summarise(moving_table(count, memory, rng), rng)
        assert summary is not None
        position, depth = summary.components["position"], summary.components["depth"]
        note("position rms", position.rms, SIGMA_M * 3.0**0.5)
        note("position median", position.median, SIGMA_M * LENGTH_50)
        note("position p95", position.p95, SIGMA_M * LENGTH_95)
        note("depth bias", depth.bias, 0.0)
        note("depth rms", depth.rms, SIGMA_M)
    return {name: float(np.mean(found)) for name, found in hits.items()}


@pytest.mark.parametrize("memory", [0.0, 5.0])
def test_intervals_of_a_moving_run_cover(memory: float) -> None:
    # 95 % of 60 runs, three standard deviations of that count (8 %); counted one by one captures cover 60 %.
    for name, share in covered(60, 500, memory, 1).items():
        assert share >= 0.87, name


@pytest.mark.slow
@pytest.mark.parametrize("memory", [0.0, 2.0, 5.0, 10.0])
def test_intervals_of_moving_runs_cover_95_percent(memory: float) -> None:
    # Two standard deviations of 400 runs are 2.2 %; the length of the blocks is itself an estimate.
    for name, share in covered(400, 800, memory, 2).items():
        # What is alike across the ends of blocks is not counted: for slow errors the captures are then taken to be
        # worth up to a quarter too much, and the median's interval, which follows from that, covers 92 %.
        least = 0.90 if name == "position median" else 0.925
        assert share >= least, name


def test_captures_counted_one_by_one_would_not_cover() -> None:
    hits = 0
    for k in range(40):
        rng = np.random.default_rng([3, k])
        table = moving_table(500, 5.0, rng)
        means = table.translation_error_m[:, 2]
        half = 1.96 * means.std(ddof=1) / len(means) ** 0.5
        hits += bool(abs(means.mean()) <= half)
    # A correlation over 10 captures makes such an interval a third as wide as it must be: 46 % at best.
    assert hits <= 28


def test_stations_and_blocks_are_counted_apart() -> None:
    rng = np.random.default_rng(5)
    summary = summarise(moving_table(300, 5.0, rng, stations=12), rng)
    assert summary is not None
    assert summary.station_count == 12
    assert summary.moving_count == 300
    # Blocks of 2.5 times the correlation time of 10 captures.
    assert 6 <= summary.block_count <= 30
    assert summary.extent == f"12 stations and {summary.block_count} blocks of motion"
    rms = summary.components["position"].rms
    assert rms.station_count == 12 + summary.block_count
    # Worth less than the captures, and no less than the independent parts.
    assert rms.station_count <= rms.effective_count < 336
    # Repeatability is of captures at rest alone.
    assert summary.components["depth"].within_station.capture_count == 36
