"""What every number rests on: each calibration and document with its hash, its date and its age at the run."""

from __future__ import annotations

from datetime import datetime
from pathlib import PurePath

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.errors import UvgsError
from uvgs_bench.report.cells import Cell
from uvgs_bench.report.document import Alert, Alerts, Block, Column, Paragraph, Section, Table
from uvgs_bench.store.gantry_records import read_gantry_record
from uvgs_bench.store.run import Run
from uvgs_bench.store.run_writer import (
    SETUP,
    SETUP_BEACON,
    SETUP_BENCH,
    SETUP_CALIBRATION,
    SETUP_GANTRY,
    SETUP_PROCEDURE,
    SETUP_SENSOR,
)

_WORDS = {
    SETUP_CALIBRATION: "Camera calibration",
    SETUP_BEACON: "Beacon",
    SETUP_GANTRY: "Gantry self-test",
    SETUP_BENCH: "Bench",
    SETUP_PROCEDURE: "Procedure",
    SETUP_SENSOR: "Settings of the sensor",
    "controller_settings": "Settings of the controller",
}
_NO_DATE = "not recorded"


def build(run: Run, judgement: Judgement) -> Section | None:
    """Hashes, dates, ages, and what is missing in the chain."""
    del judgement
    hashes = run.manifest.hashes
    made = _dates(run)
    alerts: list[Alert] = []
    rows: list[tuple[Cell, ...]] = []
    for name in sorted(hashes, key=lambda name: (list(_WORDS).index(name) if name in _WORDS else 99, name)):
        date = made.get(name, "")
        age, is_later = _age(date, run.manifest.created_utc)
        if is_later:
            text = f"{_WORDS[name]} is dated {date}, after this run began: it is not what it claims to be."
            alerts.append(Alert("warning", text))
        source = _nearby(run.manifest.sources.get(name, ""))
        rows.append((_WORDS.get(name, name), date or _NO_DATE, age, source or _NO_DATE, hashes[name]))
    if SETUP_GANTRY not in hashes:
        text = (
            "The gantry was never judged by anything outside it: its axes are taken as declared, and an error of its "
            "scale or squareness counts as the sensor's."
        )
        alerts.append(Alert("warning", text))
    if run.beacon.covariance_m2 is None:
        text = "The beacon's LEDs were not measured: where they are is taken from its drawing, without a doubt."
        alerts.append(Alert("warning", text))
    columns = (Column("Rests on"), Column("Made"), Column("Age at the run"), Column("Read from"), Column("SHA-256"))
    text = (
        "Copies of these stand in the run's folder as they were when it began. Dates are what each document says of "
        "itself; a link without a date cannot be traced further."
    )
    blocks: list[Block] = [Paragraph(text)]
    if rows:
        blocks.append(Table("Documents behind every number of this report.", columns, tuple(rows)))
    if alerts:
        blocks.append(Alerts(tuple(alerts)))
    return Section("traceability", "Traceability", tuple(blocks))


def _nearby(path: str) -> str:
    """File and folder: a report that is handed on says nothing of the machine it was made on."""
    return "/".join(PurePath(path).parts[-2:])


def _dates(run: Run) -> dict[str, str]:
    """When each document says it was made, by the name of its copy."""
    found = {SETUP_CALIBRATION: run.calibration.notes.get("created_utc", "")}
    path = run.path / SETUP / SETUP_GANTRY
    if path.is_file():
        try:
            found[SETUP_GANTRY] = read_gantry_record(path).created_utc
        except UvgsError:
            # The chapter about the gantry says what is wrong with it.
            found[SETUP_GANTRY] = ""
    return found


def _age(made: str, begun: str) -> tuple[str, bool]:
    """Time from one instant to a later one in words, and whether they stand in the wrong order."""
    try:
        between = datetime.fromisoformat(begun) - datetime.fromisoformat(made)
    except (ValueError, TypeError):
        return _NO_DATE, False
    hours = between.total_seconds() / 3600.0
    if hours < 0.0:
        return "made later", True
    if hours < 48.0:
        return f"{hours:.1f} h", False
    return f"{hours / 24.0:.0f} days", False
