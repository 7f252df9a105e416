"""Writing reports to disk: each file whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from uvgs_bench.accuracy.judgement import Judgement
from uvgs_bench.errors import ConfigError
from uvgs_bench.report.build import build_document
from uvgs_bench.report.document import Document
from uvgs_bench.report.html import render_html
from uvgs_bench.report.json_export import render_json
from uvgs_bench.report.pdf import render_pdf
from uvgs_bench.store.documents import write_atomically
from uvgs_bench.store.run import Run

FORMATS: dict[str, Callable[[Document], str | bytes]] = {"html": render_html, "pdf": render_pdf, "json": render_json}
"""Format, which is also the file's ending, to its renderer."""


def check_formats(formats: Iterable[str]) -> tuple[str, ...]:
    """Refuse a format nobody knows.

    Args:
        formats: Names as people wrote them.

    Returns:
        The names in lower case, each once.

    Raises:
        ConfigError: None at all, or an unknown one.
    """
    names = tuple(dict.fromkeys(name.strip().lower() for name in formats if name.strip()))
    unknown = [name for name in names if name not in FORMATS]
    if unknown or not names:
        said = f"unknown format '{unknown[0]}'" if unknown else "no format given"
        raise ConfigError(f"{said}, expected one or more of {', '.join(FORMATS)}", "--format")
    return names


def check_replaceable(folder: Path, formats: Iterable[str] = tuple(FORMATS), *, force: bool = False) -> dict[str, Path]:
    """Refuse to replace a report, before the work it describes begins.

    Args:
        folder: Where ``report.<format>`` will go.
        formats: Names out of ``FORMATS``.
        force: Whether existing files may be replaced.

    Returns:
        Format to file.

    Raises:
        ConfigError: Unknown format, the folder is a file, or a file exists that may not be replaced.
    """
    paths = {name: folder / f"report.{name}" for name in check_formats(formats)}
    if folder.exists() and not folder.is_dir():
        raise ConfigError("is a file, expected a folder for the report", str(folder))
    for path in paths.values():
        if path.exists() and not force:
            raise ConfigError("exists already; use --force to replace it", str(path))
    return paths


def write_document(
    document: Document, folder: Path, formats: Iterable[str] = tuple(FORMATS), *, force: bool = True
) -> dict[str, Path]:
    """Write a report in several formats.

    Args:
        document: The report.
        folder: Where ``report.<format>`` go; created when missing.
        formats: Names out of ``FORMATS``.
        force: Whether existing files may be replaced; nothing is written when one of them may not.

    Returns:
        Format to file.

    Raises:
        ConfigError: Unknown format, or a file exists that may not be replaced.
        UvgsError: Typesetting or writing failed.
    """
    paths = check_replaceable(folder, formats, force=force)
    for name, path in paths.items():
        write_atomically(path, FORMATS[name](document))
    return paths


def write_reports(
    run: Run, judgement: Judgement, folder: Path, formats: Iterable[str] = tuple(FORMATS), *, force: bool = True
) -> dict[str, Path]:
    """Build the report of a run and write it.

    Args:
        run: The run.
        judgement: What its errors amount to.
        folder: As ``write_document``.
        formats: As ``write_document``.
        force: As ``write_document``.

    Returns:
        Format to file.

    Raises:
        ConfigError: As ``write_document``.
        UvgsError: As ``write_document``.
    """
    return write_document(build_document(run, judgement), folder, formats, force=force)
