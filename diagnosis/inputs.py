"""How inputs go on between their samples, measured ones and the motion of outer sites: as the readings say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from latticebench.diagnosis import rules
from latticebench.diagnosis.border import FINENESS
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.problem import DEGREES, Problem

WORDS = {
    0: "held until the next one",
    1: "straight lines",
    3: "cubic splines",
    7: "splines of degree 7",
}


def interpolations(problem: Problem, *, early: bool) -> list[Problem]:
    """Return the problem with its present interpolation of inputs, then with others.

    These are all there are while it is `early`, later those next to the present one; none without an input. Where the
    ends are unknown, curves of the outer sites follow that are finer, or less fine.
    """
    found = [problem]
    if _has_input(problem):
        here = DEGREES.index(problem.degree)
        others = DEGREES if early else DEGREES[max(here - 1, 0) : here + 2]
        found += [problem.interpolated(degree) for degree in others if degree != problem.degree]
    if len(problem.plain.border):
        found += [replace(problem, fineness=one) for one in FINENESS if one != problem.fineness]
    return found


def likeliest(
    problems: Sequence[Problem], fitting: Callable[[Problem], Fitted | None]
) -> tuple[Problem, Fitted | None]:
    """Return the problem under which a model is most likely, and its fit; the first if none is plainly better."""
    best, fitted = problems[0], fitting(problems[0])
    least = float("inf") if fitted is None else fitted.information - rules.EQUAL * fitted.dispersion
    for other in problems[1:]:
        found = fitting(other)
        if found is not None and found.information < least:
            best, fitted, least = other, found, found.information
    return best, fitted


def in_words(problem: Problem) -> str:
    """Return how inputs go on between their samples; nothing where the equation has none."""
    return WORDS[problem.degree] if _has_input(problem) else ""


def _has_input(problem: Problem) -> bool:
    return any("f" in term.names for term in problem.declared.terms)
