"""Head to head on simulated pictures: uVGS against square tags of the same span, in the same captures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import sqrt
from typing import Literal

import numpy as np

from uvgs_bench.beacon import Beacon
from uvgs_bench.camera.lens import Lens
from uvgs_bench.devices.sim.bench import true_lens
from uvgs_bench.devices.sim.tag_views import BLACK_SHARE, QUIET_MODULES, WALL_SHARE, SideBySide, Tag
from uvgs_bench.devices.sim.truth import SimulatedTruth
from uvgs_bench.sessions.detection_conditions import BASE_PAPER_DN, Condition, default_conditions, picture
from uvgs_bench.sessions.detection_methods import (
    APRILTAG_FAMILY,
    Method,
    apriltag_corners,
    aruco_corners,
    tag_method,
    uvgs_method,
)
from uvgs_bench.sessions.detection_scores import (
    SANE_ATTITUDE_RAD,
    SANE_POSITION_SHARE,
    UVGS,
    UVGS_ALONE,
    Row,
    Scores,
    row_of,
    score,
)
from uvgs_bench.sessions.events import EventSink, StageAdvanced, StageFinished, StageStarted, ignore_events
from uvgs_bench.units import deg_from_rad, mm_from_m, ms_from_s

FAMILIES = (APRILTAG_FAMILY, "DICT_4X4_50", "DICT_5X5_50")
TAG_NUMBER = 7

Span = Literal["diagonal", "side"]

# Far more than there are captures in a condition: every capture of a benchmark has its own noise.
_CAPTURES_APART = 100_000


@dataclass(frozen=True, slots=True)
class DetectionBenchmark:
    """The result.

    Args:
        protocol: How it was measured, line by line, for people.
        conditions: The conditions with their rows.
        overall: Rows over all conditions.
        not_installed: Methods that could not take part.
    """

    protocol: tuple[str, ...]
    conditions: tuple[tuple[Condition, tuple[Row, ...]], ...]
    overall: tuple[Row, ...]
    not_installed: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Entrant:
    """A method that takes part.

    Args:
        name: Its name in the tables.
        family: Family of the tag in the picture, "" for a picture without one.
        is_beacon: Whether it looks for the beacon instead of the tag.
        solve: The method, or None when it is not installed.
    """

    name: str
    family: str
    is_beacon: bool
    solve: Method | None


def run_detection_benchmark(
    beacon: Beacon,
    truth: SimulatedTruth | None = None,
    *,
    conditions: Sequence[Condition] | None = None,
    capture_count: int = 20,
    seed: int = 1,
    span: Span = "diagonal",
    told_side_factor: float = 1.0,
    sink: EventSink = ignore_events,
) -> DetectionBenchmark:
    """Render, solve and compare.

    Args:
        beacon: The beacon, true as its file says.
        truth: The true camera; the shipped defaults when None.
        conditions: The conditions; ``default_conditions()`` when None.
        capture_count: Captures of every condition; each is rendered once with every tag family and once without.
        seed: Seed of all poses and all noise.
        span: What of the tag equals the beacon's largest LED distance: ``diagonal`` or ``side`` of the black square.
        told_side_factor: What the tag methods are told of the tag's size, over the truth; 1 unless a test plants an
            error.
        sink: Receives progress.

    Returns:
        The comparison.

    Raises:
        ConfigError: The true lens is impossible.
        ValueError: No captures or no conditions are asked for.
    """
    truth = SimulatedTruth() if truth is None else truth
    conditions = default_conditions() if conditions is None else tuple(conditions)
    if capture_count < 1 or not conditions:
        raise ValueError("expected at least one capture and one condition")
    lens = true_lens(truth)
    side_m = tag_side_m(beacon, span)
    with one_thread():
        entrants = make_entrants(lens, beacon, told_side_factor * side_m)
        sink(StageStarted("pictures", len(conditions)))
        results = []
        for number, condition in enumerate(conditions):
            scores = _scores(truth, lens, beacon, side_m, entrants, condition, range(capture_count), seed, number)
            results.append((condition, scores))
            sink(StageAdvanced("pictures", number + 1, f"{condition.group} {condition.label}"))
        sink(StageFinished("pictures", f"{len(conditions)} conditions, {capture_count} captures each"))
    names = list(dict.fromkeys(entrant.name for entrant in entrants if entrant.solve is not None))
    pooled: Scores = {name: {} for name in names}
    for number, (_, scores) in enumerate(results):
        for name in names:
            pooled[name].update({(f, number * _CAPTURES_APART + k): s for (f, k), s in scores[name].items()})
    return DetectionBenchmark(
        protocol=protocol(beacon, truth, side_m, span, capture_count, seed),
        conditions=tuple((c, tuple(row_of(name, scores) for name in names)) for c, scores in results),
        overall=tuple(row_of(name, pooled) for name in names),
        not_installed=tuple(entrant.name for entrant in entrants if entrant.solve is None),
    )


def tag_side_m(beacon: Beacon, span: Span) -> float:
    """Side of the black square of a tag of the beacon's span, m."""
    leds_m = beacon.positions_m
    longest_m = float(np.linalg.norm(leds_m[:, None] - leds_m[None], axis=-1).max())
    return longest_m / sqrt(2.0) if span == "diagonal" else longest_m


def make_entrants(lens: Lens, beacon: Beacon, side_m: float) -> tuple[Entrant, ...]:
    """Everyone who takes part, uVGS first; tag methods are told ``side_m`` (m)."""
    uvgs = uvgs_method(lens, beacon)
    entrants = [Entrant(UVGS, family, True, uvgs) for family in FAMILIES] + [Entrant(UVGS_ALONE, "", True, uvgs)]
    for family in FAMILIES:
        tag = Tag(family, TAG_NUMBER, side_m)
        label = family.removeprefix("DICT_").removeprefix("APRILTAG_").removesuffix("_50").lower()
        name = f"cv2.aruco {label}"
        entrants.append(Entrant(name, family, False, tag_method(lens, tag, aruco_corners(family, TAG_NUMBER))))
    tag = Tag(APRILTAG_FAMILY, TAG_NUMBER, side_m)
    refined = tag_method(lens, tag, aruco_corners(APRILTAG_FAMILY, TAG_NUMBER, "APRILTAG"))
    entrants.append(Entrant("cv2.aruco 36h11, refine APRILTAG", APRILTAG_FAMILY, False, refined))
    for decimate in (1.0, 2.0):
        finder = apriltag_corners(TAG_NUMBER, decimate)
        method = None if finder is None else tag_method(lens, tag, finder)
        entrants.append(Entrant(f"apriltag 36h11, decimate {decimate:g}", APRILTAG_FAMILY, False, method))
    return tuple(entrants)


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV on one thread for as long as this lasts."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _scores(
    truth: SimulatedTruth,
    lens: Lens,
    beacon: Beacon,
    side_m: float,
    entrants: Sequence[Entrant],
    condition: Condition,
    captures: range,
    seed: int,
    number: int,
) -> Scores:
    camera = replace(truth.camera, psf_sigma_px=condition.psf_sigma_px, background_dn=WALL_SHARE * condition.paper_dn)
    stage = SideBySide(lens, camera, condition.paper_dn, seed)
    scores: Scores = {entrant.name: {} for entrant in entrants if entrant.solve is not None}
    for capture in captures:
        for family in (*FAMILIES, ""):
            tag = Tag(family, TAG_NUMBER, side_m) if family else None
            image, poses = picture(stage, beacon, tag, condition, number * _CAPTURES_APART + capture)
            for entrant in entrants:
                if entrant.family == family and entrant.solve is not None:
                    true = poses[0] if entrant.is_beacon else poses[1]
                    scores[entrant.name][family, capture] = score(entrant.solve(image), true, condition.range_m)
    return scores


def protocol(
    beacon: Beacon, truth: SimulatedTruth, side_m: float, span: Span, capture_count: int, seed: int
) -> tuple[str, ...]:
    """How it is measured, in sentences for people."""
    import cv2

    camera = truth.camera
    diagonal_m = sqrt(2.0) * side_m
    span_m = diagonal_m if span == "diagonal" else side_m
    return (
        f"Simulated pictures, {camera.width_px}x{camera.height_px} mono {camera.bit_depth} bit, {camera.model}, "
        f"fx {camera.parameters_px[0]:g} px; seed {seed}; {capture_count} captures per condition, "
        "each rendered with one tag of every family beside the beacon (same poses, random turn and tilt direction, "
        "sides swapped every other capture), and once with the beacon alone.",
        f"Same span: the largest LED distance of {beacon.name}, {mm_from_m(span_m):.1f} mm, equals the tag's {span} "
        f"(black square {mm_from_m(side_m):.1f} mm, diagonal {mm_from_m(diagonal_m):.1f} mm). The paper is larger by a "
        f"quiet zone of {QUIET_MODULES} module all around; the beacon is deep, the tag is flat.",
        f"Unless varied: 1 m, 20 deg, 4 ms, white paper {BASE_PAPER_DN:g} DN above black at 4 ms, point spread "
        f"0.9 px, at rest. Ink gives {100 * BLACK_SHARE:g} %, the wall behind {100 * WALL_SHARE:g} % of the paper. "
        "Over range the exposure follows the LEDs: 4 ms up to 1 m, then x (range / 1 m)^2 up to 16 ms.",
        f"Active against passive: LEDs keep their own light ({camera.peak_dn_at_1m:g} DN at 1 m and "
        f"{camera.peak_exposure_ms:g} ms), the tag has only the condition's ambient light; one exposure for both.",
        "Every method gets the true lens and true sizes, and raw pictures as they are. Tags: corners through the lens, "
        "then solvePnP IPPE_SQUARE, better-fitting of its two poses. cv2.aruco: default parameters, corners refined by "
        "CORNER_REFINE_SUBPIX or, where said, CORNER_REFINE_APRILTAG. AprilTag 3 (pupil-apriltags, quad_decimate 1 "
        "or, as shipped, 2): its own pose knows no distortion, so its corners take the same way. The half pixel of "
        "AprilTag's pixel convention is taken off in both. uVGS: default parameters, no prior.",
        f"False: a pose off by more than {100 * SANE_POSITION_SHARE:g} % of the range or "
        f"{deg_from_rad(SANE_ATTITUDE_RAD):g} deg; errors are over the other poses (origin of the LED frame, "
        "middle of the tag). Error ratios: over the pictures where both have such a pose. Only the wanted tag number "
        "counts.",
        "Time: picture to pose, processor time of the whole process (wall clock on an idle core), median over the "
        f"pictures, hits and misses alike; one thread; OpenCV {cv2.__version__}.",
        "Not simulated: gloss, bent paper, lens flare and blooming around LEDs, shadows. Both targets are as good as "
        "their makers could wish; a comparison of real targets needs real pictures.",
    )


def as_tables(result: DetectionBenchmark) -> dict[str, object]:
    """The result as plain values for ``--json``; lengths in mm, angles in deg, times in ms, as reports have them."""

    def row(one: Row) -> dict[str, object]:
        return {
            "method": one.method,
            "captures": one.capture_count,
            "poses": one.pose_count,
            "false_poses": one.false_count,
            "position_rms_mm": mm_from_m(one.position_rms_m),
            "attitude_rms_deg": deg_from_rad(one.attitude_rms_rad),
            "time_median_ms": ms_from_s(one.time_s),
            "time_p95_ms": ms_from_s(one.time_p95_s),
            "wall_median_ms": ms_from_s(one.wall_s),
            "position_ratio": one.position_ratio,
            "attitude_ratio": one.attitude_ratio,
            "time_ratio": one.time_ratio,
            "no_pose_reasons": one.reasons,
            "stage_median_ms": {stage: ms_from_s(value) for stage, value in one.stage_s.items()},
        }

    return {
        "protocol": list(result.protocol),
        "conditions": [
            {
                "group": condition.group,
                "label": condition.label,
                "range_mm": mm_from_m(condition.range_m),
                "view_angle_deg": deg_from_rad(condition.view_angle_rad),
                "paper_dn": condition.paper_dn,
                "exposure_ms": ms_from_s(condition.exposure_s),
                "motion_px": condition.motion_px,
                "psf_sigma_px": condition.psf_sigma_px,
                "methods": [row(one) for one in rows],
            }
            for condition, rows in result.conditions
        ],
        "overall": [row(one) for one in result.overall],
        "not_installed": list(result.not_installed),
    }
