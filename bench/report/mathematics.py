"""Sums of terms as text in the term language, as LaTeX, and as MathML for browsers.

SymPy's printers write LaTeX and MathML. They are taught the notation of a lattice: u with the index n+k, its time
derivatives with dots, and sums over r >= 2.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from latticebench.methods.method import Fit

if TYPE_CHECKING:
    import sympy

# A field with its dots and its index, such as \ddot{u}_{n} or u_{n+1}.
FIELD = re.compile(r"(?:\\(d?dot)\{)?([a-z]+)\}?_\{n(?:([+-])(\w+))?\}")
DOTS = {"dot": "˙", "ddot": "¨"}
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
    import sympy

    from latticebench.systems.terms import Term

    def decimal(value: sympy.Rational) -> sympy.Expr:
        return sympy.Float(value, 6)

    return Term(text).expression.replace(lambda part: part.is_Rational and not part.is_Integer, decimal)


def latex(body: sympy.Expr) -> str:
    """Return an expression in LaTeX, without dollar signs."""
    return _latex_printer().doprint(body)  # type: ignore[no-any-return]


def mathml(body: sympy.Expr) -> str:
    """Return an expression in presentation MathML, without the outermost element `math`."""
    found: str = _mathml_printer()._print(body).toxml()
    for hyphen in ("<mo>-", "<mn>-"):
        found = found.replace(hyphen, hyphen[:-1] + "−")
    return found


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


@cache
def _latex_printer() -> Any:
    from sympy.printing.latex import LatexPrinter

    class Printer(LatexPrinter):  # type: ignore[misc]
        def _print_Sum(self, total: Any) -> str:
            ((index, low, _),) = total.limits
            return rf"\sum_{{{index} \ge {low}}} {self._print(total.function)}"

    return Printer()


@cache
def _mathml_printer() -> Any:
    """Return SymPy's printer with the notation of a lattice, and without elements that browsers lack."""
    from sympy import Symbol
    from sympy.printing.mathml import MathMLPresentationPrinter

    class Printer(MathMLPresentationPrinter):  # type: ignore[misc]
        def _element(self, tag: str, *inner: Any) -> Any:
            made = self.dom.createElement(tag)
            for one in inner:
                made.appendChild(self.dom.createTextNode(one) if isinstance(one, str) else one)
            return made

        def _print_Symbol(self, symbol: Any, style: str = "plain") -> Any:
            found = FIELD.fullmatch(symbol.name)
            if not found:
                return super()._print_Symbol(symbol, style)
            dots, letter, sign, distance = found.groups()
            name = self._element("mi", letter)
            if dots:
                name = self._element("mover", name, self._element("mo", DOTS[dots]))
                name.setAttribute("accent", "true")
            index = [self._element("mi", "n")]
            if sign:
                index += [
                    self._element("mo", sign),
                    self._element("mn" if distance.isdigit() else "mi", distance),
                ]
            return self._element("msub", name, self._element("mrow", *index))

        def _print_AppliedUndef(self, called: Any) -> Any:
            name = self._print(Symbol(called.func.__name__))
            return self._element("mrow", name, self._paren_comma_separated(*called.args))

        def _print_Sum(self, total: Any) -> Any:
            ((index, low, _),) = total.limits
            under = self._element("mrow", self._print(index), self._element("mo", "≥"), self._print(low))
            sign = self._element("munder", self._element("mo", "∑"), under)
            return self._element("mrow", sign, self._print(total.function))

        def _print_conjugate(self, of: Any) -> Any:
            return self._element("msup", self._element("mrow", self._print(of.args[0])), self._element("mo", "*"))

        def _print_UnevaluatedExpr(self, of: Any) -> Any:
            return self._print(of.args[0])

        def _print_ImaginaryUnit(self, _: Any) -> Any:
            return self._element("mi", "i")

        def _print_Exp1(self, _: Any) -> Any:
            return self._element("mi", "e")

    return Printer()
