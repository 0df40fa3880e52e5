"""The axes of a block of a suite file: lists (a single value stands for a list of one), and seeds with their ranges."""

from __future__ import annotations

import re
from typing import Annotated, Any, TypeVar

import pydantic

from latticebench.bench.case import Seed

MOST_SEEDS = 10_000

T = TypeVar("T")


def _listed(value: Any) -> Any:
    if value == []:
        raise ValueError("an empty list makes no cases; leave the key out")
    return value if isinstance(value, list) else [value]


def _seeds(value: Any) -> Any:
    """Read "1-100" as the seeds from 1 to 100, and "1,3,7" as these three."""
    if not isinstance(value, str):
        return _listed(value)
    found: list[int] = []
    for part in value.split(","):
        ends = re.fullmatch(r"\s*([0-9]{1,9})\s*(?:-\s*([0-9]{1,9})\s*)?", part)
        first, last = (0, -1) if ends is None else (int(ends[1]), int(ends[2] or ends[1]))
        if last < first or last - first + len(found) >= MOST_SEEDS:
            raise ValueError(f'write at most {MOST_SEEDS} seeds as "1-100", the smaller one first, or as "1,3,7"')
        found += range(first, last + 1)
    return found


Listed = Annotated[list[T], pydantic.BeforeValidator(_listed)]
Seeds = Annotated[list[Seed], pydantic.BeforeValidator(_seeds)]
_SEEDS = pydantic.TypeAdapter(Seeds)


def read_seeds(value: Any) -> list[int]:
    """Return seeds from a text such as "1-100" or "1,3,7", or from a list of them.

    Raises:
        ValueError: they are no seeds.
    """
    try:
        return _SEEDS.validate_python(value)
    except pydantic.ValidationError as error:
        raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None
