"""Stage 4: which blob is which LED.

``scored`` tries every labeling (``labelings``) with all evidence as one likelihood: centroids, emission cones, missing
LEDs, brightness, size, prior. It answers the best, the best that is truly different, how far apart they are, and how
many fits as likely lights strewn at random would give. ``paper`` sorts by the longest edge and signs (section 2.4); it
holds only while the longest projected edge is the longest edge.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations
from math import inf

import numpy as np
from numpy.typing import NDArray

from uvgs_bench.camera.lens import Lens
from uvgs_bench.geometry import FloatArray, Pose
from uvgs_bench.geometry.se3 import rotation_angle
from uvgs_bench.sensor.config import UvgsConfig
from uvgs_bench.sensor.labelings import Search, chance_fits, odds_of_a_stray, search
from uvgs_bench.sensor.led_table import LedTable
from uvgs_bench.sensor.outcome import PoseEstimate

__all__ = ["LedMatch", "LedTable", "NoMatch", "match_leds"]

_DEGENERATE_SINE = 0.05
WEAK_ODDS = 0.06
"""A pose is published with a flag when the odds that a light of it is no LED exceed this."""


@dataclass(frozen=True, slots=True, eq=False)
class LedMatch:
    """Which blob is which LED.

    Args:
        blob_of_led: Index of the blob of each LED, -1 if unseen, shape (n,).
        start: Pose near the optimum.
        margin: One plus the natural logarithm of the likelihood ratio of best and runner-up, cut down by how much worse
            than expected the best fits; for four LEDs the ratio of their costs plus two. inf without runner-up.
        runner_up: The best truly different pose, or None.
        chance_fits: How many fits as likely as this one random lights would give; 0 where it was not asked.
        stray_odds: Likelihood of another pose, with one of the four lights no LED, over that of this one; for more than
            four LEDs ``chance_fits``.
        needs_prior: Whether only three LEDs are named, so that a prior must be fused.
    """

    blob_of_led: NDArray[np.int64]
    start: Pose
    margin: float
    runner_up: Pose | None
    chance_fits: float = 0.0
    stray_odds: float = 0.0
    needs_prior: bool = False

    @property
    def flags(self) -> tuple[str, ...]:
        """What a user should know about the pose that comes of it."""
        if self.needs_prior:
            return ("three_leds_with_prior",)
        return ("weak_evidence",) if self.is_weak else ()

    @property
    def is_weak(self) -> bool:
        """Whether chance alone could have made this fit in a picture with an LED hidden and a glint in its stead."""
        return self.stray_odds > WEAK_ODDS


@dataclass(frozen=True, slots=True)
class NoMatch:
    """Why no labeling is believed.

    Args:
        reason: Stable word.
        detail: One line with the numbers.
    """

    reason: str
    detail: str


def match_leds(
    centroid_px: FloatArray,
    sigma_px: FloatArray,
    lens: Lens,
    leds: LedTable,
    config: UvgsConfig,
    prior: PoseEstimate | None = None,
    looks: FloatArray | None = None,
) -> LedMatch | NoMatch:
    """Name the blobs.

    Args:
        centroid_px: Candidates, shape (m, 2), m >= 4, raw px.
        sigma_px: Their deviations for judging, shape (m,), px.
        lens: The lens.
        leds: The tabulated beacon.
        config: Which method, least margin, ranges.
        prior: The last pose; a pose near it gains, one far from it loses nothing.
        looks: Natural logarithms of light and width of each blob, each up to a common factor, shape (m, 2), NaN where
            unknown; None when nothing is known.

    Returns:
        The match, or why there is none: ``degenerate``, ``no_labeling``, ``not_proven``,
        ``chance_fit``, ``ambiguous``.
    """
    if config.correspondence == "paper":
        return _sort_as_paper(centroid_px, sigma_px, lens, leds, config)
    found = search(centroid_px, sigma_px, lens, leds, config, prior, looks)
    if not len(found):
        if found.is_proven:
            return NoMatch("no_labeling", f"no labeling of {len(centroid_px)} blobs fits the beacon")
        return NoMatch(
            "not_proven",
            f"no six neighbours of {len(leds.positions_m)} LEDs fit, and not all labelings of {len(centroid_px)} blobs "
            "can be tried",
        )
    best = found.candidate(0)
    if not found.is_proven:
        return NoMatch(
            "not_proven",
            f"{best.seen} of {len(leds.positions_m)} LEDs fit, too few to be sure: not all labelings of "
            f"{len(centroid_px)} blobs can be tried",
        )
    chance = chance_fits(best, found, leds, looks)
    if chance > config.max_chance_fits:
        return NoMatch(
            "chance_fit",
            f"{found.tried} poses of {len(centroid_px)} blobs were tried: {chance:.2f} fits as likely as this "
            f"(chi-square {best.chi2:.1f}) are expected by chance, at most {config.max_chance_fits:.2f}",
        )
    match = _decide(found, chance, config)
    if isinstance(match, LedMatch) and len(leds.positions_m) == 4:
        odds = odds_of_a_stray(best, found, centroid_px, sigma_px, lens, leds, config, looks)
        return replace(match, stray_odds=odds)
    return match


def _decide(found: Search, chance: float, config: UvgsConfig) -> LedMatch | NoMatch:
    best = found.candidate(0)
    rival = found.rival()
    if rival is None:
        return LedMatch(best.blob_of_led, best.pose, inf, None, chance, chance)
    dof = 2 * best.seen - 6
    margin = 1.0 + 0.5 * (rival.cost - best.cost) * dof / (best.chi2 + dof)
    if margin >= config.min_margin:
        return LedMatch(best.blob_of_led, best.pose, margin, rival.pose, chance, chance)
    angle = np.degrees(rotation_angle(best.pose.R.T @ rival.pose.R))
    return NoMatch(
        "ambiguous",
        f"two poses {angle:.1f} deg apart are almost as likely: margin {margin:.2f}, needs {config.min_margin:.2f}",
    )


def _sort_as_paper(
    px: FloatArray, sigma: FloatArray, lens: Lens, leds: LedTable, config: UvgsConfig
) -> LedMatch | NoMatch:
    """Section 2.4: longest edge, distance to its middle, sign of the cross product; the beacon is sorted alike."""
    if len(leds.positions_m) != 4:
        return NoMatch("no_subset", f"the paper's sort needs a beacon of 4 LEDs, this one has {len(leds.positions_m)}")
    if len(px) != 4:
        return NoMatch("no_subset", f"the paper's sort needs exactly 4 candidates, got {len(px)}")
    blob_order = _sort_four(px)
    # The beacon as seen from the front: the view along +z of its own frame.
    led_order = _sort_four(leds.positions_m[:, :2])
    if blob_order is None or led_order is None:
        return NoMatch("degenerate", "three of the four points are nearly on a line, or two coincide")
    assignment = np.empty(4, dtype=np.int64)
    assignment[led_order] = blob_order
    found = search(px, sigma, lens, leds, config)
    same = np.flatnonzero((found.blob_of_led == assignment).all(axis=1))
    if not len(same):
        return NoMatch("no_labeling", "the sorted labeling fits no pose in front of the camera")
    return LedMatch(assignment, found.candidate(int(same[0])).pose, inf, None)


def _sort_four(p: FloatArray) -> NDArray[np.int64] | None:
    """Order of four points in the plane: baseline start, baseline end, nearer, farther; None when degenerate."""
    distance = np.linalg.norm(p[:, None] - p[None], axis=2)
    i, j = (int(v) for v in np.unravel_index(int(distance.argmax()), distance.shape))
    longest = float(distance[i, j])
    if float(distance[np.triu_indices(4, 1)].min()) < _DEGENERATE_SINE * longest:
        return None
    for a, b, c in permutations(range(4), 3):
        u, v = p[b] - p[a], p[c] - p[a]
        if abs(float(u[0] * v[1] - u[1] * v[0])) < _DEGENERATE_SINE * float(np.linalg.norm(u) * np.linalg.norm(v)):
            return None
    middle = 0.5 * (p[i] + p[j])
    rest = sorted((k for k in range(4) if k not in (i, j)), key=lambda k: float(np.linalg.norm(p[k] - middle)))
    base, far = p[j] - p[i], p[rest[1]] - p[i]
    if base[0] * far[1] - base[1] * far[0] < 0.0:
        i, j = j, i
    return np.array([i, j, *rest], dtype=np.int64)
