"""What the session was told: scenario, law, filter, body, as they were."""

from __future__ import annotations

from uvgs_bench.report.cells import Cell
from uvgs_bench.report.document import Column, Paragraph, Section, Table
from uvgs_bench.report.follow_evidence import FollowEvidence

_PARTS = (("law", "The follower law"), ("filter", "The pose filter"), ("flyer", "The simulated body"))


def build(evidence: FollowEvidence) -> Section | None:
    """One table a part; nothing where the record does not say."""
    scenario = evidence.run.manifest.facts.get("scenario")
    if not isinstance(scenario, dict):
        return None
    parts = [(name, title) for name, title in _PARTS if isinstance(scenario.get(name), dict)]
    plain = {key: value for key, value in scenario.items() if not isinstance(value, dict)}
    leader = scenario.get("leader")
    if isinstance(leader, dict):
        plain |= {f"leader {key}": value for key, value in leader.items() if key != "places"}
        plain["leader places"] = len(leader.get("places", ()))
    description = str(plain.pop("description", "")) or "no description"
    tables = [_table("The scenario", plain)] + [_table(title, scenario[name]) for name, title in parts]
    return Section("setup", "Set-up", (Paragraph(f"{description[0].upper()}{description[1:]}."), *tables))


def _table(title: str, values: dict[str, object]) -> Table:
    rows: list[tuple[Cell, ...]] = [(key, _shown(value)) for key, value in values.items()]
    return Table(f"{title}; each name ends in its unit.", (Column("Key"), Column("Value")), tuple(rows))


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list | tuple):
        return ", ".join(_shown(item) for item in value)
    return str(value)
