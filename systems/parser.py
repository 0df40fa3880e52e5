"""The term language: its grammar and limits, and the parser that refuses everything outside it.

A term is a function of the stencil around site n, such as `u[n+1]+u[n-1]-2*u[n]`, `abs(u[n])**2*u[n]`,
`sin(2*u[n])`, `sign(v[n])`, `cos(1.7*t)`, `n*u[n]`, `f[n]` or `i*u[n]`:

    u[n+k], v[n+k], f[n+k]   field, its velocity, measured input; k sites to the right
    n                        site number counted from the middle of the chain: 1..N minus (N+1)/2
    t, i, pi                 time, imaginary unit, 3.14159...
    + - * / **               arithmetic; the power must be a number
    sin cos tan atan sinh cosh tanh exp log sqrt abs sign conj re im

A text becomes a Python syntax tree that is checked node by node against a whitelist; nothing is ever evaluated.
"""

from __future__ import annotations

import ast
import math
import re
import unicodedata
import warnings

from latticebench.systems.errors import InputError

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
# A smaller one is lost in any computation.
MIN_NUMBER = 1e-100


class TermError(InputError):
    """Raised for a text outside the term language; the message quotes the text and points at the place.

    Attributes:
        column: zero-based position of the problem in the text.
    """

    def __init__(self, text: str, column: int, problem: str) -> None:
        """Describe the `problem` of `text` at the zero-based `column`."""
        shown = text if len(text) <= 80 else text[:77] + "..."
        super().__init__(f"term {shown!r}, column {column + 1}: {problem}")
        self.column = column


def parse(text: str, names: tuple[str, ...] = ()) -> ast.expr:
    """Return the syntax tree of a term, which holds nothing but the term language.

    Args:
        text: the term.
        names: further names that stand for numbers (parameters of a system, the position x).

    Raises:
        TermError: the text is outside the language, or absurdly large.
    """
    if len(text) > MAX_LENGTH:
        raise TermError(text, MAX_LENGTH, f"longer than {MAX_LENGTH} characters; split it into several terms")
    for column, character in enumerate(text.rstrip()):
        if character == "#" or (character in "\r\n" and text[:column].strip()):
            raise TermError(text, column, "a term is one line without a comment")
        # Python reads them as the plain ones; a person who reads the text would not know.
        plain = unicodedata.normalize("NFKC", character)
        if plain != character and f"a{character}".isidentifier():
            raise TermError(text, column, f"write {plain!r} for {character!r}")
    # Python takes a leading blank for an indentation; errors count columns in the text as given.
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
    """Return the number of levels of a tree, at most MAX_DEPTH + 1, without recursion."""
    level: list[ast.AST] = [tree]
    depth = 0
    while level and depth <= MAX_DEPTH:
        level = [child for node in level for child in ast.iter_child_nodes(node)]
        depth += 1
    return depth


class _Whitelist(ast.NodeVisitor):
    """Visitor that raises a TermError at any node outside the term language."""

    def __init__(self, text: str, names: tuple[str, ...], lead: int) -> None:
        self.text, self.names, self.lead = text, names, lead
        self.nested = 0

    def refuse(self, node: ast.AST, problem: str) -> TermError:
        return TermError(self.text, getattr(node, "col_offset", 0) + self.lead, problem)

    def generic_visit(self, node: ast.AST) -> None:
        raise self.refuse(node, f"{type(node).__name__} is not part of the term language")

    def visit_Tuple(self, node: ast.Tuple) -> None:
        raise self.refuse(node, "several terms have ; between them, no comma")

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)):
            hint = "; write i*u[n] for the imaginary unit" if isinstance(node.value, complex) else ""
            raise self.refuse(node, f"{node.value!r} is not a real number{hint}")
        if not abs(node.value) <= MAX_NUMBER:
            raise self.refuse(node, f"a number must not exceed {MAX_NUMBER:g} in size")
        written = ast.get_source_segment(self.text.strip(), node) or ""
        # Python reads 1e-400 as 0.
        is_zero = re.fullmatch(r"0[box][0_]+|[0._]+(e.*)?", written.lower())
        if not is_zero and abs(node.value) < MIN_NUMBER:
            raise self.refuse(node, f"a number other than 0 must not be below {MIN_NUMBER:g} in size")

    def visit_Name(self, node: ast.Name) -> None:
        if node.id in CONSTANTS or node.id in self.names:
            return
        if node.id in FIELDS:
            raise self.refuse(node, f"{node.id} needs a site: {node.id}[n]")
        if node.id in FUNCTIONS:
            raise self.refuse(node, f"{node.id} is a function: {node.id}(...)")
        known = ", ".join((*(f"{name}[n]" for name in FIELDS), *CONSTANTS, *self.names))
        raise self.refuse(node, f"unknown name {node.id!r}; known: {known}")

    def visit_Subscript(self, node: ast.Subscript) -> None:
        if not isinstance(node.value, ast.Name) or node.value.id not in FIELDS:
            raise self.refuse(node, f"only {', '.join(FIELDS)} have sites")
        if isinstance(node.slice, ast.Tuple):
            raise self.refuse(node.slice, "lattices of two and more dimensions are not supported; use one index")
        offset = site_offset(node.slice)
        if offset is None:
            raise self.refuse(node.slice, f"a site is n, n+K or n-K with a whole number K: {node.value.id}[n+1]")
        if abs(offset) > MAX_OFFSET:
            raise self.refuse(node.slice, f"a site is at most {MAX_OFFSET} away: {node.value.id}[n+{MAX_OFFSET}]")

    def visit_Call(self, node: ast.Call) -> None:
        if not isinstance(node.func, ast.Name) or node.func.id not in FUNCTIONS:
            called = node.func.id if isinstance(node.func, ast.Name) else "this"
            raise self.refuse(node, f"{called} cannot be called; functions: {', '.join(FUNCTIONS)}")
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
                raise self.refuse(node.right, f"a power must not exceed {MAX_POWER} in size")
        else:
            self.visit(node.right)
        if isinstance(node.op, (ast.Mult, ast.Pow)) and _monomial_count(node) > MAX_MONOMIALS:
            raise self.refuse(node, f"multiplied out it has more than {MAX_MONOMIALS} parts")
        if _degree(node) > MAX_DEGREE:
            raise self.refuse(node, f"the total power is above {MAX_DEGREE}")
        value = _number(node)
        if value is not None and not abs(value) <= MAX_NUMBER:
            raise self.refuse(node, f"a number must not exceed {MAX_NUMBER:g} in size")


def site_offset(node: ast.expr) -> int | None:
    """Return K of an index n, n+K or n-K, and None for any other index."""
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
    """Return the value of a tree of numbers: None if it holds anything else, inf if it is not a finite real number."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
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
    """Return an upper bound of the polynomial degree; a function has the degree of its argument."""
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
    """Return an upper bound of the number of monomials after multiplying out; a function counts as one."""
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
