"""The axes of a block of a suite file: lists (a single value stands for a list of one) and ranges of seeds."""

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
    """Read "1-100" as the seeds from 1 to 100."""
    if not isinstance(value, str):
        return _listed(value)
    found = re.fullmatch(r"\s*(\d{1,9})\s*-\s*(\d{1,9})\s*", value)
    if found is None or not 0 <= int(found[2]) - int(found[1]) < MOST_SEEDS:
        raise ValueError(f'write a range of at most {MOST_SEEDS} seeds as "1-100", the smaller one first')
    return list(range(int(found[1]), int(found[2]) + 1))


Listed = Annotated[list[T], pydantic.BeforeValidator(_listed)]
Seeds = Annotated[list[Seed], pydantic.BeforeValidator(_seeds)]
