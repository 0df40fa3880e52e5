"""Equations as MathML, which browsers show without scripts or fonts of their own; SymPy writes the terms."""

from __future__ import annotations

import re
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Any

from latticebench.bench.report.report import everywhere
from latticebench.diagnosis.model import Change, Fitted
from latticebench.systems.parser import TermError
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    import sympy

FIELD = re.compile(r"([a-z]+)_\{n([+-]\d+)?\}")


def equation(fitted: Fitted, digits: int = 4) -> str:
    """Write the terms of a fitted equation that act at every site, as one MathML element."""
    dots = {1: "˙", 2: "¨"}[fitted.model.order]
    left = f"<msub><mover accent='true'><mi>u</mi><mo>{dots}</mo></mover><mi>n</mi></msub><mo>=</mo>"
    parts: list[str] = []
    for change, text, value in everywhere(fitted):
        if value == 0:
            continue
        sign = "−" if value < 0 else "+" if parts else ""
        # The sign stays with its term where a line is broken.
        lead = f"<mo{' form=' + chr(34) + 'infix' + chr(34) if parts else ''}>{sign}</mo>" if sign else ""
        body = "" if text == "1" else _body(change, text)
        # Two numbers side by side would read as one.
        times = "" if not body else "<mo>·</mo>" if re.match(r"(<m\w+>)*<mn>", body) else "<mo>&InvisibleTimes;</mo>"
        body = f"{lead}{number(abs(value), digits)}{times}{body}"
        kind = ' class="added"' if change is not None else ""
        parts.append(f"<math{kind}><mrow>{body}</mrow></math>")
    parts = parts or ["<math><mn>0</mn></math>"]
    # One element for each term, so that a narrow screen can break the line between them.
    return f'<span class="equation"><math><mrow>{left}</mrow></math> {" ".join(parts)}</span>'


def number(value: float, digits: int = 4) -> str:
    """Write a number that is not negative, with a power of ten where a plain decimal would be long."""
    text = f"{value:.{digits}g}"
    mantissa, e, exponent = text.partition("e")
    if not e:
        return f"<mn>{text}</mn>"
    power = int(exponent)
    sign = "<mo>−</mo>" if power < 0 else ""
    return f"<mn>{mantissa}</mn><mo>·</mo><msup><mn>10</mn><mrow>{sign}<mn>{abs(power)}</mn></mrow></msup>"


def _body(change: Change | None, text: str) -> str:
    """Write what a coefficient stands before; brackets where it is a sum."""
    lead = "<mi>i</mi><mo>&InvisibleTimes;</mo>" if text.startswith("i*") else ""
    acts = "" if change is None else change.effect.acts
    if change is not None and acts == "delayed":
        past = f"<mi>t</mi><mo>−</mo>{number(change.psi['delay'])}"
        return f"{lead}<msub><mi>u</mi><mi>n</mi></msub><mo>&ApplyFunction;</mo><mrow><mo>(</mo>{past}<mo>)</mo></mrow>"
    if change is not None and acts == "long range":
        far = term("u[n+1]+u[n-1]-2*u[n]").replace("<mn>1</mn>", "<mi>r</mi>")
        power = f"<msup><mi>r</mi>{_wrapped(number(change.psi['s'], 3))}</msup>"
        total = "<munder><mo>∑</mo><mrow><mi>r</mi><mo>≥</mo><mn>2</mn></mrow></munder>"
        return f"{lead}{total}<mfrac><mrow>{far}</mrow>{power}</mfrac>"
    if change is not None and acts == "pulse":
        away = f"<mrow><mo>(</mo><mi>t</mi><mo>−</mo>{number(abs(change.psi['at']))}<mo>)</mo></mrow>"
        away = away.replace("−", "+") if change.psi["at"] < 0 else away
        width = f"<msup>{_wrapped(number(change.psi['width']))}<mn>2</mn></msup>"
        power = f"<mo>−</mo><mfrac><msup>{away}<mn>2</mn></msup><mrow><mn>2</mn><mo>·</mo>{width}</mrow></mfrac>"
        shape = f"<msup><mi>e</mi>{_wrapped(power)}</msup>"
        rest = text.rpartition("**2/2)")[2].removeprefix("*")
        return shape if not rest else f"{shape}<mo>&InvisibleTimes;</mo>{_body(None, rest)}"
    if text.startswith("(-1)**k*"):
        sign = "<msup><mrow><mo>(</mo><mo>−</mo><mn>1</mn><mo>)</mo></mrow><mi>n</mi></msup>"
        return f"{sign}<mo>&InvisibleTimes;</mo>{_body(None, text.removeprefix('(-1)**k*'))}"
    try:
        shown = term(text)
    except TermError:
        return f"<mtext>{escape(text)}</mtext>"
    return f"<mrow><mo>(</mo>{shown}<mo>)</mo></mrow>" if _is_sum(text) else shown


def _wrapped(inner: str) -> str:
    return f"<mrow>{inner}</mrow>"


def _is_sum(text: str) -> bool:
    return bool(Term(text).expression.is_Add)


@cache
def term(text: str) -> str:
    """Write a term of the term language.

    Raises:
        TermError: it is none.
    """
    import sympy

    def decimal(value: sympy.Rational) -> sympy.Expr:
        return sympy.Float(value, 6)

    shown = Term(text).expression.replace(lambda part: part.is_Rational and not part.is_Integer, decimal)
    printer = _printer()
    found: str = printer._print(shown).toxml()
    # A browser's reader of HTML knows these names; the letters are those that textbooks have.
    for name, letter in (("&ImaginaryI;", "i"), ("&ExponentialE;", "e"), ("&#x2212;", "−")):
        found = found.replace(name, letter)
    return found.replace("<mo>-</mo>", "<mo>−</mo>")


@cache
def _printer() -> Any:
    """Make SymPy's printer, with the fields' indices and with conjugates that all browsers can show."""
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
            index = [self._element("mi", "n")]
            if found[2]:
                index += [self._element("mo", found[2][0]), self._element("mn", found[2][1:])]
            return self._element("msub", self._element("mi", found[1]), self._element("mrow", *index))

        def _print_conjugate(self, expression: Any) -> Any:
            inner = self._print(expression.args[0])
            return self._element("msup", self._element("mrow", inner), self._element("mo", "*"))

    return Printer()
