"""What all JSON documents have in common: a schema with its version, provenance, and one rule for numbers.

A number that is not known (NaN) is `null` in JSON, an infinite one the text "inf" or "-inf".
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Annotated, Any

import pydantic
from typing_extensions import TypeAliasType

from latticebench.bench.provenance import command_line, origin

# A list of numbers over several lines; no text of JSON has a line break.
_ENTRY = r'(?:-?\d[\d.eE+-]*|null|"-?inf")'
NUMBERS = re.compile(rf"\[\n\s+({_ENTRY}(?:,\s+{_ENTRY})*)\s+\]")


def _read(value: Any) -> Any:
    """Return NaN for None; pydantic reads "inf" itself."""
    return math.nan if value is None else value


def _plain(value: float) -> float | str | None:
    """Return what JSON can hold of a number."""
    if math.isfinite(value):
        return value
    return None if math.isnan(value) else "inf" if value > 0 else "-inf"


Number = TypeAliasType(
    "Number",
    Annotated[
        float,
        pydantic.BeforeValidator(_read),
        pydantic.PlainSerializer(_plain),
        pydantic.WithJsonSchema({"anyOf": [{"type": "number"}, {"enum": ["inf", "-inf", None]}]}),
    ],
)
"""A float; NaN and infinities are written as JSON can hold them."""


class Content(pydantic.BaseModel):
    """A part of a document; frozen, with no other keys than its own."""

    model_config = pydantic.ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, json_schema_serialization_defaults_required=True
    )


class Provenance(pydantic.BaseModel):
    """Where a document comes from; results of several sessions have lists of what differs, and more keys."""

    model_config = pydantic.ConfigDict(extra="allow", frozen=True)

    command: str
    commit: str | list[str]
    date: str | list[str]
    machine: str | list[str]
    versions: dict[str, str]
    seeds: list[int]


class Document(Content):
    """A JSON document.

    Attributes:
        schema_: in JSON `schema`: name and version, such as "latticebench/fit/1"; the version grows when a key goes or
            changes its meaning.
        provenance: where the document comes from.
    """

    schema_: str = pydantic.Field(validation_alias="schema", serialization_alias="schema")
    provenance: Provenance


class Pair(Content):
    """A number for the declared equation and for the equation with what was found."""

    before: Number
    after: Number


def provenance(seeds: Sequence[int] = ()) -> Provenance:
    """Return where what this process computes comes from."""
    return Provenance(command=command_line(), seeds=list(seeds), **origin())


def to_json(content: Content) -> str:
    """Return a document as the text of a JSON file; lists of numbers are written in one line."""
    text = content.model_dump_json(by_alias=True, indent=2)
    return NUMBERS.sub(lambda found: "[" + re.sub(r"\s+", " ", found[1]) + "]", text) + "\n"


def to_dict(content: Content) -> dict[str, Any]:
    """Return a document as dictionaries, lists, texts and numbers that JSON can hold."""
    return content.model_dump(mode="json", by_alias=True)
