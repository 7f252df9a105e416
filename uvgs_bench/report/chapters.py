"""The chapters of a report, built in the order of their table."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from uvgs_bench.report.document import Section


def built_sections(table: Mapping[str, str], *subject: object) -> tuple[Section, ...]:
    """Build every chapter of a table that has something to say.

    Args:
        table: Key to ``"module:function"``, in reading order.
        subject: What each function gets.

    Returns:
        The chapters, without those whose function gave None.
    """
    found: list[Section] = []
    for target in table.values():
        module, function = target.split(":")
        build: Any = getattr(importlib.import_module(module), function)
        section = build(*subject)
        if section is not None:
            assert isinstance(section, Section)
            found.append(section)
    return tuple(found)
