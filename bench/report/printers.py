"""SymPy's printers with the notation of a lattice: u with the index n+k, dots for time derivatives, sums over r >= 2.

Loading this module loads SymPy.
"""

from __future__ import annotations

import re
from typing import Any

from sympy import Symbol
from sympy.printing.latex import LatexPrinter
from sympy.printing.mathml import MathMLPresentationPrinter

# A field with its dots and its index, such as \ddot{u}_{n} or u_{n+1}.
FIELD = re.compile(r"(?:\\(d?dot)\{)?([a-z]+)\}?_\{n(?:([+-])(\w+))?\}")
DOTS = {"dot": "˙", "ddot": "¨"}


class LatticeLatex(LatexPrinter):  # type: ignore[misc]
    """Writes LaTeX."""

    def _print_Sum(self, total: Any) -> str:
        ((index, low, _),) = total.limits
        return rf"\sum_{{{index} \geq {low}}} {self._print(total.function)}"


class LatticeMathML(MathMLPresentationPrinter):  # type: ignore[misc]
    """Writes presentation MathML without the elements that browsers lack."""

    def doprint(self, body: Any) -> str:
        """Return an expression without the outermost element `math`, with minus signs instead of hyphens."""
        found: str = self._print(body).toxml()
        return found.replace("<mo>-", "<mo>−").replace("<mn>-", "<mn>−")

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
            index += [self._element("mo", sign), self._element("mn" if distance.isdigit() else "mi", distance)]
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
