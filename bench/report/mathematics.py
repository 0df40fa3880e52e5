"""Sums of terms as text in the term language, as LaTeX, and as MathML for browsers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

from latticebench.methods.method import Fit

if TYPE_CHECKING:
    import sympy

DIGITS = 4


# Text -----------------------------------------------------------------------------------------------------------------


def written(fit: Fit, digits: int = DIGITS) -> str:
    """Return the fitted equation as one line of the term language, without the terms whose coefficient is 0."""
    left = "u'" if fit.order == 1 else "u''"
    return f"{left} = {text_of_sum(fit.library.texts, [float(value) for value in fit.coefficients], digits)}"


def text_of_sum(texts: Sequence[str], values: Sequence[float], digits: int = DIGITS) -> str:
    """Return a sum of coefficients times terms as text; `0` where every coefficient is 0."""
    parts = []
    for text, value in zip(texts, values, strict=True):
        if value == 0:
            continue
        sign = "-" if value < 0 else "+"
        bare = f"{abs(value):.{digits}g}"
        factor = f"({text})" if _is_sum(text) else text
        parts.append(f"{sign} {bare}" if text == "1" else f"{sign} {bare}*{factor}")
    return " ".join(parts).removeprefix("+ ") or "0"


def _is_sum(text: str) -> bool:
    """Return whether a text needs brackets behind a factor: it has a plus or minus outside of brackets."""
    bare, inner = "", text
    while inner != bare:
        bare, inner = inner, re.sub(r"\([^()]*\)|\[[^\[\]]*\]", "_", inner)
    return re.search(r"(?<!\*)(?<![\d.]e)[+-]", bare) is not None


# LaTeX and MathML -----------------------------------------------------------------------------------------------------


@cache
def expression(text: str) -> sympy.Expr:
    """Return the SymPy expression of a term, with decimals in the place of fractions.

    Raises:
        TermError: the text is not in the term language.
    """
    from latticebench.systems.terms import Term

    return Term(text).in_decimals


def latex(body: sympy.Expr) -> str:
    """Return an expression in LaTeX, without dollar signs."""
    from latticebench.bench.report.printers import LatticeLatex

    return LatticeLatex().doprint(body)  # type: ignore[no-any-return]


def mathml(body: sympy.Expr) -> str:
    """Return an expression in presentation MathML, without the outermost element `math`."""
    from latticebench.bench.report.printers import LatticeMathML

    return LatticeMathML().doprint(body)


def latex_summand(value: float, body: sympy.Expr, *, first: bool = False) -> str:
    """Return a coefficient times an expression in LaTeX, with its sign; the first one has no plus."""
    shown = "" if body == 1 else rf"\left({latex(body)}\right)" if body.is_Add else latex(body)
    text = f"{_sign(value, first)} {latex(_rounded(value))} {shown}".strip()
    return re.sub(r"(\d) (?=\{?\d)", r"\1 \\cdot ", text)


def mathml_summand(value: float, body: sympy.Expr, *, first: bool = False) -> str:
    """Return a coefficient times an expression in MathML, with its sign; the first one has no plus."""
    sign = _sign(value, first).replace("-", "−")
    # A sign stays with its term where the line is broken.
    lead = f"<mo{'' if first else ' form=' + chr(34) + 'infix' + chr(34)}>{sign}</mo>" if sign else ""
    shown = "" if body == 1 else f"<mo>&InvisibleTimes;</mo>{mathml(body)}"
    if body.is_Add:
        shown = f"<mrow><mo>(</mo>{mathml(body)}<mo>)</mo></mrow>"
    text = f"<mrow>{lead}{mathml(_rounded(value))}{shown}</mrow>"
    return re.sub(r"</mn><mo>&InvisibleTimes;</mo>(?=(<m\w+>)*<mn>)", "</mn><mo>·</mo>", text)


def _sign(value: float, first: bool) -> str:
    return "-" if value < 0 else "" if first else "+"


def _rounded(value: float) -> sympy.Expr:
    """Return the size of a coefficient with a few digits."""
    import sympy

    text = f"{abs(value):.{DIGITS}g}"
    return sympy.Integer(text) if text.isdigit() else sympy.Float(text, DIGITS)
