"""Lattices: libraries of terms, and systems with their equation, ends, initial states and source.

Positions are x_n; site k = 0..N-1 of an array is the paper's n = k + 1. Everything is dimensionless unless a system
says otherwise.
"""

from __future__ import annotations

import ast
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from latticebench.systems.errors import InputError, unknown
from latticebench.systems.parser import FUNCTIONS, TermError, parse
from latticebench.systems.stencil import Ends, numbers, reach_of
from latticebench.systems.terms import Term, express, substitute, symbolic

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

Integrator = Literal["rk4", "bdf", "dop853"]


@dataclass(frozen=True)
class Library:
    """An ordered set of candidate terms.

    Attributes:
        name: what it is called.
        terms: the candidates, in order.
        source: where it comes from.

    Raises:
        InputError: it is empty or has a term twice.
    """

    name: str
    terms: tuple[Term, ...]
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse an empty library and repeated terms."""
        if not self.terms:
            raise InputError(f"library {self.name!r} has no terms; give at least one, such as u[n]")
        seen: dict[str, str] = {}
        for term in self.terms:
            if term.plain in seen:
                also = f", also written {seen[term.plain]!r}," * (seen[term.plain] != term.text)
                raise InputError(f"library {self.name!r} has the term {term.text!r}{also} twice; leave one out")
            seen[term.plain] = term.text

    @property
    def texts(self) -> tuple[str, ...]:
        """The texts of the terms, as they were given."""
        return tuple(term.text for term in self.terms)

    @property
    def reach(self) -> tuple[int, int]:
        """The number of sites that the widest terms read to the left and to the right."""
        return reach_of(self.terms)

    def uses(self, name: str) -> bool:
        """Return whether any term contains `name`: u, v, f, t, n, i or a function."""
        return any(name in term.names for term in self.terms)


def library(name: str, terms: str | Sequence[str], source: str = "", *, with_imaginary: bool = False) -> Library:
    """Return a library made from texts.

    Args:
        name: what it is called.
        terms: a list of terms, or one text in which they are separated by `;`.
        source: where it comes from.
        with_imaginary: add i*T after every term T, so that each complex coefficient is two real ones.

    Raises:
        InputError: a text is not in the term language, or the library is empty or has a term twice.
    """
    texts = [text.strip() for text in (terms.split(";") if isinstance(terms, str) else terms)]
    texts = [text for text in texts if text]
    if with_imaginary:
        texts = [part for text in texts for part in (text, f"i*{text}" if _is_product(text) else f"i*({text})")]
    return Library(name, tuple(Term(text) for text in texts), source)


def _is_product(text: str) -> bool:
    """Return whether a factor can be written in front of a text without brackets."""
    tree = parse(text)
    return not (isinstance(tree, ast.BinOp) and isinstance(tree.op, (ast.Add, ast.Sub, ast.Div)))


@dataclass(frozen=True)
class Initial:
    """An initial state, as texts in the position x, the site number n and the parameters of the system.

    Attributes:
        u: the field.
        v: its velocity, which only a second-order system has.
    """

    u: str
    v: str = "0"


@dataclass(frozen=True)
class System:
    """An equation of motion with its ends, initial states, libraries and source.

    The equation is d^order u_n / dt^order = `equation`. The N positions x_n are evenly spaced on [-L, L], both ends
    included, with L = `half_length`.

    Attributes:
        name: what it is called in suites, on the command line and in tables.
        title: its full name.
        equation: the right-hand side in the term language, in which the names of `parameters` stand for numbers.
        order: of the time derivative.
        is_complex: whether the field is complex.
        parameters: names with their default values.
        initials: initial states by name; the first is the default.
        libraries: candidate terms to find the equation with.
        source: where the equation comes from.
        half_length: L, a text in N and the parameters.
        sites: the default N.
        ends: how the chain ends.
        integrator: how it is simulated unless asked otherwise.
        notes: what else a user should know.
        conserved: a density in the term language whose sum over all sites does not change in time, for all ends; none
            if empty.

    Raises:
        InputError: a text is outside the language, or a field is invalid.
    """

    name: str
    title: str
    equation: str
    order: Literal[1, 2]
    is_complex: bool
    parameters: Mapping[str, float]
    initials: Mapping[str, Initial]
    libraries: tuple[Library, ...]
    source: str
    half_length: str = "N/2"
    sites: int = 31
    ends: Ends = "free"
    integrator: Integrator = "dop853"
    notes: str = ""
    conserved: str = ""

    def __post_init__(self) -> None:
        """Check every text and name; nothing is computed yet."""
        names = tuple(self.parameters)
        where = f"system {self.name!r}"
        for key in ("name", "title", "equation", "half_length", "source", "notes", "conserved"):
            if not isinstance(getattr(self, key), str):
                raise InputError(f"{where}: {key} is {getattr(self, key)!r}; it must be a text")
        if isinstance(self.order, bool) or self.order not in (1, 2):
            raise InputError(f"{where}: order is {self.order!r}; it must be 1 or 2")
        if isinstance(self.sites, bool) or not isinstance(self.sites, int) or self.sites < 1:
            raise InputError(f"{where}: sites is {self.sites!r}; it must be a whole number of at least 1")
        if self.ends not in get_args(Ends) or self.ends == "unknown":
            raise unknown("ends", str(self.ends), [e for e in get_args(Ends) if e != "unknown"], where)
        if self.integrator not in get_args(Integrator):
            raise unknown("integrator", str(self.integrator), get_args(Integrator), where)
        if not self.initials:
            raise InputError(f"{where}: it needs an initial state, such as u = 'exp(-x**2)'")
        taken = {"u", "f", "t", "n", "i", "pi", "x", "N", *FUNCTIONS} & set(names)
        if taken:
            raise InputError(f"{where}: a parameter cannot be called {sorted(taken)[0]!r}; that name has a meaning")
        self.with_parameters(self.parameters)
        self._check("equation", self.equation, names)
        self._check("conserved", self.conserved or "0", names)
        self._check("half_length", self.half_length, (*names, "N"), without=("t", "n"))
        for kind, initial in self.initials.items():
            self._check(f"initials.{kind}.u", initial.u, (*names, "x"), without=("t",))
            self._check(f"initials.{kind}.v", initial.v, (*names, "x"), without=("t",))
        listed = [one.name for one in self.libraries]
        for one in listed:
            if listed.count(one) > 1:
                raise InputError(f"{where}: it has two libraries called {one!r}")

    def _check(self, key: str, text: str, names: tuple[str, ...], without: tuple[str, ...] | None = None) -> None:
        """Check one text; `without` is given for a text without fields, and lists further names without a value."""
        where = f"system {self.name!r}: {key}"
        if not isinstance(text, str):
            raise InputError(f"{where} is {text!r}; it must be a text")
        try:
            tree = parse(text, names)
        except TermError as error:
            raise InputError(f"{where}: {error}") from None
        for node in ast.walk(tree) if without is not None else ():
            if isinstance(node, ast.Subscript) or (isinstance(node, ast.Name) and node.id in (without or ())):
                raise InputError(f"{where}: {text!r} holds {ast.unparse(node)}, which has no value there")

    def with_parameters(self, given: Mapping[str, float]) -> dict[str, float]:
        """Return the default parameters, updated with the given values.

        Raises:
            InputError: the system has no parameter of a name, or a value is not a finite number.
        """
        for name, value in given.items():
            if name not in self.parameters:
                raise unknown("parameter", name, self.parameters, f"system {self.name!r}")
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise InputError(f"system {self.name!r}: parameter {name} is {value!r}; it must be a finite number")
        return {**self.parameters, **{name: float(value) for name, value in given.items()}}

    def library(self, name: str) -> Library:
        """Return the library of this name.

        Raises:
            InputError: there is none of this name.
        """
        for one in self.libraries:
            if one.name == name:
                return one
        raise unknown("library", name, [one.name for one in self.libraries], f"system {self.name!r}")

    def motion(self, parameters: Mapping[str, float]) -> Term:
        """Return the right-hand side with numbers in place of the parameters."""
        return Term(substitute(self.equation, self.with_parameters(parameters)))

    def truth(self, candidates: Library, parameters: Mapping[str, float]) -> Float[ndarray, " terms"] | None:
        """Return the true coefficients over a library, or None if the equation is outside its span."""
        return express(self.motion(parameters), candidates.terms, self.is_complex)

    def initial_state(
        self,
        parameters: Mapping[str, float],
        sites: int,
        kind: str | None = None,
        variation: np.random.Generator | None = None,
    ) -> tuple[ndarray, ndarray | None]:
        """Return an initial state.

        Args:
            parameters: values that differ from the defaults.
            sites: N.
            kind: the name of one of `initials`; the first if None.
            variation: draws a state close to the written one: the profile is moved by up to two sites, and three slow
                waves of a tenth of the size of the field are added to it and to its velocity; none is drawn if None.

        Returns:
            u (N,), and v (N,) or None for a first-order system; complex for a complex system.

        Raises:
            InputError: there is no such initial state, or it is not finite or not real for these parameters.
        """
        kind = kind if kind is not None else next(iter(self.initials))
        if kind not in self.initials:
            raise unknown("initial state", kind, self.initials, f"system {self.name!r}")
        values = self.with_parameters(parameters)
        n = numbers(sites)
        # A length that is infinite, negative or not real becomes nan, which is reported below.
        with np.errstate(all="ignore"):
            length = _positive(_numeric(self.half_length, {**values, "N": float(sites)}))
            x = 2 * length * n / max(sites - 1, 1)
            shift = variation.uniform(-2, 2) * 2 * length / max(sites - 1, 1) if variation is not None else 0.0
            arguments = {**values, "x": x - shift, "n": n}
            u = np.broadcast_to(_numeric(self.initials[kind].u, arguments), (sites,)).astype(complex)
            v = np.broadcast_to(_numeric(self.initials[kind].v, arguments), (sites,)).astype(complex)
        if variation is not None:
            size = np.sqrt(np.mean(np.abs(u) ** 2))
            u = u + size * _slow_waves(n, sites, self.is_complex, variation)
            v = v + size * _slow_waves(n, sites, self.is_complex, variation)
        if not (np.all(np.isfinite(u)) and np.all(np.isfinite(v))):
            listed = ", ".join(f"{name}={value:g}" for name, value in values.items())
            raise InputError(
                f"system {self.name!r}: the initial state {kind!r} is not finite for {listed}; "
                "check the parameters (a kink's speed v must be below 1, a coupling C above 0)"
            )
        if not self.is_complex:
            if np.any(np.abs(u.imag) > 0) or np.any(np.abs(v.imag) > 0):
                listed = ", ".join(f"{name}={value:g}" for name, value in values.items())
                raise InputError(
                    f"system {self.name!r}: the initial state {kind!r} is complex for {listed}, but the field is real; "
                    "check the parameters (a kink's speed v must be below 1)"
                )
            u, v = u.real, v.real
        return u, (v if self.order == 2 else None)


def _numeric(text: str, values: Mapping[str, Any]) -> Any:
    """Return the value of a checked text for numbers or arrays in place of its names."""
    function = _compiled(text, tuple(values))
    # Far out a complex 1/cosh(x)**2 is nan and the real one 0; roots of negative numbers are complex only.
    found, wide = (function(*(np.asarray(value, dtype=kind) for value in values.values())) for kind in (float, complex))
    return wide if not np.all(np.isfinite(found)) and np.all(np.isfinite(wide)) else found


@functools.cache
def _compiled(text: str, names: tuple[str, ...]) -> Callable[..., Any]:
    """Return a checked text as a NumPy function of its names."""
    import sympy

    expression = symbolic(text, tuple(sorted(name for name in names if name != "n")))
    symbols = [sympy.Symbol(name, real=True) for name in names]
    function: Callable[..., Any] = sympy.lambdify(symbols, expression, modules="numpy")
    return function


def _positive(value: Any) -> float:
    """Return a computed length as a number, nan if it is not positive and finite."""
    number = complex(value)
    return number.real if number.imag == 0 and 0 < number.real < math.inf else math.nan


def _slow_waves(n: ndarray, sites: int, is_complex: bool, draw: np.random.Generator) -> ndarray:
    """Return the sum of three waves along the chain, each of an amplitude of about 0.1 and a random phase."""
    waves = np.zeros(sites, dtype=complex)
    for wave_number in (1, 2, 3):
        amplitude = 0.1 * draw.normal() + (0.1j * draw.normal() if is_complex else 0)
        waves += amplitude * np.cos(np.pi * wave_number * n / sites + draw.uniform(0, 2 * np.pi))
    return waves
