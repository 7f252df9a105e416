"""What of the set-up does not fit the data: clocks and mounting, found by the least surprise of the filter."""

from __future__ import annotations

from uvgs_bench.navigation.fusion_outcome import FusionOutcome
from uvgs_bench.report.cells import Cell, Number
from uvgs_bench.report.document import Column, Paragraph, Section, Table
from uvgs_bench.units import deg_from_rad, mm_from_m, ms_from_s


def build(outcome: FusionOutcome) -> Section | None:
    """A row per number; nothing where it could not be looked for."""
    misfit = outcome.misfit
    if misfit is None:
        return None
    names = ["Sensor's stamps too late", *(f"Camera turned about its {a}" for a in "xyz")]
    names += [f"Camera moved along its {a}" for a in "xyz"]
    values = [ms_from_s(misfit.offset_s), *deg_from_rad(misfit.rotation_rad), *mm_from_m(misfit.shift_m)]
    sigmas = [ms_from_s(float(misfit.sigma[0])), *deg_from_rad(misfit.sigma[1:4]), *mm_from_m(misfit.sigma[4:])]
    units = ["ms", "deg", "deg", "deg", "mm", "mm", "mm"]
    rows: list[tuple[Cell, ...]] = []
    for name, value, sigma, unit, known in zip(names, values, sigmas, units, misfit.is_known, strict=True):
        shown = Number(float(value), 2, unit) if known else "not told by this motion"
        rows.append((name, shown, Number(float(sigma), 2, unit)))
    columns = (Column("What"), Column("Found", "", True), Column("1 sigma", "", True))
    text = (
        "The clock offset and the mounting of the camera that would leave the filter least surprised, against what is "
        f"stated. Squared innovations per number, 1 expected: {misfit.surprise_before:.2f} as stated, "
        f"{misfit.surprise_after:.2f} with these. Nothing of this was put right in the fusion."
    )
    return Section(
        "fit", "Clocks and mounting", (Paragraph(text), Table("Misfit of the set-up.", columns, tuple(rows)))
    )
