"""Help pages break lines where sentences end, or where the terminal does."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
import typer

from uvgs_bench.cli.app import build_app


def pages(command: Any, path: str = "uvgs") -> Iterator[tuple[str, str]]:
    """Every command with its help."""
    yield path, command.help or ""
    for name, part in getattr(command, "commands", {}).items():
        yield from pages(part, f"{path} {name}")


PAGES = dict(pages(typer.main.get_command(build_app())))


def test_there_are_pages_of_several_paragraphs() -> None:
    assert sum("\n\n" in text for text in PAGES.values()) >= 5


@pytest.mark.parametrize("path", PAGES)
def test_no_sentence_is_broken(path: str) -> None:
    for line in re.split(r"\n", PAGES[path]):
        assert not line or re.search(r"[.:;?!]$", line), line
