"""What the texts on the command line stand for: equations and numbers; and how outputs that fail are told."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from latticebench.systems.lattice import Library, System


def asked(
    system: str | None, library: str | None, terms: str | None, order: int | None
) -> tuple[System | None, Library, int]:
    """Return the system, library and order that --system, --library, --terms and --order ask for.

    Raises:
        InputError: they contradict one another, or do not suffice.
    """
    from latticebench import systems
    from latticebench.systems.lattice import library as make_library

    known = None if system is None else systems.find(system)
    if terms is not None and library is not None:
        raise InputError("--terms and --library: give one of them")
    if terms is not None:
        candidates = make_library("terms", terms)
    elif known is not None:
        if library is None:
            raise InputError(
                f"--library: choose one of {', '.join(one.name for one in known.libraries)}, or give --terms"
            )
        candidates = known.library(library)
    else:
        raise InputError(
            'give --system and --library, or --terms and --order, such as --terms "u[n+1]; u[n-1]; u[n]" --order 2'
        )
    if order is None:
        if known is None:
            raise InputError("give --order: 1 for du/dt, 2 for the second derivative")
        order = known.order
    return known, candidates, order


def pairs(given: Sequence[str] | None) -> dict[str, str]:
    """Read NAME=VALUE pairs.

    Raises:
        InputError: a text is no such pair.
    """
    pairs = {}
    for text in given or ():
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise InputError(f"--set {text!r}: write NAME=VALUE, such as --set threshold=0.1")
        pairs[name.strip()] = value.strip()
    return pairs


def numbers(given: Sequence[str] | None) -> dict[str, float]:
    """Read NAME=VALUE pairs whose values are finite numbers.

    Raises:
        InputError: a value is no finite number.
    """
    numbers = {}
    for name, value in pairs(given).items():
        try:
            numbers[name] = float(value)
        except ValueError:
            numbers[name] = math.nan
        if not math.isfinite(numbers[name]):
            raise InputError(f"--set {name}={value}: {value!r} is not a number")
    return numbers


@contextmanager
def kept(failures: list[str]) -> Iterator[None]:
    """Keep the message of a place that fails: what was computed must not be lost to it, nor another output."""
    try:
        yield
    except InputError as error:
        failures.append(str(error))
