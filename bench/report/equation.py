"""The equation of a fitted model: the terms that act at every site, and in words what acts elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

from latticebench.bench.report.document import Content, Number
from latticebench.bench.report.mathematics import (
    expression,
    latex,
    latex_summand,
    mathml,
    mathml_summand,
    text_of_sum,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    import sympy

    from latticebench.diagnosis.acting import Chain
    from latticebench.diagnosis.model import Model


class Summand(Content):
    """One term of the right-hand side.

    Attributes:
        effect: the effect that brought it in; None for a declared term.
        text: the term as text.
        coefficient: what it is multiplied by.
        latex, mathml: coefficient and term with their sign; empty where the coefficient is 0.
    """

    effect: str | None
    text: str
    coefficient: Number
    latex: str
    mathml: str


class Equation(Content):
    """An equation with numbers in it.

    Attributes:
        text: left-hand side and the terms that act at every site, on one line.
        latex: the same in LaTeX.
        left: the left-hand side and the sign of equality in MathML.
        terms: the terms that act at every site.
        elsewhere: what acts at single sites, at the ends and on the readings, one sentence each.
    """

    text: str
    latex: str
    left: str
    terms: tuple[Summand, ...]
    elsewhere: tuple[str, ...]


def equation(model: Model, chain: Chain) -> Equation:
    """Return the equation of a fitted model in all its forms."""
    import sympy

    terms: list[Summand] = []
    for effect, text, value, body in _everywhere(model, chain):
        first = not any(one.latex for one in terms)
        shown = (
            (latex_summand(value, body, first=first), mathml_summand(value, body, first=first)) if value else ("", "")
        )
        terms.append(Summand(effect=effect, text=text, coefficient=value, latex=shown[0], mathml=shown[1]))
    left = sympy.Symbol(rf"\{'d' * model.order}ot{{u}}_{{n}}")
    right = " ".join(one.latex for one in terms if one.latex) or "0"
    sum_ = text_of_sum([one.text for one in terms], [one.coefficient for one in terms])
    return Equation(
        text=f"u{chr(39) * model.order} = {sum_}", latex=f"{latex(left)} = {right}",
        left=f"<mrow>{mathml(left)}<mo>=</mo></mrow>", terms=tuple(terms),
        elsewhere=tuple(line for placed in model.effects for line in placed.sentences(chain)),
    )  # fmt: skip


def _everywhere(model: Model, chain: Chain) -> Iterator[tuple[str | None, str, float, sympy.Expr]]:
    """Yield the terms that act at every site: effect, text, coefficient and what it is multiplied with."""
    for text, value in zip(model.declared.texts, model.coefficients, strict=True):
        yield None, text, float(value), expression(text)
    for placed in model.effects:
        for one in placed.summands(chain):
            yield placed.effect.name, one.text, float(one.coefficient), one.body
