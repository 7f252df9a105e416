"""What is said about a stream in which nothing is found, and when it is said."""

from __future__ import annotations

import numpy as np
import pytest

from uvgs_bench.sensor.capture import Capture
from uvgs_bench.sensor.outcome import Miss
from uvgs_bench.sessions.events import Remark
from uvgs_bench.sessions.stream_health import FROZEN, StreamHealth

RNG = np.random.default_rng(3)
MISS = {"b": Miss("detect", "no_blobs", "none", 0, "b", 0, {})}
STEP_NS = 10_000_000


def noisy(level: float, k: int) -> Capture:
    image = np.clip(RNG.normal(level, 2.0, (64, 80)), 0, 255).astype(np.uint8)
    return Capture(image, k * STEP_NS, "", k)


def said(levels: list[float], *, is_live: bool = True, seen: bool = False) -> list[str]:
    told: list[str] = []

    def sink(event: object) -> None:
        assert isinstance(event, Remark)
        told.append(event.text)

    health = StreamHealth(sink, is_live=is_live)
    for k, level in enumerate(levels):
        health.look(noisy(level, k), {} if seen else MISS)
    return told


@pytest.mark.parametrize(
    ("level", "word"), [(1.0, "black"), (254.0, "overexposed"), (60.0, r"most often because of detect/no_blobs")]
)
def test_the_cause_is_said_once(level: float, word: str) -> None:
    told = said([level] * 90)
    assert len(told) == 1
    assert word in told[0]


def test_a_change_is_said_again() -> None:
    told = said([1.0] * 40 + [254.0] * 40)
    assert ["black" in text for text in told] == [True, False]
    assert "overexposed" in told[1]


def test_a_short_silence_is_no_news() -> None:
    assert said([60.0] * 15) == []


def test_a_camera_that_repeats_its_picture_is_flagged_even_with_a_beacon_in_it() -> None:
    told: list[str] = []
    health = StreamHealth(lambda event: told.append(event.text), is_live=True)  # type: ignore[union-attr]
    image = noisy(60.0, 0).image
    flags = [health.look(Capture(image, k * STEP_NS, "", k), {}) for k in range(6)]
    assert flags == [(), (), (), (FROZEN,), (FROZEN,), (FROZEN,)]
    assert len(told) == 1
    assert "frozen" in told[0]
    assert health.look(noisy(60.0, 6), {}) == ()


def test_a_recording_may_repeat_a_picture() -> None:
    health = StreamHealth(lambda _event: None, is_live=False)
    image = noisy(60.0, 0).image
    assert all(health.look(Capture(image, k * STEP_NS, "", k), {}) == () for k in range(9))


@pytest.mark.parametrize(("times_ns", "word"), [([5, 9, 7], "runs backwards"), ([0, 1, 8 * 10**9], "jumps by 8 s")])
def test_time_that_jumps_is_said_once(times_ns: list[int], word: str) -> None:
    told: list[str] = []
    health = StreamHealth(lambda event: told.append(event.text), is_live=False)  # type: ignore[union-attr]
    for k, t_ns in enumerate([*times_ns, *times_ns]):
        health.look(Capture(noisy(60.0, k).image, t_ns, "", k), {})
    assert len(told) == 1
    assert word in told[0]
