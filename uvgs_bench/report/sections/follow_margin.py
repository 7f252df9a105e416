"""How much latency the loop bears: computed from the loop, found by trying, and what it had."""

from __future__ import annotations

from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Paragraph, Section, Table
from uvgs_bench.report.follow_evidence import FollowEvidence
from uvgs_bench.units import deg_from_rad


def build(evidence: FollowEvidence) -> Section | None:
    """One table, or nothing where the loop is not one of commanded accelerations."""
    fact = evidence.fact
    has_s = fact("margins", "latency_s")
    if has_s is None:
        return None
    borne_s = fact("margins", "largest_latency_s")
    phase_rad = fact("margins", "phase_margin_rad")
    rows: list[tuple[Cell, ...]] = [
        ("Latency, from mid-exposure to the command", Number(has_s, 3, "s")),
        ("Least latency at which the loop is unstable, by computing", Number(borne_s, 3, "s")),
        ("The same, by trying", Number(fact("simulated_largest_latency_s"), 3, "s")),
        ("Latency to spare", Number(None if borne_s is None else borne_s - has_s, 3, "s")),
        ("Phase margin", Number(None if phase_rad is None else deg_from_rad(phase_rad), 1, "deg")),
        ("Gain margin", Number(fact("margins", "gain_margin"), 2)),
        ("Crossover", Number(fact("margins", "crossover_radps"), 2, "rad/s")),
        ("Largest eigenvalue from capture to capture", Number(fact("margins", "spectral_radius"), 4)),
        ("Time between captures that are looked at", Number(fact("period_s"), 3, "s")),
    ]
    text = (
        "The position loop near its station: a double integrator, sampled at each capture, smoothed by a line through "
        "the last poses, held between commands. Computing takes it as linear; trying takes law, filter and body with "
        "their limits and pulses, and poses without noise. The pose filter does not delay a motion of constant "
        "velocity; its velocity is that of the middle of its memory, which both ways of counting include."
    )
    table = Table("Stability against latency.", (Column("Figure"), Column("Value", "", True)), tuple(rows))
    return Section("margin", "Margin against latency", (Paragraph(text), table))
