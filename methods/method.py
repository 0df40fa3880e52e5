"""The protocol of a method, what it can do, and the fit that it returns.

A method is a frozen dataclass whose fields are its settings (their types say their bounds, see
`methods.engine.bounds`), with a `name`, `abilities` and

    fit(data, library, order, seed) -> Fit

`data` is a list of trajectories, `library` the terms T_j, `order` the order of the time derivative. The fit has the
real coefficients xi of

    d^order u_n / dt^order = sum_j xi_j T_j(u_{n+k}, v_{n+k}, f_n, n, t)

Heavy packages (torch, pysindy) are imported where they are used, so that listing methods stays fast.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import numbers
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from latticebench.methods.engine.bounds import checked
from latticebench.systems.arrays import free_memory
from latticebench.systems.errors import InputError, unknown
from latticebench.systems.lattice import Library
from latticebench.systems.options import option
from latticebench.systems.samples import Samples, SimulatedSamples
from latticebench.systems.stencil import ghosts, observed

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Characters of what a method says of its fit.
MOST_SAID = 2000
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Abilities:
    """What a method can take; where the data ask for more it is skipped, with a reason.

    Attributes:
        complex: complex fields.
        inputs: measured inputs f.
        uneven: times that are not evenly spaced.
        missing: values that are NaN.
        truth: it must be shown the truth (a ceiling, not a contestant).
        motion: its fits have the motion that they follow, and the size of the noise.
        memory: bytes that a fit takes at most for each value of the samples and each term; 0 where it goes through
            them piece by piece.
        window: sites of a trajectory that it takes at once at most, unless a term asks for the number of a site; 0 for
            all of them.
        loads: packages that a fit imports; they are loaded before its clock starts.
        needs: packages that are not installed with this one.
    """

    complex: bool = True
    inputs: bool = True
    uneven: bool = True
    missing: bool = False
    truth: bool = False
    motion: bool = False
    memory: float = 0.0
    window: int = 0
    loads: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def missing_packages(self) -> tuple[str, ...]:
        """Those of `needs` that are not installed."""
        return tuple(name for name in self.needs if importlib.util.find_spec(name) is None)


class Skipped(Exception):
    """A method cannot take these data; the text is the reason."""


@dataclass(frozen=True, eq=False)
class History:
    """The coefficients on the way to a fit, K times.

    Attributes:
        step: number of the optimiser's step (K,), increasing.
        seconds: wall time since the start of the fit (K,).
        loss: the objective (K,), in the method's own units.
        coefficients: (K, terms).
    """

    step: Float[ndarray, " record"]
    seconds: Float[ndarray, " record"]
    loss: Float[ndarray, " record"]
    coefficients: Float[ndarray, "record terms"]

    def thinned(self, most: int) -> History:
        """Return at most so many of the records, evenly, with the first and the last."""
        records = len(self.step)
        kept = np.unique(np.linspace(0, records - 1, min(records, most)).round().astype(int))
        return History(self.step[kept], self.seconds[kept], self.loss[kept], self.coefficients[kept])


@dataclass(frozen=True, eq=False)
class Smooth:
    """The curves that a method lays through one trajectory's samples, which need not obey the equation.

    Attributes:
        times: where the method asks for the equation (Q,).
        share: the share of the whole time that each of them stands for (Q,).
        levels: u and its time derivatives up to the equation's order, real parts before imaginary ones, of shape
            (order + 1, Q, parts, N).
    """

    times: Float[ndarray, " point"]
    share: Float[ndarray, " point"]
    levels: Float[ndarray, "levels point parts sites"]


@dataclass(frozen=True, eq=False)
class Fit:
    """Coefficients, and how they were found.

    Attributes:
        method: the method's name.
        library: the terms, in the order of the coefficients.
        order: the order of the time derivative.
        coefficients: one real number per term, in the units of the derivative over those of the term.
        residual: RMS of what the equation leaves of the derivative, over the RMS of the derivative (dimensionless);
            NaN where the method has no derivative.
        stderr: standard errors, or None where the method gives none.
        status: "ok", or what a reader must know about the fit.
        seconds: wall time of the fit alone.
        cpu_seconds: processor time of the fit alone.
        history: the coefficients on the way, of a method that iterates.
        found: what else the method found (a threshold, a weight), by name.
        motion: u and, for order 2, v of the fitted motion at the times of each trajectory, where the method follows
            one. The noise is then in `found`: noise_u and, where v was observed, noise_v, standard deviations of each
            real part.
        smooth: the curves of each trajectory, where the method fits curves and coefficients together.

    Raises:
        ValueError: the coefficients do not match the library, or are not real.
    """

    method: str
    library: Library
    order: int
    coefficients: Float[ndarray, " terms"]
    residual: float
    stderr: Float[ndarray, " terms"] | None = None
    status: str = "ok"
    seconds: float = float("nan")
    cpu_seconds: float = float("nan")
    history: History | None = None
    found: Mapping[str, float | str] = field(default_factory=dict)
    motion: tuple[Samples, ...] | None = None
    smooth: tuple[Smooth, ...] | None = None

    def __post_init__(self) -> None:
        """Check that there is one real coefficient per term."""
        expected = (len(self.library.terms),)
        for name, array in (("coefficients", self.coefficients), ("stderr", self.stderr)):
            if array is None:
                continue
            if np.shape(array) != expected:
                raise ValueError(f"{self.method}: {name} have shape {np.shape(array)}, the library {expected}")
            if np.iscomplexobj(array):
                raise ValueError(
                    f"{self.method}: {name} must be real; a complex coefficient of T is those of T and i*T"
                )


class Method(Protocol):
    """What every method has; it is a frozen dataclass whose fields are its settings."""

    name: ClassVar[str]

    @property
    def abilities(self) -> Abilities:
        """What the method can take with these settings."""
        ...

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Fit the coefficients; every random draw comes from a generator seeded with `seed`."""
        ...


def make(kind: type[Method], given: Mapping[str, Any], *, texts: bool = False) -> Method:
    """Return a method with settings.

    Args:
        kind: the method's class.
        given: settings by name; the others have their defaults.
        texts: the values are texts from a command line.

    Raises:
        InputError: the method has no such setting, or a value is of another type or out of range.
    """
    known = settings(kind)
    values = {}
    for name, value in given.items():
        if name not in known:
            raise unknown("setting", name, known, f"method {kind.name!r}")
        try:
            values[name] = checked(kind, name, value, text=texts)
        except InputError as error:
            usual = "" if known[name] is None else f"; it is {known[name]!r} if you leave it out"
            raise InputError(f"method {kind.name!r}: {error}{usual}") from None
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"method {kind.name!r}: {error}") from None


def settings(kind: type[Method]) -> dict[str, Any]:
    """Return a method's settings with their defaults."""
    instance: Any = kind()
    return {one.name: getattr(instance, one.name) for one in fields(instance)} if is_dataclass(instance) else {}


def solve(method: Method, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
    """Check that a method can take the data, hide the truth from it, and time its fit.

    Args:
        method: the method, with its settings.
        data: the trajectories.
        library: the terms.
        order: of the time derivative.
        seed: of the method's random draws.

    Raises:
        Skipped: the method declares that it cannot take these data.
        InputError: a setting is out of range, or the library cannot be evaluated on the data.
        TypeError: the method returned something else than a Fit, or a part of it is of another type.
        ValueError: a coefficient is not finite, or the fit is of another library.
    """
    _check_settings(method)
    check_fit(data, library, order)
    reason = obstacle(method.abilities, data, library)
    if reason:
        raise Skipped(reason)
    shown = [s.observed() if isinstance(s, SimulatedSamples) and not method.abilities.truth else s for s in data]
    for package in (*method.abilities.loads, *method.abilities.needs):
        importlib.import_module(package)
    log.debug("%s: fits %d terms to %d trajectories", method.name, len(library.terms), len(shown))
    wall, cpu = time.perf_counter(), time.process_time()
    fit = method.fit(shown, library, order, seed)
    _check_returned(fit, library, order)
    return replace(fit, seconds=time.perf_counter() - wall, cpu_seconds=time.process_time() - cpu)


def _check_settings(method: Method) -> None:
    """Refuse what `make` refuses: a method may have been made without it."""
    if is_dataclass(method):
        for name, usual in settings(type(method)).items():
            value = getattr(method, name)
            if value is not usual:
                make(type(method), {name: value})


def _check_returned(fit: Any, library: Library, order: int) -> None:
    """Refuse what is no fit of a library; a method of a user's may return anything."""
    if not isinstance(fit, Fit):
        raise TypeError(f"fit() returned {type(fit).__name__}; it must return a Fit")
    for name, array in (("coefficients", fit.coefficients), ("stderr", fit.stderr)):
        if array is not None and not (isinstance(array, np.ndarray) and array.dtype.kind in "fiu"):
            raise TypeError(f"{name} must be a NumPy array of real numbers")
    if not np.all(np.isfinite(fit.coefficients)):
        raise ValueError("the coefficients are not finite")
    if fit.library.texts != library.texts:
        raise ValueError("the fit is of another library; return the one that fit() was given")
    if fit.order != order:
        raise ValueError(f"the fit is of order {fit.order!r}; return the one that fit() was given, {order}")
    if fit.stderr is not None and np.any(fit.stderr < 0):
        raise ValueError("a standard error is negative")
    if not isinstance(fit.status, str) or len(fit.status) > MOST_SAID:
        raise TypeError(f"status must be a text of at most {MOST_SAID} characters")
    if not isinstance(fit.residual, numbers.Real):
        raise TypeError(f"residual must be a number, it is {type(fit.residual).__name__}")
    if not isinstance(fit.found, Mapping) or any(
        not isinstance(one, (str, numbers.Real)) for one in fit.found.values()
    ):
        raise TypeError("found must be a dictionary of numbers and texts")


def check_fit(data: Sequence[Samples], library: Library, order: int) -> None:
    """Check that a library makes sense on data.

    Raises:
        InputError: the order is neither 1 nor 2, a term is complex and the field real, the input is missing, or there
            are fewer sites than the stencil needs.
    """
    if order not in (1, 2):
        raise InputError(f"order is {order!r}; it must be 1 (du/dt) or 2 (d^2u/dt^2)")
    if not data:
        raise InputError("there are no samples to fit")
    for samples in data:
        try:
            ghosts(samples.sites, *library.reach, samples.ends)
        except InputError as error:
            raise InputError(f"{samples.source}: {error}") from None
        if library.uses("f") and samples.f is None:
            raise InputError(
                f"{samples.source}: the library uses f[n], "
                f"but the data have no measured input f or f1..f{samples.sites}"
            )
        if library.uses("i") and not samples.is_complex:
            raise InputError(f"{samples.source}: the library uses i, but the field is real; leave the terms with i out")
    if library.uses("v") and order == 1:
        raise InputError(f"the library uses v[n], but an equation of order 1 has no velocity; use {option('order', 2)}")
    _check_read(data, library)


def _check_read(data: Sequence[Samples], library: Library) -> None:
    """Refuse readings that leave as many motions unknown as there are equations: they determine no coefficient.

    Each site that was never read is an unknown function of time, each site with an equation a relation between them.
    """
    for samples in data:
        inner = observed(samples.sites, library.reach, samples.ends)
        if len(samples.unread) < inner.stop - inner.start:
            return
    first = data[0]
    raise InputError(
        f"{first.source}: nothing was ever read of {first.columns(first.unread)}, and only "
        f"{inner.stop - inner.start} site(s) have an equation: no coefficient can be determined; say how the chain "
        f"ends ({option('ends')}), take terms with fewer neighbours, or give readings of these sites"
    )


def obstacle(abilities: Abilities, data: Sequence[Samples], library: Library) -> str:
    """Return why a method cannot take the data; empty where it can."""
    lacking = abilities.missing_packages
    if lacking:
        return f"it needs {' and '.join(lacking)}, not installed; try: pip install {' '.join(lacking)}"
    checks: list[tuple[bool, Callable[[Samples], bool], str]] = [
        (abilities.complex, lambda s: s.is_complex, "it does not take complex fields"),
        (
            abilities.inputs,
            lambda s: s.f is not None and library.uses("f"),
            "it does not take measured inputs",
        ),
        (abilities.uneven, lambda s: not s.is_even, "it needs evenly spaced times"),
        (abilities.missing, lambda s: s.has_missing, "it does not take missing values"),
        (
            not abilities.truth,
            lambda s: not isinstance(s, SimulatedSamples),
            "it needs the truth, which only simulated samples know",
        ),
    ]
    reason = next((reason for able, asks, reason in checks if not able and any(asks(s) for s in data)), "")
    return reason or too_large(abilities, data, library)


def too_large(abilities: Abilities, data: Sequence[Samples], library: Library) -> str:
    """Return that the data take more memory than there is; empty where they do not."""
    sizes = [samples.u.size * (1 + samples.is_complex) for samples in data]
    values = float(sum(sizes))
    if abilities.window and not library.uses("n"):
        values = max(size * min(abilities.window / one.sites, 1) for size, one in zip(sizes, data, strict=True))
    needed, there = abilities.memory * values * len(library.terms), free_memory()
    if needed <= there:
        return ""
    return (
        f"it would take about {needed / 2**30:.2g} GiB for {values:.0f} values and {len(library.terms)} terms, and "
        f"{there / 2**30:.2g} GiB may be used; show it fewer sites, samples or terms, or take a method that goes "
        "through them piece by piece, as least squares does"
    )
