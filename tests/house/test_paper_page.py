"""The page that leads from the paper to the commands names only what there is."""

from __future__ import annotations

import re
from pathlib import Path

import typer
from typer.core import TyperGroup

from uvgs_bench.cli.app import build_app

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "paper_to_commands.md").read_text(encoding="utf-8")


def test_every_file_it_names_is_there() -> None:
    names = set(re.findall(r"(?:procedures|calib|docs|firmware)/[\w./-]*", PAGE))
    assert len(names) > 15
    assert [name for name in names if not (ROOT / name).exists()] == []
    # Rows that continue a name given before.
    short = re.findall(r"`(svgs_\w+\.toml)`", PAGE)
    assert [name for name in short if not (ROOT / "procedures" / name).exists()] == []


def test_every_command_and_option_it_names_is_there() -> None:
    root = typer.main.get_command(build_app())
    assert isinstance(root, TyperGroup)
    context = typer.Context(root)
    for said in set(re.findall(r"`uvgs ([^`]+)`", PAGE)):
        words = said.split()
        command = root.get_command(context, words[0])
        assert command is not None, said
        if isinstance(command, TyperGroup) and len(words) > 1:
            command = command.get_command(typer.Context(command), words[1])
            assert command is not None, said
        options = {name for parameter in command.params for name in parameter.opts}
        assert [word for word in words if word.startswith("--") and word not in options] == [], said


def test_every_section_figure_and_table_of_the_paper_has_a_row() -> None:
    sections = ("1.1", "1.2", "2.1", "2.2", "2.3", "2.4", "2.5", "2.6", "2.7", "2.8", "3.1", "3.2", "3.3", "3.4")
    assert [name for name in sections if name not in PAGE] == []
    named: set[int] = set()
    for part in re.findall(r"Figures? ([\d ,to]+)", PAGE):
        for piece in part.replace(" ", "").split(","):
            ends = [int(number) for number in piece.split("to") if number]
            named |= set(range(ends[0], ends[-1] + 1)) if ends else set()
    assert sorted(set(range(1, 27)) - named) == []
    assert "Table 1" in PAGE
