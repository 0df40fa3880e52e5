"""Terms: one text for code, suite files, the command line, tables and figures.

`parser` checks a text; here it becomes one SymPy expression, and from it LaTeX, symmetries and the coefficients of an
equation over a library; `compiler` makes functions and derivatives of it. SymPy is loaded only when an expression is
needed, so that listing systems stays fast.
"""

from __future__ import annotations

import ast
import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from latticebench.systems.errors import InputError
from latticebench.systems.parser import FIELDS, FUNCTIONS, TermError, parse, site_offset

if TYPE_CHECKING:
    import sympy
    from jaxtyping import Float
    from numpy import ndarray


# Rounding leaves less of an expression that is zero.
NOTHING = 1e-9


@dataclass(frozen=True)
class Term:
    """One function of the stencil, kept as the text that was given.

    Raises:
        TermError: the text is not in the term language.
    """

    text: str

    def __post_init__(self) -> None:
        """Check the text; the SymPy expression is made when it is needed."""
        _plain(self.text)

    def __str__(self) -> str:
        """Return the text."""
        return self.text

    @property
    def plain(self) -> str:
        """The text without blanks and needless brackets: one for all ways of writing the same operations."""
        return _plain(self.text)

    @property
    def reach(self) -> tuple[int, int]:
        """The number of sites that the term reads to the left and to the right, both >= 0."""
        offsets = [0, *(offset for _, offset in self.sites)]
        return -min(offsets), max(offsets)

    @property
    def sites(self) -> frozenset[tuple[str, int]]:
        """The fields and offsets that occur, such as ("u", 1) for u[n+1]."""
        return _sites(self.text)

    @property
    def names(self) -> frozenset[str]:
        """The names that occur, among u, v, f, t, n, i, pi and the functions."""
        return _names(self.text)

    @property
    def jumps(self) -> bool:
        """Whether the term is dry friction, sign(v[n]), which jumps where the velocity changes its sign."""
        return self.plain == "sign(v[n])"

    @property
    def expression(self) -> sympy.Expr:
        """The SymPy expression over the complex symbols u_{n+1}, v_{n}, ... and the real ones t and n."""
        return symbolic(self.text)

    @property
    def in_decimals(self) -> sympy.Expr:
        """The SymPy expression with decimals in the place of fractions."""
        import sympy

        def decimal(value: sympy.Rational) -> sympy.Expr:
            return sympy.Float(value, 6)

        return self.expression.replace(lambda part: part.is_Rational and not part.is_Integer, decimal)

    @property
    def latex(self) -> str:
        """The term in LaTeX, without dollar signs."""
        import sympy

        def decimal(number: sympy.Rational) -> sympy.Expr:
            return number if number.q <= 12 else sympy.Float(number, 6)

        shown = self.expression.replace(lambda part: part.is_Rational and not part.is_Integer, decimal)
        return str(sympy.latex(shown, order="none"))

    @property
    def parity(self) -> Literal[-1, 1] | None:
        """1 for a term that is even under (u, v, f) -> -(u, v, f), -1 for an odd one, None for neither."""
        flipped = self.expression.subs({s: -s for s in self.expression.free_symbols if s.name[0] in FIELDS})
        if _vanishes(flipped - self.expression):
            return 1
        return -1 if _vanishes(flipped + self.expression) else None

    @property
    def degrees(self) -> tuple[float, float, float] | None:
        """The powers of u, v and f with which the term grows: (1, 2, 0) of u[n]*v[n]**2; None where it is no power."""
        return _degrees(self.text)

    @property
    def turns_with_phase(self) -> bool:
        """Whether u -> exp(i a) u (and v, f likewise) multiplies the term by exp(i a) for every real a."""
        import sympy

        turn = sympy.exp(sympy.I * sympy.Symbol("a", real=True))
        fields = [s for s in self.expression.free_symbols if s.name[0] in FIELDS]
        turned = self.expression.subs({s: s * turn for s in fields}, simultaneous=True)
        difference = sympy.expand(turned / turn - self.expression).replace(sympy.Abs, _abs_of_product)
        return _vanishes(difference)


def _vanishes(expression: sympy.Expr) -> bool:
    """Return whether an expression is zero everywhere, by its value at a point before SymPy simplifies it.

    SymPy takes sines of large multiples of u apart, without end.
    """
    import sympy

    if expression == 0:
        return True
    symbols = sorted(expression.free_symbols, key=lambda one: one.name)
    point = {one: (0.3 + 0.1 * k) + (0 if one.is_real else 0.2j) for k, one in enumerate(symbols)}
    value = expression.subs(point).evalf()
    if value.is_number and abs(complex(value)) > NOTHING:
        return False
    return bool(sympy.simplify(expression) == 0)


@functools.lru_cache(maxsize=4096)
def _degrees(text: str) -> tuple[float, float, float] | None:
    expression = symbolic(text)
    symbols = sorted(expression.free_symbols, key=lambda one: one.name)

    def value(place: int, field: str = "", factor: float = 1.0) -> complex:
        """Return the expression at one of several points, the values of one field times a factor."""
        point = {one: 0.31 + 0.17 * ((3 * k + 2 * place) % 7) for k, one in enumerate(symbols)}
        return complex(
            expression.subs({one: at * (factor if one.name[0] == field else 1) for one, at in point.items()}).evalf()
        )

    powers = []
    for field in FIELDS:
        grown = [(value(place), value(place, field, factor), factor) for place in range(2) for factor in (2.0, 3.0)]
        if any(before == 0 or (after / before).real <= 0 for before, after, _ in grown):
            return None
        found = [math.log((after / before).real, factor) for before, after, factor in grown]
        if max(found) - min(found) > NOTHING:
            return None
        powers.append(round(found[0], 9) + 0.0)
    return powers[0], powers[1], powers[2]


@functools.lru_cache(maxsize=4096)
def _plain(text: str) -> str:
    return ast.unparse(parse(text))


@functools.lru_cache(maxsize=4096)
def _sites(text: str) -> frozenset[tuple[str, int]]:
    return frozenset(
        (node.value.id, site_offset(node.slice) or 0)
        for node in ast.walk(parse(text))
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name)
    )


@functools.lru_cache(maxsize=4096)
def _names(text: str) -> frozenset[str]:
    tree = parse(text)
    # The n of an index is no site number.
    indices = {part for node in ast.walk(tree) if isinstance(node, ast.Subscript) for part in ast.walk(node.slice)}
    return frozenset(node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and node not in indices)


def _abs_of_product(argument: sympy.Expr) -> sympy.Expr:
    """Return |a b ...| as |a| |b| ..., which SymPy leaves as it is."""
    import sympy

    return sympy.Mul(*(sympy.Abs(factor) for factor in sympy.Mul.make_args(argument)))


def split(text: str) -> tuple[Term, ...]:
    """Return the terms of a text, in which they are separated by `;`.

    Raises:
        TermError: one of them is not in the term language.
    """
    return tuple(Term(part.strip()) for part in text.split(";") if part.strip())


def substitute(text: str, values: dict[str, float]) -> str:
    """Return a text with numbers in place of the names in `values`.

    Raises:
        TermError: the text has a name that is neither in the language nor in `values`.
    """

    class Put(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.expr:
            if node.id not in values:
                return node
            size = ast.Constant(abs(values[node.id]))
            # A sign inside the constant would bind more weakly than a power: -2**2 is -4.
            return ast.UnaryOp(ast.USub(), size) if values[node.id] < 0 else size

        def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
            return node

    return ast.unparse(Put().visit(parse(text, tuple(values))))


@functools.cache
def symbolic(text: str, names: tuple[str, ...] = ()) -> sympy.Expr:
    """Return a term as a SymPy expression; numbers become exact rationals, `names` real symbols.

    Raises:
        TermError: the text is not in the term language, or divides by zero.
    """
    import sympy

    expression = _build(parse(text, names))
    if expression.has(sympy.zoo, sympy.nan, sympy.oo):
        raise TermError(text, 0, "it divides by zero")
    return expression


def _build(node: ast.expr) -> sympy.Expr:
    """Turn a checked tree into SymPy."""
    import sympy

    match node:
        case ast.Constant(value=value):
            return sympy.Rational(str(value))
        case ast.Name(id=name):
            return {"i": sympy.I, "pi": sympy.pi}.get(name, sympy.Symbol(name, real=True))
        case ast.Subscript(value=ast.Name(id=name), slice=index):
            return site_symbol(name, site_offset(index) or 0)
        case ast.UnaryOp(op=sign, operand=operand):
            return -_build(operand) if isinstance(sign, ast.USub) else _build(operand)
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return _functions()[name](_build(argument))
        case ast.BinOp(left=left, op=sign, right=right):
            return _OPERATORS[type(sign)](_build(left), _build(right))
    raise AssertionError(ast.dump(node))


_OPERATORS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}


@functools.cache
def _functions() -> dict[str, Any]:
    """Return the SymPy function of each name of the language."""
    import sympy

    renamed = {"abs": "Abs", "conj": "conjugate"}
    return {name: getattr(sympy, renamed.get(name, name)) for name in FUNCTIONS}


def site_symbol(name: str, offset: int) -> sympy.Symbol:
    """Return the complex symbol of field `name` at site n + `offset`, such as u_{n+1}."""
    import sympy

    return sympy.Symbol(f"{name}_{{n{offset:+d}}}" if offset else f"{name}_{{n}}", complex=True)


def combination(terms: Sequence[Term], coefficients: Sequence[float]) -> Term:
    """Return the sum of coefficients times terms as one term, with every digit of the coefficients."""
    parts = [f"{value:.17g}*({term.text})" for term, value in zip(terms, coefficients, strict=True) if value != 0]
    return Term(" + ".join(parts) or "0")


def express(target: Term, terms: Sequence[Term], is_complex: bool) -> Float[ndarray, " terms"] | None:
    """Return the coefficients of `target` as a real linear combination of `terms`.

    Target and terms are expanded into monomials, and the linear system over these is solved.

    Returns:
        the coefficients, each in the unit of the target over that of its term; None if the target is outside the span.

    Raises:
        InputError: the terms are linearly dependent, so that no coefficient is defined, or a number is too large.
    """
    columns = [_monomials(term.text, is_complex) for term in terms]
    goal = _monomials(target.text, is_complex)
    basis = sorted({monomial for column in [*columns, goal] for monomial in column}, key=str)
    try:
        matrix = np.array([[complex(column.get(monomial, 0)) for column in columns] for monomial in basis])
        wanted = np.array([complex(goal.get(monomial, 0)) for monomial in basis])
    except OverflowError:
        raise InputError(f"a number in {target.text!r} or in the library is too large") from None
    if not (np.all(np.isfinite(matrix)) and np.all(np.isfinite(wanted))):
        raise InputError(f"a number in {target.text!r} or in the library is too large")
    matrix = np.concatenate([matrix.real, matrix.imag])
    wanted = np.concatenate([wanted.real, wanted.imag])
    scale = np.linalg.norm(matrix, axis=0)
    if np.any(scale == 0):
        raise InputError(f"term {terms[int(np.argmin(scale))].text!r} is always zero; leave it out")
    solution, _, rank, _ = np.linalg.lstsq(matrix / scale, wanted, rcond=1e-10)
    if rank < len(terms):
        listed = "; ".join(term.text for term in terms)
        raise InputError(f"terms depend linearly on each other, leave one out: {listed}")
    if np.linalg.norm(matrix / scale @ solution - wanted) > 1e-10 * np.linalg.norm(wanted):
        return None
    coefficients = solution / scale
    coefficients[np.abs(coefficients) < 1e-12 * np.max(np.abs(coefficients))] = 0.0
    # The numbers of an equation are short; linear algebra leaves rounding errors in the last digits.
    return np.array([float(f"{value:.13g}") for value in coefficients])


@functools.lru_cache(maxsize=4096)
def _monomials(text: str, is_complex: bool) -> dict[sympy.Expr, sympy.Expr]:
    """Return a term as {monomial: number}; |u|^2 is u conj(u) on a complex field and u^2 on a real one."""
    import sympy

    expression = symbolic(text)
    if is_complex:
        expression = expression.replace(
            lambda part: part.is_Pow and isinstance(part.base, sympy.Abs) and part.exp.is_even,
            lambda part: (part.base.args[0] * sympy.conjugate(part.base.args[0])) ** (part.exp / 2),
        )
    else:
        fields = [symbol for symbol in expression.free_symbols if not symbol.is_real]
        expression = expression.xreplace({symbol: sympy.Symbol(symbol.name, real=True) for symbol in fields})
    numbers: dict[sympy.Expr, sympy.Expr] = {}
    for piece in sympy.Add.make_args(sympy.expand(expression)):
        number, monomial = piece.as_independent(*piece.free_symbols, as_Add=False)
        numbers[monomial] = numbers.get(monomial, 0) + number
    return {monomial: number for monomial, number in numbers.items() if number != 0}
