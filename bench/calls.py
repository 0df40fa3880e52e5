"""What the command line and a notebook do alike with recordings, simulated ones too, and an equation.

The commands of `bench/cli` read options, and `latticebench.front` arguments; both then make these calls, so that they
compute the same and refuse in the same words.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from latticebench.methods.method import Fit, Method, Skipped, solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.options import option
from latticebench.systems.samples import Samples
from latticebench.systems.user_files import raised

if TYPE_CHECKING:
    from latticebench.bench.adequacy import Adequacy
    from latticebench.bench.bounds import BoundOf
    from latticebench.bench.fitting import FitCase
    from latticebench.bench.report.content import Report
    from latticebench.diagnosis.repair import Diagnosis
    from latticebench.diagnosis.search import Watcher


def case_of(**given: Any) -> FitCase:
    """Return the case that describes simulated samples; who fits them is left open.

    Raises:
        InputError: what is given describes no samples; the message has the option of the command line.
    """
    import pydantic

    from latticebench.bench.fitting import FitCase

    try:
        return FitCase(**{"library": "", "label": "", "method": "", "memory_limit": 2**30, **given})
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise InputError(f"{option(str(first['loc'][0]))}: {first['msg'].lower()}, it is {first['input']!r}") from None


def fit(data: Sequence[Samples], library: Library, order: int, method: Method, seed: int) -> Fit:
    """Fit a library to recordings, by one thread: on matrices of these sizes more are slower.

    Raises:
        InputError: the method cannot fit them, or failed.
    """
    with told(data, method.name), threadpool_limits(1, user_api="blas"):
        return solve(method, data, library, order, seed)


def judged(data: Sequence[Samples], found: Fit) -> Adequacy:
    """Return how well a fitted equation describes the recordings it was fitted to, with hints where it does not."""
    from latticebench.bench.adequacy import adequacy
    from latticebench.bench.report.notes import doubts, mixed_up
    from latticebench.diagnosis import exchanged

    how_well = adequacy(data, found)
    if how_well.fits:
        return how_well
    order = exchanged.of_recordings(found.library, found.order, data)
    return how_well.also((*doubts(data, found.library), *([mixed_up(data[0], order)] if order else [])))


def diagnose(
    data: Sequence[Samples],
    declared: Library,
    order: int,
    *,
    effects: Path | None = None,
    later: Sequence[Samples] = (),
    watcher: Watcher | None = None,
) -> tuple[Diagnosis, Report]:
    """Find what a declared equation lacks, and what is to be said of it; Ctrl-C keeps what earlier horizons have found.

    Args:
        data: recordings.
        declared: terms of the equation.
        order: of the time derivative.
        effects: a file with effects that are tried beside the catalogue.
        later: recordings to judge forecasts on.
        watcher: called with a text that says what is being done.

    Raises:
        InputError: the equation cannot be set up on the recordings, or the file of effects is invalid.
        KeyboardInterrupt: Ctrl-C, before the first horizon is done.
    """
    from latticebench.bench.report.content import content
    from latticebench.diagnosis import repair
    from latticebench.systems.effects import CATALOGUE
    from latticebench.systems.user_files import load_effects

    catalogue = (*CATALOGUE, *(load_effects(effects) if effects is not None else ()))
    with told(data):
        try:
            found = repair.diagnose(declared, order, data, catalogue, held_out=later, watcher=watcher)
        except repair.Interrupted as stop:
            return stop.diagnosis, content(stop.diagnosis, interrupted=True)
    return found, content(found)


def bound(data: Sequence[Samples], library: Library, order: int) -> BoundOf:
    """Return how well any method could know the coefficients from recordings.

    Raises:
        InputError: the equation cannot be set up on them.
    """
    from latticebench.bench.bounds import of_recordings

    with told(data), threadpool_limits(1, user_api="blas"):
        return of_recordings(data, library, order)


@contextmanager
def told(data: Sequence[Samples], method: str = "") -> Iterator[None]:
    """Turn whatever ends a computation into one line of text.

    Args:
        data: the recordings, whose first one the line names.
        method: the one that fits them; empty for a diagnosis or a bound.

    Raises:
        InputError: it was skipped, or it failed.
    """
    source = data[0].source
    try:
        yield
    except Skipped as reason:
        if not method:
            raise InputError(f"{source}: {reason}") from None
        raise InputError(f"method {method!r} cannot fit {source}: {reason}; choose another method") from None
    except InputError:
        raise
    except Exception as error:
        what = f"method {method!r}" if method else "the computation"
        raise InputError(f"{source}: {what} failed: {raised(error)}") from error
