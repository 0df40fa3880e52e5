"""Terms compiled into NumPy and torch functions of real arrays, and their derivatives.

A field is split into real arrays, one per offset and part: u[n+1] on a complex field is p + i q with the two slots
("u", 1, "re") and ("u", 1, "im"). SymPy is loaded only when something is compiled, so that listing systems stays fast.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from latticebench.systems.parser import MAX_OFFSET, TermError
from latticebench.systems.terms import Term, site_symbol, symbolic

if TYPE_CHECKING:
    import sympy

Backend = Literal["numpy", "torch"]

# Integer powers up to this one are written as products.
MOST_FACTORS = 7


class Slot(NamedTuple):
    """A real array that a compiled function takes: part of a field at an offset, the time, or the site number.

    Attributes:
        name: u, v, f, t or n.
        offset: k in u[n+k]; 0 for t and n.
        part: real or imaginary part of the field; "re" for a real field, t and n.
    """

    name: str
    offset: int = 0
    part: Literal["re", "im"] = "re"

    @property
    def place(self) -> tuple[int, int]:
        """Where an array (order, parts, ...) of u and v has the field: 0 for u and 1 for v, 0 for re and 1 for im."""
        return int(self.name == "v"), int(self.part == "im")

    @property
    def vector(self) -> tuple[int, ...]:
        """The offset as `latticebench.systems.stencil.Stencil` takes it."""
        return (self.offset,)


@dataclass(frozen=True)
class Compiled:
    """SymPy expressions as one real function of real arrays, with common subexpressions shared.

    Attributes:
        slots: the arrays that the function takes, in this order.
        function: `function(*arrays)` takes one array per slot, all of one shape or broadcastable, and returns one array
            per expression; an expression without slots returns a number.
    """

    slots: tuple[Slot, ...]
    function: Callable[..., Sequence[Any]]


def real_parts(
    text: str, is_complex: bool, *, for_derivatives: bool = False
) -> tuple[dict[Slot, sympy.Symbol], tuple[sympy.Expr, ...]]:
    """Write a term in real variables.

    Args:
        text: the term.
        is_complex: whether the field is complex, u = p + i q; a measured input f is always real.
        for_derivatives: write the sign of a complex z as z/|z|, which SymPy can differentiate; undefined at z = 0.

    Returns:
        the symbol of each slot, and one expression for a real field or two (real and imaginary part) for a complex one.

    Raises:
        TermError: the term is complex on a real field.
    """
    import sympy

    expression = symbolic(text)
    slots: dict[Slot, sympy.Symbol] = {}
    values: dict[sympy.Symbol, sympy.Expr] = {}
    for name, offset in sorted(Term(text).sites):
        parts: tuple[Literal["re", "im"], ...] = ("re", "im") if is_complex and name != "f" else ("re",)
        for part in parts:
            slots[Slot(name, offset, part)] = sympy.Symbol(f"{name}{part}_{offset + MAX_OFFSET}", real=True)
        real = slots[Slot(name, offset)]
        values[site_symbol(name, offset)] = real + sympy.I * slots[Slot(name, offset, "im")] if "im" in parts else real
    for name in ("t", "n"):
        symbol = sympy.Symbol(name, real=True)
        if expression.has(symbol):
            slots[Slot(name)] = symbol
    written = expression.xreplace(values)
    if is_complex and for_derivatives:
        written = written.replace(
            lambda part: isinstance(part, sympy.sign) and not part.args[0].is_real,
            lambda part: part.args[0] / sympy.Abs(part.args[0]),
        )
    if is_complex:
        return slots, tuple(sympy.expand_complex(written).as_real_imag())
    if written.has(sympy.I):
        raise TermError(text, 0, "it is complex, but the field is real")
    return slots, (written,)


@functools.lru_cache(maxsize=512)
def compiled(texts: tuple[str, ...], is_complex: bool, backend: Backend = "numpy") -> Compiled:
    """Compile terms into one function.

    Returns:
        a function whose values are the real parts of all terms, followed for a complex field by their imaginary parts.

    Raises:
        TermError: a term is complex on a real field.
    """
    written = [real_parts(text, is_complex) for text in texts]
    slots = {slot: symbol for found, _ in written for slot, symbol in found.items()}
    expressions = [parts[k] for k in range(1 + is_complex) for _, parts in written]
    return _lambdify(slots, expressions, backend)


@functools.lru_cache(maxsize=512)
def partials(
    texts: tuple[str, ...], is_complex: bool, backend: Backend = "numpy"
) -> tuple[Compiled, tuple[tuple[int, int, Slot], ...]]:
    """Compile the derivatives of terms with respect to the real variables of u and v.

    Returns:
        the compiled function, and for each of its values (term, part, slot): the index of the term, its real (0) or
        imaginary (1) part, and the variable of the derivative. Derivatives that vanish identically are left out.

    Raises:
        TermError: a term is complex on a real field.
    """
    written = [real_parts(text, is_complex, for_derivatives=True) for text in texts]
    slots = {slot: symbol for found, _ in written for slot, symbol in found.items()}
    expressions, places = [], []
    for term, (found, parts) in enumerate(written):
        for part, expression in enumerate(parts):
            for slot, symbol in sorted(found.items(), key=lambda item: item[0]):
                derivative = expression.diff(symbol) if slot.name in ("u", "v") else 0
                if derivative != 0:
                    expressions.append(derivative)
                    places.append((term, part, slot))
    return _lambdify(slots, expressions, backend), tuple(places)


def _lambdify(slots: dict[Slot, sympy.Symbol], expressions: Sequence[sympy.Expr], backend: Backend) -> Compiled:
    import sympy
    from sympy.printing.numpy import NumPyPrinter

    class ProductPrinter(NumPyPrinter):  # type: ignore[misc]
        """Writes small integer powers as products, which are much faster."""

        def _print_Pow(self, expr: sympy.Pow, rational: bool = False) -> str:
            if expr.exp.is_Integer and 2 <= expr.exp <= MOST_FACTORS:
                return "(" + "*".join([f"({self._print(expr.base)})"] * int(expr.exp)) + ")"
            return str(super()._print_Pow(expr, rational=rational))

    order = sorted(slots)
    symbols = [slots[slot] for slot in order]
    smooth = [expression.replace(sympy.DiracDelta, lambda *_: sympy.Integer(0)) for expression in expressions]
    settings = {"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True}
    # For torch, SymPy's NumPy code with torch functions under the NumPy names.
    modules = "numpy" if backend == "numpy" else [_torch_names()]
    function = sympy.lambdify(symbols, smooth, modules=modules, printer=ProductPrinter(settings), cse=True)
    return Compiled(tuple(order), function)


def _torch_names() -> dict[str, Any]:
    """Return torch functions under the names that SymPy's NumPy code calls; they take plain numbers, too."""
    import torch

    def tensor(value: Any) -> torch.Tensor:
        if isinstance(value, torch.Tensor):
            return value
        return torch.as_tensor(value, dtype=torch.complex128 if isinstance(value, complex) else torch.float64)

    def lifted(function: Callable[..., torch.Tensor]) -> Callable[..., torch.Tensor]:
        return lambda *values: function(*(tensor(value) for value in values))

    def imaginary(value: torch.Tensor) -> torch.Tensor:
        return value.imag if value.is_complex() else torch.zeros_like(value)

    same = ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "abs", "angle", "real", "conj")
    return {
        **{name: lifted(getattr(torch, name)) for name in same},
        "sign": lifted(torch.sgn), "arctan": lifted(torch.atan), "arctan2": lifted(torch.atan2),
        "imag": lifted(imaginary), "pi": math.pi, "e": math.e,
    }  # fmt: skip
