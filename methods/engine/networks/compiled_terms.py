"""Terms and their derivatives compiled into one function, on NumPy arrays or torch tensors.

Subexpressions that several terms or derivatives share are computed once, and whole powers are products.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.compiler import Slot, real_parts

if TYPE_CHECKING:
    import sympy

FUNCTIONS = ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "sign", "abs")


@dataclass(frozen=True)
class CompiledTerms:
    """A library's terms T_j and the derivatives of sum_j xi_j T_j by what the terms read.

    Attributes:
        slots: what the terms read: a real or imaginary part of the field or the velocity at a site of the stencil, the
            input, the time or the site's number.
        slopes: (part, slot) of each derivative that is not zero: of the real (part 0) or imaginary (1) part of the sum,
            by a slot of u or v.
        function: takes one array per slot and then one number (or array) per coefficient. Returns a list: the terms'
            real parts (J of them), for a complex field their J imaginary parts, then one derivative per entry of
            `slopes`. An entry may be a plain number.
    """

    slots: tuple[Slot, ...]
    slopes: tuple[tuple[int, Slot], ...]
    function: Callable[..., Sequence[Any]]


@functools.lru_cache(maxsize=128)
def compile_terms(texts: tuple[str, ...], is_complex: bool, backend: str = "numpy") -> CompiledTerms:
    """Compile terms and their derivatives.

    Args:
        texts: the terms.
        is_complex: whether u = p + i q is complex.
        backend: `numpy` or `torch`.
    """
    import sympy

    written = [real_parts(text, is_complex) for text in texts]
    symbols = {slot: symbol for found, _ in written for slot, symbol in found.items()}
    slots = tuple(sorted(symbols))
    parts = 1 + is_complex
    xi = sympy.symbols(f"xi:{len(texts)}", real=True)
    expressions = [one[part] for part in range(parts) for _, one in written]
    slopes = []
    for part in range(parts):
        total = sympy.Add(*(x * one[part] for x, (_, one) in zip(xi, written, strict=True)))
        for slot in slots:
            derivative = total.diff(symbols[slot]) if slot.name in ("u", "v") else sympy.Integer(0)
            # The slope of sign(x) is zero wherever it exists.
            derivative = derivative.replace(sympy.DiracDelta, lambda *_: sympy.Integer(0))
            if derivative != 0:
                expressions.append(derivative)
                slopes.append((part, slot))
    arguments = [symbols[slot] for slot in slots] + list(xi)
    function = sympy.lambdify(arguments, expressions, modules=[_names(backend)], printer=_printer(), cse=True)
    return CompiledTerms(slots, tuple(slopes), function)


def _names(backend: str) -> dict[str, Any]:
    """Return what the names in the compiled code stand for."""
    if backend == "torch":
        import torch

        functions = {name: getattr(torch, name) for name in FUNCTIONS} | {"atan": torch.atan}
    else:
        functions = {name: getattr(np, name) for name in FUNCTIONS} | {"atan": np.arctan}
    return {"power": power, "pi": math.pi} | functions


def _printer() -> Any:
    """Return a printer of code in which whole powers are products, many times faster than pow, and sign a function."""
    import sympy
    from sympy.printing.pycode import PythonCodePrinter

    class TermPrinter(PythonCodePrinter):  # type: ignore[misc]
        """Print powers and signs in the functions that `_names` defines."""

        def _print_Pow(self, expr: sympy.Pow, rational: bool = False, sqrt: str = "sqrt") -> str:
            if expr.exp.is_Integer:
                return f"power({self._print(expr.base)}, {int(expr.exp)})"
            if expr.exp == sympy.Rational(1, 2):
                return f"sqrt({self._print(expr.base)})"
            if expr.exp == sympy.Rational(-1, 2):
                return f"(1/sqrt({self._print(expr.base)}))"
            return str(super()._print_Pow(expr, rational, sqrt))

        def _print_sign(self, expr: sympy.sign) -> str:
            return f"sign({self._print(expr.args[0])})"

    return TermPrinter({"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True})


def power(base: Any, exponent: int) -> Any:
    """Return base**exponent for a whole exponent, by repeated squaring."""
    if exponent < 0:
        return 1 / power(base, -exponent)
    if exponent == 0:
        return base * 0 + 1
    if exponent == 1:
        return base
    half = power(base, exponent // 2)
    return half * half * base if exponent % 2 else half * half
