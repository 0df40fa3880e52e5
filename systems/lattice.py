"""Lattices: libraries of terms, systems, their ends, and the right-hand side that follows from an equation.

Index convention: arrays are (times, sites); site k = 0..N-1 of an array is the paper's n = k + 1.
Everything is dimensionless unless a system says otherwise.
"""

from __future__ import annotations

import ast
import functools
import importlib.util
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from latticebench.systems.errors import InputError, unknown
from latticebench.systems.terms import (
    FUNCTIONS,
    Slot,
    Term,
    TermError,
    check,
    compiled,
    express,
    partials,
    real_parts,
    substitute,
    symbolic,
)

if TYPE_CHECKING:
    import scipy.sparse
    from jaxtyping import Float, Int
    from numpy import ndarray

Ends = Literal["unknown", "free", "fixed", "periodic", "antiperiodic"]
Integrator = Literal["rk4", "bdf", "dop853"]


@dataclass(frozen=True)
class Library:
    """An ordered set of candidate terms.

    Raises:
        InputError: it is empty or names a term twice.
    """

    name: str
    terms: tuple[Term, ...]
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse an empty library and repeated terms."""
        if not self.terms:
            raise InputError(f"library {self.name!r} has no terms; give at least one, such as u[n]")
        texts = self.texts
        for text in texts:
            if texts.count(text) > 1:
                raise InputError(f"library {self.name!r} has the term {text!r} twice; leave one out")

    @property
    def texts(self) -> tuple[str, ...]:
        """The terms as they were given."""
        return tuple(term.text for term in self.terms)

    @property
    def reach(self) -> tuple[int, int]:
        """How many sites the widest terms see to the left and to the right."""
        return max(term.reach[0] for term in self.terms), max(term.reach[1] for term in self.terms)

    def uses(self, name: str) -> bool:
        """Whether any term holds `name`: u, v, f, t, n, i or a function."""
        return any(name in term.names for term in self.terms)


def library(name: str, terms: str | Sequence[str], source: str = "", *, with_imaginary: bool = False) -> Library:
    """Make a library from texts.

    Args:
        name: what it is called.
        terms: a list of terms, or one text with `;` between them.
        source: where it comes from.
        with_imaginary: give every term T a companion i*T, so that each complex coefficient is two real ones.
    """
    texts = [text.strip() for text in (terms.split(";") if isinstance(terms, str) else terms)]
    texts = [text for text in texts if text]
    if with_imaginary:
        texts = [part for text in texts for part in (text, f"i*{text}" if _is_product(text) else f"i*({text})")]
    return Library(name, tuple(Term(text) for text in texts), source)


def _is_product(text: str) -> bool:
    tree = check(text)
    return not (isinstance(tree, ast.BinOp) and isinstance(tree.op, (ast.Add, ast.Sub, ast.Div)))


@dataclass(frozen=True)
class Initial:
    """An initial state as texts in the position x, the site number n and the system's parameters.

    `v` is the initial velocity of a second-order system.
    """

    u: str
    v: str = "0"


@dataclass(frozen=True)
class System:
    """An equation of motion with its ends, initial states, libraries and source.

    The equation is d^order u_n / dt^order = `equation`, a text of the term language in which the names of `parameters`
    stand for numbers. Positions are x_n, N points taken uniformly from [-L, L] with L = `half_length`, a text in N and the
    parameters.

    Raises:
        InputError: any text is outside the language, or a field is unsound.
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

    def __post_init__(self) -> None:
        """Check every text and name; nothing is computed yet."""
        names = tuple(self.parameters)
        where = f"system {self.name!r}"
        for key in ("name", "title", "equation", "half_length", "source", "notes"):
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
        self._check("half_length", self.half_length, (*names, "N"), without=("t", "n"))
        for kind, initial in self.initials.items():
            self._check(f"initials.{kind}.u", initial.u, (*names, "x"), without=("t",))
            self._check(f"initials.{kind}.v", initial.v, (*names, "x"), without=("t",))
        listed = [one.name for one in self.libraries]
        for one in listed:
            if listed.count(one) > 1:
                raise InputError(f"{where}: it has two libraries called {one!r}")

    def _check(self, key: str, text: str, names: tuple[str, ...], without: tuple[str, ...] | None = None) -> None:
        """Check one text; with `without`, it is computed before there is a field, and these names have no value."""
        where = f"system {self.name!r}: {key}"
        if not isinstance(text, str):
            raise InputError(f"{where} is {text!r}; it must be a text")
        try:
            tree = check(text, names)
        except TermError as error:
            raise InputError(f"{where}: {error}") from None
        for node in ast.walk(tree) if without is not None else ():
            if isinstance(node, ast.Subscript) or (isinstance(node, ast.Name) and node.id in (without or ())):
                raise InputError(f"{where}: {text!r} holds {ast.unparse(node)}, which has no value there")

    def with_parameters(self, given: Mapping[str, float]) -> dict[str, float]:
        """Fill the defaults up with the given values.

        Raises:
            InputError: a name that the system does not have, or a value that is not finite.
        """
        for name, value in given.items():
            if name not in self.parameters:
                raise unknown("parameter", name, self.parameters, f"system {self.name!r}")
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise InputError(f"system {self.name!r}: parameter {name} is {value!r}; it must be a finite number")
        return {**self.parameters, **{name: float(value) for name, value in given.items()}}

    def library(self, name: str) -> Library:
        """Look one of the system's libraries up.

        Raises:
            InputError: there is none of that name.
        """
        for one in self.libraries:
            if one.name == name:
                return one
        raise unknown("library", name, [one.name for one in self.libraries], f"system {self.name!r}")

    def motion(self, parameters: Mapping[str, float]) -> Term:
        """Give the right-hand side with numbers in the place of the parameters."""
        return Term(substitute(self.equation, self.with_parameters(parameters)))

    def truth(self, candidates: Library, parameters: Mapping[str, float]) -> Float[ndarray, " terms"] | None:
        """Derive the true coefficients over a library; None where the equation is outside its span."""
        return express(self.motion(parameters), candidates.terms, self.is_complex)

    def initial_state(
        self,
        parameters: Mapping[str, float],
        sites: int,
        kind: str | None = None,
        variation: np.random.Generator | None = None,
    ) -> tuple[ndarray, ndarray | None]:
        """Compute an initial state.

        Args:
            parameters: values that differ from the defaults.
            sites: N.
            kind: the name of one of `initials`; the first when None.
            variation: draws another state near by: the profile moved by up to two sites and three slow waves of a tenth
                of the field's size added to it (and to its velocity); None for the state as it is written.

        Returns:
            u (N,) and v (N,) or None for a first-order system; complex for a complex system.

        Raises:
            InputError: there is no such initial state, or it is not finite for these parameters.
        """
        kind = kind if kind is not None else next(iter(self.initials))
        if kind not in self.initials:
            raise unknown("initial state", kind, self.initials, f"system {self.name!r}")
        values = self.with_parameters(parameters)
        n = np.arange(sites) - (sites - 1) / 2
        # A length that is endless, negative or not real comes out as nan and is told below.
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
    """Evaluate a checked text with numbers or arrays for its names."""
    import sympy

    names = tuple(sorted(name for name in values if name != "n"))
    expression = symbolic(text, names)
    symbols = [sympy.Symbol(name, real=True) for name in values]
    function = sympy.lambdify(symbols, expression, modules="numpy")
    # Real arithmetic first: far out a complex 1/cosh(x)**2 is nan, the real one 0. Complex is for roots of negative numbers.
    found, wide = (function(*(np.asarray(value, dtype=kind) for value in values.values())) for kind in (float, complex))
    return wide if not np.all(np.isfinite(found)) and np.all(np.isfinite(wide)) else found


def _positive(value: Any) -> float:
    """Take a computed length as a number; nan when it is not a positive one."""
    number = complex(value)
    return number.real if number.imag == 0 and 0 < number.real < math.inf else math.nan


def _slow_waves(n: ndarray, sites: int, is_complex: bool, draw: np.random.Generator) -> ndarray:
    """Three waves along the chain, each a tenth of one in size, with random phases."""
    waves = np.zeros(sites, dtype=complex)
    for wave_number in (1, 2, 3):
        amplitude = 0.1 * draw.normal() + (0.1j * draw.normal() if is_complex else 0)
        waves += amplitude * np.cos(np.pi * wave_number * n / sites + draw.uniform(0, 2 * np.pi))
    return waves


# Ends ---------------------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=256)
def ghosts(sites: int, left: int, right: int, ends: Ends) -> tuple[Int[ndarray, " padded"], Float[ndarray, " padded"]]:
    """Say what the sites beyond the ends repeat: padded[j] = factor[j] * u[index[j]].

    free: mirrored about the last bond, u_0 = u_1 and u_{-1} = u_2 (paper, section 2.1); fixed: walls, zero outside;
    periodic: u_{n+N} = u_n; antiperiodic: u_{n+N} = -u_n; unknown: no ghosts, so that only sites whose whole stencil was
    observed count.

    Raises:
        InputError: the chain is shorter than the stencil.
    """
    if ends == "unknown":
        if sites <= left + right:
            raise InputError(
                f"the library's stencil needs {left + right + 1} sites, the data have {sites}; "
                "use terms with fewer neighbours, or say how the chain ends (free, fixed, periodic, antiperiodic)"
            )
        return np.arange(sites), np.ones(sites)
    if sites < max(left, right) and ends != "fixed":
        raise InputError(f"the library's stencil reaches {max(left, right)} sites, the chain has {sites}")
    place = np.arange(-left, sites + right)
    inside = (place >= 0) & (place < sites)
    if ends == "free":
        index = np.where(place < 0, -1 - place, np.where(place >= sites, 2 * sites - 1 - place, place))
        return index, np.ones(len(place))
    if ends == "fixed":
        return np.clip(place, 0, sites - 1), inside.astype(float)
    sign = np.where(inside, 1.0, -1.0) if ends == "antiperiodic" else np.ones(len(place))
    return place % sites, sign


def observed(sites: int, reach: tuple[int, int], ends: Ends) -> slice:
    """Give the sites at which a library of this reach can be evaluated."""
    return slice(reach[0], sites - reach[1]) if ends == "unknown" else slice(0, sites)


def evaluate(
    terms: Sequence[Term],
    u: ndarray,
    v: ndarray | None,
    f: ndarray | None,
    t: Float[ndarray, " time"],
    *,
    ends: Ends,
    reach: tuple[int, int] | None = None,
) -> Float[ndarray, "parts terms time sites"]:
    """Evaluate terms along a trajectory.

    Args:
        terms: what to evaluate.
        u: the field, (time, N), real or complex.
        v: its velocity, or None.
        f: the measured input, (time, N), or None.
        t: times.
        ends: how the chain ends; with "unknown" only sites whose whole stencil lies inside are evaluated.
        reach: the stencil that decides which those are; that of `terms` when None.

    Returns:
        the terms' real parts, and for a complex field their imaginary parts. NaN where the data are NaN.

    Raises:
        InputError: a term needs v or f and there is none, or the chain is too short.
    """
    needed = {name for term in terms for name in term.names}
    for name, array, what in (("v", v, "velocities v1..vN"), ("f", f, "measured inputs f1..fN")):
        if name in needed and array is None:
            raise InputError(f"the library uses {name}[n], but the data have no {what}")
    if reach is None:
        reach = max(term.reach[0] for term in terms), max(term.reach[1] for term in terms)
    is_complex = np.iscomplexobj(u)
    sites = u.shape[1]
    index, factor = ghosts(sites, *reach, ends)
    start = reach[0]
    count = len(index) - sum(reach)
    fields: dict[tuple[str, str], ndarray] = {}
    for name, array in (("u", u), ("v", v), ("f", f)):
        if array is not None:
            # A wall holds zero even where the value that stands in for it is missing.
            padded = np.where(factor == 0, 0.0, array[:, index] * factor)
            fields[name, "re"], fields[name, "im"] = padded.real, padded.imag
    n = (np.arange(sites) - (sites - 1) / 2)[observed(sites, reach, ends)]
    bundle = compiled(tuple(term.text for term in terms), is_complex)
    arrays: list[Any] = []
    for slot in bundle.slots:
        if slot.name == "t":
            arrays.append(np.broadcast_to(t[:, None], (len(t), count)))
        elif slot.name == "n":
            arrays.append(np.broadcast_to(n, (len(t), count)))
        else:
            arrays.append(fields[slot.name, slot.part][:, start + slot.offset : start + slot.offset + count])
    # Where a term is not finite (log of 0, an overflow) its value says so; no warning is needed beside it.
    with np.errstate(all="ignore"):
        values = bundle.function(*arrays)
    shape = (len(t), count)
    stacked = np.stack([np.broadcast_to(value, shape) for value in values])
    return stacked.reshape(1 + is_complex, len(terms), *shape).astype(float)


# The right-hand side on a chain -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """An equation on a chain of N sites, as a first-order system in real variables.

    The state y is [u] or [Re u, Im u], for order 2 followed by the velocity likewise: length order * parts * N.
    """

    term: Term
    order: int
    is_complex: bool
    sites: int
    ends: Ends

    @property
    def parts(self) -> int:
        """1 for a real field, 2 for a complex one."""
        return 1 + self.is_complex

    def pack(self, u: ndarray, v: ndarray | None) -> Float[ndarray, " state"]:
        """Write u (N,) and v (N,) as a state; for first-order equations v is left out."""
        fields = [u] if self.order == 1 else [u, np.zeros_like(u) if v is None else v]
        pieces = [part for one in fields for part in ((one.real, one.imag) if self.is_complex else (one,))]
        return np.concatenate(pieces).astype(float)

    def unpack(self, y: Float[ndarray, "state *times"]) -> tuple[ndarray, ndarray | None]:
        """Read u and v (None for order 1) from states, one a column: each (times, N)."""
        blocks = np.asarray(y).T.reshape(*np.shape(y)[1:], self.order, self.parts, self.sites)
        fields = blocks[..., 0, :] + 1j * blocks[..., 1, :] if self.is_complex else blocks[..., 0, :]
        return fields[..., 0, :], (fields[..., 1, :] if self.order == 2 else None)

    @functools.cached_property
    def right_hand_side(self) -> Callable[[float, ndarray], ndarray]:
        """The function dy/dt = F(t, y)."""
        bundle = compiled((self.term.text,), self.is_complex)
        gather = self._gather(bundle.slots)
        size = self.parts * self.sites

        def derivative(t: float, y: ndarray) -> ndarray:
            values = bundle.function(*gather(t, y))
            rate = np.empty_like(y)
            if self.order == 2:
                rate[:size] = y[size:]
            for part, value in enumerate(values):
                first = (self.order - 1) * size + part * self.sites
                rate[first : first + self.sites] = value
            return rate

        return derivative

    @functools.cached_property
    def jacobian(self) -> Callable[[float, ndarray], scipy.sparse.csc_array]:
        """The function dF/dy (t, y), sparse: (state, state)."""
        import scipy.sparse

        bundle, places = partials((self.term.text,), self.is_complex)
        gather = self._gather(bundle.slots)
        size, sites = self.parts * self.sites, self.sites
        left, right = self.term.reach
        index, factor = ghosts(sites, left, right, self.ends)
        rows, columns, weights = [], [], []
        for _, part, slot in places:
            window = slice(left + slot.offset, left + slot.offset + sites)
            block = (size if slot.name == "v" else 0) + (sites if slot.part == "im" else 0)
            rows.append((self.order - 1) * size + part * sites + np.arange(sites))
            columns.append(block + index[window])
            weights.append(factor[window])
        shape = (self.order * size, self.order * size)
        identity = (
            scipy.sparse.csc_array((np.ones(size), (np.arange(size), size + np.arange(size))), shape=shape)
            if self.order == 2
            else scipy.sparse.csc_array(shape)
        )

        def derivative(t: float, y: ndarray) -> scipy.sparse.csc_array:
            if not places:
                return identity
            values = bundle.function(*gather(t, y))
            data = np.concatenate([np.broadcast_to(value, sites) * w for value, w in zip(values, weights, strict=True)])
            place = (np.concatenate(rows), np.concatenate(columns))
            return scipy.sparse.csc_array(identity + scipy.sparse.csc_array((data, place), shape=shape))

        return derivative

    def _gather(self, slots: tuple[Slot, ...]) -> Callable[[float, ndarray], list[Any]]:
        """Make the function that cuts a state into the windows a compiled term takes."""
        left, right = self.term.reach
        index, factor = ghosts(self.sites, left, right, self.ends)
        n = np.arange(self.sites) - (self.sites - 1) / 2
        sites, parts = self.sites, self.parts
        for slot in slots:
            if slot.name == "f":
                raise InputError(
                    "an equation with a measured input f[n] cannot be simulated; write the force as a function of t"
                )

        def windows(t: float, y: ndarray) -> list[Any]:
            padded = y.reshape(self.order, parts, sites)[:, :, index] * factor
            arrays: list[Any] = []
            for slot in slots:
                if slot.name == "t":
                    arrays.append(t)
                elif slot.name == "n":
                    arrays.append(n)
                else:
                    first = left + slot.offset
                    arrays.append(padded[int(slot.name == "v"), int(slot.part == "im"), first : first + sites])
            return arrays

        return windows


def motion(system: System, parameters: Mapping[str, float], sites: int, ends: Ends | None = None) -> Motion:
    """Put a system on a chain of `sites` sites, with its own ends when `ends` is None.

    Raises:
        InputError: the equation is complex on a real field or needs a velocity that a first-order lattice lacks.
    """
    term = system.motion(parameters)
    real_parts(term.text, system.is_complex)
    if system.order == 1 and "v" in term.names:
        raise InputError(f"system {system.name!r}: a first-order equation has no velocity v[n]")
    return Motion(term, system.order, system.is_complex, sites, ends or system.ends)


# A user's own system ------------------------------------------------------------------------------------------------------


def load(path: Path) -> System:
    """Load a user's system from a Python file that defines `SYSTEM`, or from a TOML file.

    A TOML file has the fields of `System` as keys; `initials` is a table of tables with `u` and `v`, `libraries` a table of
    lists of terms.

    Raises:
        InputError: the file is missing or does not hold a sound system.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix == ".py":
        found = getattr(load_module(path), "SYSTEM", None)
        if not isinstance(found, System):
            raise InputError(f"{path}: it must define SYSTEM = System(...)")
        return found
    return _from_toml(path)


def load_module(path: Path) -> Any:
    """Import a user's Python file under a name of its own.

    Raises:
        InputError: the file is missing or fails when imported.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    spec = importlib.util.spec_from_file_location(f"latticebench_user_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up by its name.
    sys.modules[spec.name] = module
    try:
        # A user's folder is not ours to write into.
        before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
        try:
            spec.loader.exec_module(module)
        finally:
            sys.dont_write_bytecode = before
    except (Exception, SystemExit) as error:
        del sys.modules[spec.name]
        if isinstance(error, InputError):
            raise InputError(f"{path}: {error}") from error
        raise InputError(f"{path}: it cannot be imported: {type(error).__name__}: {error}") from error
    return module


def _from_toml(path: Path) -> System:
    from latticebench.systems.toml import read_toml

    content = read_toml(path)
    fields = (
        "name",
        "title",
        "equation",
        "order",
        "complex",
        "parameters",
        "initials",
        "libraries",
        "source",
    )
    optional = ("half_length", "sites", "ends", "integrator", "notes")
    for key in content:
        if key not in (*fields, *optional):
            raise unknown("key", key, (*fields, *optional), str(path))
    for key in ("name", "equation", "order", "initials"):
        if key not in content:
            raise InputError(f"{path}: the key {key!r} is missing")
    is_complex = content.get("complex", False)
    if not isinstance(is_complex, bool):
        raise InputError(f"{path}: complex is {is_complex!r}; it must be true or false")
    for key in ("parameters", "initials", "libraries"):
        if not isinstance(content.get(key, {}), dict):
            raise InputError(f"{path}: {key} is {content[key]!r}; it must be a table, as under [{key}]")
    for kind, texts in content["initials"].items():
        if not isinstance(texts, dict) or "u" not in texts or not set(texts) <= {"u", "v"}:
            raise InputError(f"{path}: initials.{kind} is {texts!r}; it must be a table of u and, for order 2, v")
    try:
        return System(
            name=content["name"],
            title=content.get("title", content["name"]),
            equation=content["equation"],
            order=content["order"],
            is_complex=is_complex,
            parameters=content.get("parameters", {}),
            initials={name: Initial(**texts) for name, texts in content["initials"].items()},
            libraries=tuple(_library_of(name, terms) for name, terms in content.get("libraries", {}).items()),
            source=content.get("source", str(path)),
            **{key: content[key] for key in optional if key in content},
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _library_of(name: str, terms: Any) -> Library:
    """Make a library of what a file has under libraries.NAME."""
    if not isinstance(terms, str) and not (isinstance(terms, list) and all(isinstance(one, str) for one in terms)):
        raise InputError(f"libraries.{name} is {terms!r}; it must be a list of terms, or one text with ; between them")
    try:
        return library(name, terms)
    except TermError as error:
        raise InputError(f"libraries.{name}: {error}") from None
