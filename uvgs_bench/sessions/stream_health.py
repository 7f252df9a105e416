"""What is wrong with a stream of pictures in which no beacon is found: said in words, once per change."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from uvgs_bench.sensor.blobs import full_scale_of
from uvgs_bench.sensor.capture import Capture, ImageArray
from uvgs_bench.sensor.outcome import Miss, Outcome, PoseEstimate
from uvgs_bench.sessions.events import EventSink, Remark
from uvgs_bench.units import NS_PER_S, s_from_ns

FROZEN = "frozen"
"""Flag of a line whose picture is the same as several before it, to the last bit."""

# So many captures without a pose are no accident.
_PATIENCE = 20
# Every so many rows and columns are looked at.
_SAMPLED = 16
# Below this share of full scale everywhere there is nothing but noise.
_BLACK = 0.06
# Above this share of clipped pixels no threshold finds a spot.
_CLIPPED, _MOST_CLIPPED = 0.98, 0.2
# Noise makes no two pictures of a live camera the same.
_MOST_SAME = 3
_JUMP_NS = 5 * NS_PER_S


def is_black(image: ImageArray, full_dn: float) -> bool:
    """Whether no pixel is brighter than noise, given full scale, DN."""
    return float(image.max()) < _BLACK * full_dn


def is_overexposed(image: ImageArray, full_dn: float) -> bool:
    """Whether so many pixels clip that no threshold finds a spot, given full scale, DN."""
    return clipped_share(image, full_dn) > _MOST_CLIPPED


def clipped_share(image: ImageArray, full_dn: float) -> float:
    """Share of a sample of the pixels that clip, given full scale, DN."""
    return float(np.mean(image[::_SAMPLED, ::_SAMPLED] >= _CLIPPED * full_dn))


class StreamHealth:
    """Watches captures and outcomes and says what a person at the bench should look at.

    Args:
        sink: Where warnings go.
        is_live: Whether the pictures come from a camera now; recordings may repeat a picture.
    """

    def __init__(self, sink: EventSink, *, is_live: bool) -> None:
        self._sink = sink
        self._is_live = is_live
        self._misses: Counter[str] = Counter()
        self._said = ""
        self._sample: ImageArray | None = None
        self._same = 0
        self._last_ns: int | None = None
        self._is_time_doubted = False

    def look(self, capture: Capture, outcomes: Mapping[str, Outcome]) -> tuple[str, ...]:
        """Look at a capture.

        Args:
            capture: The capture.
            outcomes: Its outcomes by beacon.

        Returns:
            Flags for its lines.
        """
        self._check_time(capture)
        sample = capture.image[::_SAMPLED].copy() if self._is_live else None
        if sample is not None:
            is_same = self._sample is not None and np.array_equal(sample, self._sample)
            self._same, self._sample = (self._same + 1 if is_same else 0), sample
        is_frozen = self._same >= _MOST_SAME
        if is_frozen and not self._misses:
            self._say("the pictures are frozen: the camera repeats the same one")
        if any(isinstance(outcome, PoseEstimate) for outcome in outcomes.values()):
            self._misses.clear()
            if not is_frozen:
                self._said = ""
        else:
            self._misses.update(f"{o.stage}/{o.reason}" for o in outcomes.values() if isinstance(o, Miss))
            if self._misses and self._misses.total() >= _PATIENCE * len(outcomes):
                self._say(self._cause(capture, is_frozen))
                self._misses.clear()
        return (FROZEN,) if is_frozen else ()

    def _cause(self, capture: Capture, is_frozen: bool) -> str:
        full = full_scale_of(capture)
        if is_black(capture.image, full):
            return (
                f"the pictures are black (brightest pixel {int(capture.image.max())} of {full:.0f}): "
                "lens cap, exposure, or no light?"
            )
        if is_overexposed(capture.image, full):
            clipped = clipped_share(capture.image, full)
            return f"the pictures are overexposed ({100.0 * clipped:.0f} % of the pixels clip): expose shorter"
        if is_frozen:
            return "the pictures are frozen: the camera repeats the same one"
        reason, _ = self._misses.most_common(1)[0]
        return f"no pose for a while, most often because of {reason}"

    def _check_time(self, capture: Capture) -> None:
        step_ns = 0 if self._last_ns is None else capture.t_ns - self._last_ns
        self._last_ns = capture.t_ns
        if self._is_time_doubted or (0 <= step_ns < _JUMP_NS):
            return
        self._is_time_doubted = True
        word = "runs backwards" if step_ns < 0 else "jumps"
        self._sink(
            Remark("warning", f"capture {capture.index}: the source's time {word} by {abs(s_from_ns(step_ns)):.3g} s")
        )

    def _say(self, text: str) -> None:
        if text.partition(" (")[0] != self._said.partition(" (")[0]:
            self._sink(Remark("warning", text))
        self._said = text
