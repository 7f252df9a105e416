"""What a calibration may be used for: each rule with its limit and what was found, and what to photograph next."""

from __future__ import annotations

import numpy as np

from uvgs_bench.camera.fitting import CalibrationResult
from uvgs_bench.camera.verdict import (
    DRIFT_SIGMAS,
    LEAST_SHARE,
    LIMIT_PX,
    MAX_FOCAL_DRIFT,
    MAX_FOCAL_SIGMA,
    MAX_HALVES_RATIO,
    MAX_HELD_OUT_RATIO,
    MIN_TILT_RAD,
    NOISE_FLOOR_PX,
    WHOLE_SHARE,
    doubt_factor,
    good_radius_px,
)
from uvgs_bench.report.calibration_evidence import CalibrationEvidence
from uvgs_bench.report.cells import Cell, Mark, Number, State
from uvgs_bench.report.document import Alert, Alerts, Block, Column, Paragraph, Section, Table
from uvgs_bench.units import deg_from_rad

_PERCENT = 100.0


def build(evidence: CalibrationEvidence) -> Section | None:
    """Reasons, rules, wishes, warnings."""
    verdict, result = evidence.calibration.verdict, evidence.result
    if verdict is None and result is None:
        return None
    blocks: list[Block] = []
    if result is not None:
        columns = (Column("Rule"), Column("Limit"), Column("Found", is_numeric=True), Column("Verdict"))
        caption = "The rules; one that fails makes the calibration unusable. They hold for every camera alike."
        blocks.append(Table(caption, columns, rules(result)))
    if verdict is not None:
        reasons: list[tuple[Cell, ...]] = [("because", reason) for reason in verdict.reasons]
        reasons += [("next", wish) for wish in verdict.next_pictures]
        if reasons:
            words = (Column("What"), Column("In words"))
            blocks.append(Table("Why, and what to photograph next, what helps most first.", words, tuple(reasons)))
    if result is not None and result.warnings:
        blocks.append(Alerts(tuple(Alert("warning", text) for text in result.warnings)))
    if not blocks:
        blocks.append(Paragraph("The camera file names no reasons."))
    return Section("verdict", "Verdict", tuple(blocks))


def rules(result: CalibrationResult) -> tuple[tuple[Cell, ...], ...]:
    """Each rule as a row: words, limit, found, mark.

    Args:
        result: The calibration with its examination.

    Returns:
        Rows; a mark ``fail`` stands for a reason not to use the calibration.
    """
    calibration, structure, halves = result.calibration, result.structure, result.split_half
    assert calibration.sigmas is not None
    assert calibration.rms_px is not None
    whole_px = result.coverage.picture_radius_px
    least_px, full_px = LEAST_SHARE * whole_px, WHOLE_SHARE * whole_px
    rows: list[tuple[Cell, ...]] = []
    for words, radius_px in (
        (f"Radius within which the total error stays below {LIMIT_PX} px", good_radius_px(result)),
        ("Radius covered by boards", result.coverage.radius_px),
    ):
        state: State = "pass" if radius_px >= least_px else "fail"
        word = "whole" if radius_px >= full_px else "in part" if state == "pass" else ""
        limit = f"≥ {least_px:.0f} px, whole picture: ≥ {full_px:.0f} px"
        rows.append((words, limit, Number(radius_px, 0, "px"), Mark(state, word)))
    relative = float((calibration.sigmas[:2] / calibration.lens.parameters[:2]).max()) * doubt_factor(result)
    rows.append(
        (
            "Focal length, 1 sigma, times the halves' ratio where above 1",
            f"≤ {_PERCENT * MAX_FOCAL_SIGMA:.1f} %",
            Number(_PERCENT * relative, 3, "%"),
            _mark(relative <= MAX_FOCAL_SIGMA),
        )
    )
    rows.append(
        (
            "Residual shared by neighbouring corners",
            f"≤ {LIMIT_PX} px",
            Number(structure.systematic_px, 3, "px"),
            _mark(structure.systematic_px <= LIMIT_PX),
        )
    )
    held_out = calibration.held_out_rms_px
    if held_out is not None:
        rows.append(
            (
                f"Held-out RMS over fitted RMS (or held out below {NOISE_FLOOR_PX} px)",
                f"≤ {MAX_HELD_OUT_RATIO} times",
                Number(held_out / max(calibration.rms_px, 1e-12), 2, "times"),
                _mark(held_out <= max(MAX_HELD_OUT_RATIO * calibration.rms_px, NOISE_FLOOR_PX)),
            )
        )
    rows.append(
        (
            "Largest tilt of a board",
            f"≥ {deg_from_rad(MIN_TILT_RAD):.1f} deg",
            Number(float(deg_from_rad(result.max_tilt_rad)), 1, "deg"),
            _mark(result.max_tilt_rad >= MIN_TILT_RAD),
        )
    )
    if not result.is_at_rest:
        rows.insert(0, ("The adjustment came to rest", "yes", "no", Mark("fail")))
    trends = result.trends
    if trends is not None and np.isfinite(trends.drift):
        stands_out = abs(trends.drift) > DRIFT_SIGMAS * trends.drift_sigma
        rows.append(
            (
                f"Drift of the focal length over the pictures (1 sigma {_PERCENT * trends.drift_sigma:.2f} %)",
                f"≤ {_PERCENT * MAX_FOCAL_DRIFT:.1f} % or {DRIFT_SIGMAS:.0f} sigma",
                Number(_PERCENT * trends.drift, 2, "%"),
                _mark(not (stands_out and abs(trends.drift) > MAX_FOCAL_DRIFT)),
            )
        )
    ratio = np.nan if halves is None else halves.ratio
    rows.append(
        (
            "Difference of two halves over its prediction",
            f"≤ {MAX_HALVES_RATIO:.0f} times",
            Number(ratio, 2, "times"),
            Mark("inconclusive", "too few views") if halves is None else _mark(ratio <= MAX_HALVES_RATIO),
        )
    )
    verdict = calibration.verdict
    is_refused = verdict is not None and verdict.word == "not_usable"
    if is_refused and not any(isinstance(row[3], Mark) and row[3].state == "fail" for row in rows):
        # Never a page of passes under a refusal.
        rows.append(("Another reason, given in words below", "", "", Mark("fail")))
    return tuple(rows)


def _mark(is_met: bool) -> Mark:
    return Mark("pass" if is_met else "fail")
