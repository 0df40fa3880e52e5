"""What the tests of reports share."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import resources
from typing import Any

import jsonschema
import pytest

from latticebench.bench.report.document import to_json
from latticebench.bench.report.schema import DOCUMENTS

Conforms = Callable[[str, str], dict[str, Any]]


@pytest.fixture
def conforms() -> Conforms:
    """Check that a document is JSON without NaN, as its published schema says, and is read back as it was."""

    def check(kind: str, text: str) -> dict[str, Any]:
        schemas = resources.files("latticebench.bench.report") / "schemas"
        schema = json.loads((schemas / f"{kind}.json").read_text(encoding="utf-8"))
        found: dict[str, Any] = json.loads(text, parse_constant=pytest.fail)
        jsonschema.validate(found, schema, jsonschema.Draft202012Validator)
        assert found["schema"] == f"latticebench/{kind}/1"
        assert set(found["provenance"]) >= {"command", "commit", "date", "machine", "versions", "seeds"}
        assert to_json(DOCUMENTS[kind].model_validate_json(text)) == text
        return found

    return check
