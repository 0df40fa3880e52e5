"""The term language: one text for code, suite files, the command line, tables and figures.

A term is a function of the stencil around site n, such as `u[n+1]+u[n-1]-2*u[n]`, `abs(u[n])**2*u[n]`,
`sin(2*u[n])`, `sign(v[n])`, `cos(1.7*t)`, `n*u[n]`, `f[n]` or `i*u[n]`:

    u[n+k], v[n+k], f[n+k]   field, its velocity, a measured input, k sites to the right
    n                        site number counted from the middle of the chain: 1..N minus (N+1)/2
    t, i, pi                 time, imaginary unit, 3.14159...
    + - * / **               the power must be a number
    sin cos tan atan sinh cosh tanh exp log sqrt abs sign conj re im

The way of a text: `check` (a whitelist over Python's syntax tree; nothing is ever evaluated), then one SymPy expression
(`Term.expression`), and from it NumPy and torch functions, LaTeX, symmetries and derivatives.
SymPy is loaded at the second step only, so that listing systems stays fast.
"""

from __future__ import annotations

import ast
import functools
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    import sympy
    from jaxtyping import Float
    from numpy import ndarray

FIELDS = ("u", "v", "f")
FUNCTIONS = (
    "sin", "cos", "tan", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "abs", "sign", "conj", "re", "im",
)  # fmt: skip
CONSTANTS = ("t", "n", "i", "pi")

MAX_LENGTH = 4000
MAX_DEPTH = 100
MAX_OFFSET = 50
MAX_POWER = 12
MAX_DEGREE = 24
MAX_MONOMIALS = 200
MAX_NESTED = 5
MAX_NUMBER = 1e12

Backend = Literal["numpy", "torch"]


class TermError(InputError):
    """A text that is no term; the message shows the text and points at the place."""

    def __init__(self, text: str, column: int, problem: str) -> None:
        """Say what is wrong with `text` at the zero-based `column`."""
        shown = text if len(text) <= 80 else text[:77] + "..."
        super().__init__(f"term {shown!r}, column {column + 1}: {problem}")
        self.column = column


def check(text: str, names: tuple[str, ...] = ()) -> ast.expr:
    """Parse a term into a syntax tree that holds nothing but the term language.

    Args:
        text: the term.
        names: further names that stand for numbers (a system's parameters, the position x).

    Raises:
        TermError: anything outside the language, or of absurd size.
    """
    if len(text) > MAX_LENGTH:
        raise TermError(text, MAX_LENGTH, f"longer than {MAX_LENGTH} characters; split it into several terms")
    for column, character in enumerate(text.rstrip()):
        if character == "#" or (character in "\r\n" and text[:column].strip()):
            raise TermError(text, column, "a term is one line without a comment")
    # A leading blank is an indentation to Python; the columns of errors are those of the text as given.
    lead = len(text) - len(text.lstrip())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        column = (getattr(error, "offset", None) or 1) - 1 + lead
        hint = "write abs(u[n]) for |u_n|" if "|" in text else "write for example u[n+1]+u[n-1]-2*u[n]"
        problem = "it is empty" if not text.strip() else f"not an expression; {hint}"
        raise TermError(text, column, problem) from None
    if _depth(tree) > MAX_DEPTH:
        raise TermError(text, 0, f"nested deeper than {MAX_DEPTH}; split it into several terms")
    _Whitelist(text, names, lead).visit(tree)
    return tree


def _depth(tree: ast.expr) -> int:
    """Count the levels of a tree, without recursion."""
    level: list[ast.AST] = [tree]
    depth = 0
    while level and depth <= MAX_DEPTH:
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        depth += 1
    return depth


class _Whitelist(ast.NodeVisitor):
    """Refuses every node that the term language does not have."""

    def __init__(self, text: str, names: tuple[str, ...], lead: int) -> None:
        self.text, self.names, self.lead = text, names, lead
        self.nested = 0

    def refuse(self, node: ast.AST, problem: str) -> TermError:
        return TermError(self.text, getattr(node, "col_offset", 0) + self.lead, problem)

    def generic_visit(self, node: ast.AST) -> None:
        raise self.refuse(node, f"{type(node).__name__} is not part of the term language")

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)):
            hint = "; write i*u[n] for the imaginary unit" if isinstance(node.value, complex) else ""
            raise self.refuse(node, f"{node.value!r} is not a real number{hint}")
        if not abs(node.value) <= MAX_NUMBER:
            raise self.refuse(node, f"numbers end at {MAX_NUMBER:g}")

    def visit_Name(self, node: ast.Name) -> None:
        if node.id in CONSTANTS or node.id in self.names:
            return
        if node.id in FIELDS:
            raise self.refuse(node, f"{node.id} needs a site: {node.id}[n]")
        if node.id in FUNCTIONS:
            raise self.refuse(node, f"{node.id} is a function: {node.id}(...)")
        known = ", ".join((*(f"{name}[n]" for name in FIELDS), *CONSTANTS, *self.names))
        raise self.refuse(node, f"unknown name {node.id!r}; there are: {known}")

    def visit_Subscript(self, node: ast.Subscript) -> None:
        if not isinstance(node.value, ast.Name) or node.value.id not in FIELDS:
            raise self.refuse(node, f"only {', '.join(FIELDS)} have sites")
        if isinstance(node.slice, ast.Tuple):
            raise self.refuse(node.slice, "lattices of two and more dimensions are not supported yet; use one index")
        offset = _offset(node.slice)
        if offset is None:
            raise self.refuse(node.slice, f"a site is n, n+K or n-K with a whole number K: {node.value.id}[n+1]")
        if abs(offset) > MAX_OFFSET:
            raise self.refuse(node.slice, f"a site is at most {MAX_OFFSET} away: {node.value.id}[n+{MAX_OFFSET}]")

    def visit_Call(self, node: ast.Call) -> None:
        if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTIONS:
            called = node.func.id if isinstance(node.func, ast.Name) else "this"
            raise self.refuse(node, f"{called} cannot be called; there are: {', '.join(FUNCTIONS)}")
        if len(node.args) != 1 or node.keywords:
            raise self.refuse(node, f"{node.func.id} takes one argument")
        if self.nested == MAX_NESTED:
            raise self.refuse(node, f"functions are nested deeper than {MAX_NESTED}")
        self.nested += 1
        self.visit(node.args[0])
        self.nested -= 1

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if not isinstance(node.op, (ast.UAdd, ast.USub)):
            raise self.refuse(node, "the signs are + and -")
        self.visit(node.operand)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if isinstance(node.op, ast.BitXor):
            raise self.refuse(node, "write ** for a power")
        if not isinstance(node.op, (ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Pow)):
            raise self.refuse(node, "the operators are + - * / **")
        self.visit(node.left)
        if isinstance(node.op, ast.Pow):
            power = _number(node.right)
            if power is None:
                raise self.refuse(node.right, "a power must be a number, as in u[n]**3")
            if not abs(power) <= MAX_POWER:
                raise self.refuse(node.right, f"powers end at {MAX_POWER}")
        else:
            self.visit(node.right)
        if isinstance(node.op, (ast.Mult, ast.Pow)) and _monomial_count(node) > MAX_MONOMIALS:
            raise self.refuse(node, f"multiplied out it has more than {MAX_MONOMIALS} parts")
        if _degree(node) > MAX_DEGREE:
            raise self.refuse(node, f"the total power is above {MAX_DEGREE}")
        value = _number(node)
        if value is not None and not abs(value) <= MAX_NUMBER:
            raise self.refuse(node, f"numbers end at {MAX_NUMBER:g}")


def _offset(node: ast.expr) -> int | None:
    """Read K from n, n+K or n-K; None for anything else."""
    if isinstance(node, ast.Name) and node.id == "n":
        return 0
    if (
        isinstance(node, ast.BinOp)
        and isinstance(node.op, (ast.Add, ast.Sub))
        and isinstance(node.left, ast.Name)
        and node.left.id == "n"
        and isinstance(node.right, ast.Constant)
        and type(node.right.value) is int
    ):
        return node.right.value if isinstance(node.op, ast.Add) else -node.right.value
    return None


def _number(node: ast.expr) -> float | None:
    """Read the value of a tree of numbers; None when it holds anything else, inf when it is not a finite real."""
    match node:
        case ast.Constant(value=int() | float() as value):
            return float(value) if abs(value) <= 1e300 else math.inf
        case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=operand):
            inner = _number(operand)
            return None if inner is None else (-inner if isinstance(sign, ast.USub) else inner)
        case ast.BinOp(left=left, op=op, right=right):
            a, b = _number(left), _number(right)
            if a is None or b is None:
                return None
            try:
                match op:
                    case ast.Add():
                        return a + b
                    case ast.Sub():
                        return a - b
                    case ast.Mult():
                        return a * b
                    case ast.Div():
                        return a / b
                    case ast.Pow():
                        value = a**b
                        return value if isinstance(value, float) else math.inf
            except (OverflowError, ZeroDivisionError):
                return math.inf
    return None


def _degree(node: ast.expr) -> float:
    """Bound the polynomial degree from above; a function has that of its argument."""
    match node:
        case ast.Subscript():
            return 1
        case ast.UnaryOp(operand=operand):
            return _degree(operand)
        case ast.Call(args=[argument]):
            return _degree(argument)
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return _degree(left) * max(1.0, abs(_number(right) or 0))
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div(), right=right):
            return _degree(left) + _degree(right)
        case ast.BinOp(left=left, right=right):
            return max(_degree(left), _degree(right))
    return 0


def _monomial_count(node: ast.expr) -> int:
    """Bound from above how many monomials a tree has when it is multiplied out; a function counts as one."""
    match node:
        case ast.UnaryOp(operand=operand):
            return _monomial_count(operand)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
            return _monomial_count(left) + _monomial_count(right)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return _monomial_count(left) * _monomial_count(right)
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            count, power = _monomial_count(left), math.ceil(abs(_number(right) or 0))
            return math.comb(count + power - 1, power)
        case ast.BinOp(left=left):
            return _monomial_count(left)
    return 1


@dataclass(frozen=True)
class Term:
    """One function of the stencil, kept as the text it was given as.

    Raises:
        TermError: the text is not in the term language.
    """

    text: str

    def __post_init__(self) -> None:
        """Check the text; the SymPy expression is made when it is needed."""
        check(self.text)

    def __str__(self) -> str:
        """Give the text back."""
        return self.text

    @property
    def reach(self) -> tuple[int, int]:
        """How many sites the term sees to the left and to the right, both >= 0."""
        offsets = [0, *(offset for _, offset in self.sites)]
        return -min(offsets), max(offsets)

    @property
    def sites(self) -> frozenset[tuple[str, int]]:
        """The fields and offsets that occur, such as ("u", 1) for u[n+1]."""
        return frozenset(
            (node.value.id, _offset(node.slice) or 0)
            for node in ast.walk(check(self.text))
            if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name)
        )

    @property
    def names(self) -> frozenset[str]:
        """The names that occur, among u, v, f, t, n, i, pi and the functions."""
        bare = ast.walk(_without_indices(check(self.text)))
        return frozenset(node.id for node in bare if isinstance(node, ast.Name))

    @property
    def jumps(self) -> bool:
        """Whether it is dry friction, sign(v[n]), which jumps where a site turns round."""
        return self.text.replace(" ", "") == "sign(v[n])"

    @property
    def expression(self) -> sympy.Expr:
        """The SymPy expression over the complex symbols u_{n+1}, v_{n}, ... and the real ones t and n."""
        return symbolic(self.text)

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
        """+1 or -1 for a term that is even or odd under (u, v, f) -> -(u, v, f), None for neither."""
        import sympy

        flipped = self.expression.subs({s: -s for s in self.expression.free_symbols if s.name[0] in FIELDS})
        if sympy.simplify(flipped - self.expression) == 0:
            return 1
        return -1 if sympy.simplify(flipped + self.expression) == 0 else None

    @property
    def turns_with_phase(self) -> bool:
        """Whether u -> exp(i a) u (v and f alike) multiplies the term by exp(i a), for every real a."""
        import sympy

        turn = sympy.exp(sympy.I * sympy.Symbol("a", real=True))
        fields = [s for s in self.expression.free_symbols if s.name[0] in FIELDS]
        turned = self.expression.subs({s: s * turn for s in fields}, simultaneous=True)
        difference = sympy.expand(turned / turn - self.expression).replace(sympy.Abs, _abs_of_product)
        return bool(sympy.simplify(difference) == 0)


def _abs_of_product(argument: sympy.Expr) -> sympy.Expr:
    import sympy

    return sympy.Mul(*(sympy.Abs(factor) for factor in sympy.Mul.make_args(argument)))


def _without_indices(tree: ast.expr) -> ast.expr:
    """Copy a checked tree with u[n+1] as u, so that the n of an index is not taken for the site number."""

    class Bare(ast.NodeTransformer):
        def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
            return node.value

    return Bare().visit(ast.parse(ast.unparse(tree), mode="eval").body)  # type: ignore[no-any-return]


def split(text: str) -> tuple[Term, ...]:
    """Read terms written one after the other with `;` between them.

    Raises:
        TermError: one of them is no term.
    """
    return tuple(Term(part.strip()) for part in text.split(";") if part.strip())


def substitute(text: str, values: dict[str, float]) -> str:
    """Put numbers in the place of names and give the text of the result.

    Raises:
        TermError: `text` has a name that is neither in the language nor in `values`.
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

    return ast.unparse(Put().visit(check(text, tuple(values))))


@functools.cache
def symbolic(text: str, names: tuple[str, ...] = ()) -> sympy.Expr:
    """Turn a term into SymPy; numbers become exact rationals, `names` real symbols."""
    import sympy

    functions = {
        "abs": sympy.Abs, "conj": sympy.conjugate, "re": sympy.re, "im": sympy.im,
        **{name: getattr(sympy, name) for name in FUNCTIONS if name not in ("abs", "conj", "re", "im")},
    }  # fmt: skip

    def build(node: ast.expr) -> sympy.Expr:
        match node:
            case ast.Constant(value=value):
                return sympy.Rational(str(value))
            case ast.Name(id="i"):
                return sympy.I
            case ast.Name(id="pi"):
                return sympy.pi
            case ast.Name(id=name):
                return sympy.Symbol(name, real=True)
            case ast.Subscript(value=ast.Name(id=name), slice=index):
                return site_symbol(name, _offset(index) or 0)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -build(operand)
            case ast.UnaryOp(operand=operand):
                return build(operand)
            case ast.Call(func=ast.Name(id=name), args=[argument]):
                return functions[name](build(argument))
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                return build(left) + build(right)
            case ast.BinOp(left=left, op=ast.Sub(), right=right):
                return build(left) - build(right)
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                return build(left) * build(right)
            case ast.BinOp(left=left, op=ast.Div(), right=right):
                return build(left) / build(right)
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return build(left) ** build(right)
        raise AssertionError(ast.dump(node))

    tree = check(text, names)
    expression = build(tree)
    if expression.has(sympy.zoo, sympy.nan, sympy.oo):
        raise TermError(text, 0, "it divides by zero")
    return expression


def site_symbol(name: str, offset: int) -> sympy.Symbol:
    """Name the field `name` at site n + offset: the complex symbol u_{n+1}."""
    import sympy

    return sympy.Symbol(f"{name}_{{n{offset:+d}}}" if offset else f"{name}_{{n}}", complex=True)


@dataclass(frozen=True, order=True)
class Slot:
    """One real array that a compiled function takes: a part of a field at an offset, or the time or site number."""

    name: str
    offset: int = 0
    part: Literal["re", "im"] = "re"


@dataclass(frozen=True)
class Compiled:
    """Real functions of real arrays, made from SymPy expressions with common subexpressions shared.

    `function(*arrays)` takes one array a slot, in the order of `slots`, all of one shape (or broadcastable), and
    gives one array an expression; an expression without slots gives a number.
    """

    slots: tuple[Slot, ...]
    function: Callable[..., Sequence[Any]]


def real_parts(
    text: str, is_complex: bool, *, for_derivatives: bool = False
) -> tuple[dict[Slot, sympy.Symbol], tuple[sympy.Expr, ...]]:
    """Write a term in real variables.

    A real field gives one expression, a complex one two (real and imaginary part), in the variables u = p + i q.
    A measured input f is real in both. With `for_derivatives` the sign of a complex z is written z/|z|, which SymPy can
    derive; it has no value at z = 0.

    Raises:
        TermError: the term is not real on a real field.
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
    """Compile terms into one function that gives their real parts, then (for a complex field) their imaginary parts."""
    written = [real_parts(text, is_complex) for text in texts]
    slots = {slot: symbol for found, _ in written for slot, symbol in found.items()}
    expressions = [parts[k] for k in range(1 + is_complex) for _, parts in written]
    return _lambdify(slots, expressions, backend)


@functools.lru_cache(maxsize=512)
def partials(
    texts: tuple[str, ...], is_complex: bool, backend: Backend = "numpy"
) -> tuple[Compiled, tuple[tuple[int, int, Slot], ...]]:
    """Compile the derivatives of terms with respect to the field's and the velocity's real variables.

    Returns:
        the compiled function, and for each of its outputs (term, part, slot): which term, its real (0) or imaginary (1)
        part, and the variable it is derived by. Derivatives that vanish identically are left out.
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

    order = sorted(slots)
    symbols = [slots[slot] for slot in order]
    dirac = [expression.replace(sympy.DiracDelta, lambda *_: sympy.Integer(0)) for expression in expressions]
    if backend == "numpy":
        return Compiled(tuple(order), sympy.lambdify(symbols, dirac, modules="numpy", cse=True))
    # NumPy's code with torch's functions under NumPy's names.
    settings = {"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True}
    function = sympy.lambdify(symbols, dirac, modules=[_torch_names()], printer=NumPyPrinter(settings), cse=True)
    return Compiled(tuple(order), function)


def _torch_names() -> dict[str, Any]:
    """Give torch's functions the names that SymPy's NumPy code calls; they take plain numbers too."""
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


def combination(terms: Sequence[Term], coefficients: Sequence[float]) -> Term:
    """Write the sum of coefficients times terms as one term, every digit kept."""
    parts = [f"{value:.17g}*({term.text})" for term, value in zip(terms, coefficients, strict=True) if value != 0]
    return Term(" + ".join(parts) or "0")


def express(target: Term, terms: Sequence[Term], is_complex: bool) -> Float[ndarray, " terms"] | None:
    """Write `target` as a real linear combination of `terms`, by linear algebra over their monomials.

    Returns:
        the coefficients (dimension of target over that of each term), or None where the target is outside the span.

    Raises:
        InputError: the terms depend linearly on each other, so that no coefficient is defined.
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
    # The numbers of an equation are short; the linear algebra leaves round-off in the last digits.
    return np.array([float(f"{value:.13g}") for value in coefficients])


@functools.lru_cache(maxsize=4096)
def _monomials(text: str, is_complex: bool) -> dict[sympy.Expr, sympy.Expr]:
    """Expand a term into {monomial: number}; |u|^2 becomes u conj(u), on a real field u^2."""
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
