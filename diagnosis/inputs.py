"""How inputs go on between their samples, measured ones and the motion of outer sites: as the readings say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from latticebench.diagnosis import rules
from latticebench.diagnosis.border import FINENESS
from latticebench.diagnosis.fitting import Fitted
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.problem import DEGREES, Problem

WORDS = {
    0: "held until the next one",
    1: "straight lines",
    3: "cubic splines",
    7: "splines of degree 7",
}


def interpolations(problem: Problem, *, early: bool) -> list[Problem]:
    """Return the problem with its present interpolation of inputs, then with others.

    These are all there are while it is `early`, later those next to the present one; none without an input.
    """
    if not _has_input(problem):
        return [problem]
    here = DEGREES.index(problem.degree)
    others = DEGREES if early else DEGREES[max(here - 1, 0) : here + 2]
    return [problem, *(problem.interpolated(degree) for degree in others if degree != problem.degree)]


def likeliest(
    problems: Sequence[Problem], fitting: Callable[[Problem], Fitted | None]
) -> tuple[Problem, Fitted | None]:
    """Return the problem under which a model is most likely, and its fit; the first if none is plainly better."""
    best, fitted = problems[0], fitting(problems[0])
    least = float("inf") if fitted is None else fitted.cost - rules.EQUAL * fitted.dispersion
    for other in problems[1:]:
        found = fitting(other)
        if found is not None and found.cost < least:
            best, fitted, least = other, found, found.cost
    return best, fitted


def finest(
    problem: Problem, layout: Callable[[Problem], Layout], fitting: Callable[[Layout], Fitted | None]
) -> tuple[Problem, Fitted | None]:
    """Return the problem with curves of the outer sites that are as fine as the readings bear, and a model's fit.

    A curve that is too coarse makes up forces, one that is too fine only has evidence count for less: the finest is
    taken that the readings cannot tell from the likeliest.
    """
    fits: dict[int, tuple[Problem, Fitted]] = {}
    for fineness in FINENESS:
        other = replace(problem, fineness=fineness)
        laid = layout(other)
        width = max(0 if one is None else one.width for one in laid.borders)
        if width not in fits and (found := fitting(laid)) is not None:
            fits[width] = other, found
    if not fits:
        return problem, None
    best = min((one for _, one in fits.values()), key=lambda one: one.information)
    most = best.information + rules.EQUAL * best.dispersion
    return [pair for pair in fits.values() if pair[1].information <= most][-1]


def in_words(problem: Problem) -> str:
    """Return how inputs go on between their samples; nothing where the equation has none."""
    return WORDS[problem.degree] if _has_input(problem) else ""


def _has_input(problem: Problem) -> bool:
    return any("f" in term.names for term in problem.declared.terms)
