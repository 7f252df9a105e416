"""The report as JSON: the same numbers for machines, under a versioned schema."""

from __future__ import annotations

import json

from uvgs_bench.report.document import Document, document_data


def render_json(document: Document) -> str:
    """Render strict JSON.

    Args:
        document: The report.

    Returns:
        JSON text that ends in a newline; absent numbers are null, never NaN.
    """
    return json.dumps(document_data(document), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
