"""The kinds of JSON documents and their JSON Schemas.

The schemas are published in the folder `schemas`; `latticebench schema --out bench/report/schemas` writes them.
"""

from __future__ import annotations

import json

from latticebench.bench.report.content import DiagnosisDocument
from latticebench.bench.report.document import Document
from latticebench.bench.report.outputs import (
    AgainstDocument,
    CompareDocument,
    FiguresDocument,
    FitDocument,
    InspectionDocument,
    LimitDocument,
    ListDocument,
    RunDocument,
)

DIALECT = "https://json-schema.org/draft/2020-12/schema"
DOCUMENTS: dict[str, type[Document]] = {
    "fit": FitDocument, "limit": LimitDocument, "diagnosis": DiagnosisDocument, "run": RunDocument,
    "compare": CompareDocument, "against": AgainstDocument, "figures": FiguresDocument, "list": ListDocument,
    "inspection": InspectionDocument,
}  # fmt: skip


def json_schema(kind: str) -> str:
    """Return the JSON Schema of a kind of document, as the text of a file."""
    schema = DOCUMENTS[kind].model_json_schema(mode="serialization")
    return json.dumps({"$schema": DIALECT, **schema}, indent=2) + "\n"
