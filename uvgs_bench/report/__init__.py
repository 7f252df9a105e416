"""Finished runs as pages.

Here: the document model, its chapters, and what renders it as web page, PDF and JSON. In: ``Run`` and ``Judgement``,
or a calibration. Out: files. Plug point: ``SECTIONS`` (sections/__init__.py).
"""

from uvgs_bench.report.build import build_document
from uvgs_bench.report.calibration_page import build_calibration_document
from uvgs_bench.report.document import Document
from uvgs_bench.report.write import FORMATS, check_formats, check_replaceable, write_document, write_reports

__all__ = [
    "FORMATS",
    "Document",
    "build_calibration_document",
    "build_document",
    "check_formats",
    "check_replaceable",
    "write_document",
    "write_reports",
]
