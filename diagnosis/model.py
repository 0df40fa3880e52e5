"""A declared equation with effects added to it, fitted to recordings as whole trajectories.

    d^order u_n / dt^order = sum_j xi_j T_j   (declared)   +   what the added effects' terms contribute
    y = u + what the instrument's effects make of it + noise

Coefficients of terms enter linearly and are fitted by `methods.trajectory.maximise`, together with every trajectory's start.
All other parameters (a frequency, a delay, a site's mass, a sensor's gain) are `psi`: Gauss-Newton steps on the tangent
of the fitted model (`diagnosis.tangent`), each followed by a fit of the rest.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.dynamics import Factor
from latticebench.methods.engine.record import Record, prepare, without_halves
from latticebench.methods.engine.shooting import Solution, State, maximise
from latticebench.methods.engine.starts import approach, guess
from latticebench.systems.effects import INSTRUMENT, Effect
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Ends
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# With unknown ends all equations leave the same sites without one, as far as the chain is long enough.
REACH = 2
MIN_SITES = 9
# Accuracy of the integration between samples, in units of the noise; friction that jumps would cost much more of it.
ACCURACY = 0.1
# Parameters that are found by the search and then kept.
KEPT = ("s", "open", "reach", "step", "inner", "origin", "whole")


@functools.lru_cache(maxsize=512)
def read_term(text: str) -> Term:
    """Give a term that may be asked for many thousand times, read once."""
    return Term(text)


@dataclass(frozen=True, eq=False)
class Force:
    """One term of the right-hand side with where and when it acts; see `systems.sensitivity.Dynamics`."""

    term: Term
    weights: Float[ndarray, " sites"] | None = None
    factor: Factor | None = None
    label: str = ""


@dataclass(frozen=True, eq=False)
class Change:
    """An effect as it is put into a model.

    Attributes:
        effect: of the catalogue.
        texts: its terms on this lattice.
        psi: the parameters that are not coefficients, by name, as far as they are fitted.
        site: where it acts (0, ..., N-1), or None.
        ends: how the chain ends instead.
        past: the field of each record at earlier times, for effects that need it: gives (B, N) at times (B,).
        both: a sensor's error is in u and v alike.
        as_force: a sensor's offset written as what it does to the equation, a constant force at each site; a linear chain cannot
            tell the two apart, and the force can be found before the coefficients are right.
        spread: standard deviation that the parameters have among themselves, for random ones; None for any size.
        effective: how many numbers random parameters amount to, held together as they are by their spread.
    """

    effect: Effect
    texts: tuple[str, ...] = ()
    psi: Mapping[str, float] = field(default_factory=dict)
    site: int | None = None
    ends: Ends | None = None
    past: tuple[Factor, ...] = ()
    both: bool = False
    as_force: bool = False
    spread: float | None = None
    effective: float | None = None

    @property
    def free(self) -> tuple[str, ...]:
        """The parameters that a fit changes."""
        return () if self.as_force else tuple(name for name in self.psi if name not in KEPT)

    def moved(self, psi: Mapping[str, float]) -> Change:
        """Give the change with other values of some parameters."""
        return replace(self, psi={**self.psi, **{name: value for name, value in psi.items() if name in self.psi}})

    def forces(self, sites: int, is_complex: bool, record: int = 0) -> list[Force]:
        """Give the terms that it adds to the right-hand side, on the chain of one record."""
        acts, psi = self.effect.acts, self.psi
        if self.as_force:
            return [Force(read_term("1"), row, None, f"1 at site {k + 1}") for k, row in enumerate(np.eye(sites))]
        if acts in INSTRUMENT or acts in ("one equation", "ends"):
            return []
        if acts == "harmonic":
            omega = psi["omega"]
            waves = (
                ("cos", lambda t: np.cos(omega * t)[None, :, None]),
                ("sin", lambda t: np.sin(omega * t)[None, :, None]),
            )
            return [
                Force(read_term(text), None, wave, f"{name}({omega:.6g}*t)" + ("" if text == "1" else f"*{text}"))
                for text in self.texts
                for name, wave in waves
            ]
        if acts == "pulse":
            at, width = psi["at"], psi["width"]

            def pulse(t: ndarray) -> ndarray:
                return np.asarray(np.exp(-(((t - at) / width) ** 2) / 2)[None, :, None])

            shape = f"exp(-((t-{at:.6g})/{width:.6g})**2/2)"
            return [
                Force(read_term(text), None, pulse, shape + ("" if text == "1" else f"*{text}")) for text in self.texts
            ]
        if acts == "delayed":
            return _delayed(self.past[min(record, len(self.past) - 1)], psi["delay"], is_complex)[: len(self.texts)]
        if acts == "long range":
            text = _far_text(psi, sites)
            label = f"sum over r>=2 of (u[n+r]+u[n-r]-2*u[n])/r**{psi['s']:.4g}"
            whole = [Force(read_term(text), label=label), Force(read_term(f"i*({text})"), label=f"i*{label}")]
            return whole[: len(self.texts)]
        if acts == "alternating":
            sign = np.where(np.arange(sites) % 2 == 0, 1.0, -1.0)
            return [Force(read_term(text), sign, None, f"(-1)**k*{text}") for text in self.texts]
        if acts == "one site":
            assert self.site is not None
            return [Force(read_term(text), np.eye(sites)[self.site], None, text) for text in self.texts]
        if acts == "every site":
            each = np.eye(sites)
            if not self.psi.get("whole"):
                # Deviations from their mean, which the model has already: the last site's is what makes their sum 0.
                each = each[:-1] - each[-1]
            return [
                Force(read_term(text), row, None, f"{text} at site {k + 1}")
                for text in self.texts
                for k, row in enumerate(each)
            ]
        return [Force(read_term(text), label=text) for text in self.texts]

    def scales(self, sites: int) -> ndarray | None:
        """Give the factor of each site's whole right-hand side, or None where it has none."""
        if self.effect.acts != "one equation":
            return None
        factor = np.ones(sites)
        factor[self.site] += self.psi["scale"]
        return factor

    def misreading(
        self, t: Float[ndarray, " time"], field: Float[ndarray, "time levels parts sites"], rate: ndarray
    ) -> Float[ndarray, "time levels parts sites"]:
        """Say what the instrument adds to the readings of a field whose time derivative is `rate`."""
        wrong = np.zeros_like(field)
        if self.effect.acts == "rounding":
            wrong[:, :1] = rounding_error(field[:, :1], self.psi["step"], self.psi["inner"], self.psi["origin"])
        for name in self.free:
            value = self.psi[name]
            wrong += value * self.misreading_by(name, t, field, rate)
        return wrong

    def misreading_by(self, name: str, t: ndarray, field: ndarray, rate: ndarray) -> ndarray:
        """Give the derivative of the misreading by one parameter; all of them enter linearly."""
        acts = self.effect.acts
        column = np.zeros_like(field)
        kind, _, number = name.partition("_")
        where = slice(None) if not number else int(number) - 1
        levels = slice(None) if self.both else slice(0, 1)
        if acts == "offset":
            part = 1 if kind == "imaginary" else 0
            column[:, 0, part, where] = 1.0
        elif acts == "gain":
            column[:, levels, :, where] = field[:, levels, :, where]
        elif acts == "curve":
            u = field[:, 0]
            if u.shape[1] == 1:
                column[:, 0, 0, where] = u[:, 0, where] ** 2
                if self.both and field.shape[1] > 1:
                    column[:, 1, 0, where] = 2 * u[:, 0, where] * field[:, 1, 0, where]
            else:
                column[:, 0, :, where] = np.hypot(u[:, 0], u[:, 1])[:, None, where] * u[:, :, where]
        elif acts == "clock":
            if kind == "rate":
                column[:] = (t - t[0])[:, None, None, None] * rate
            else:
                row = int(number) - 1
                column[row : row + 1] = rate[row : row + 1]
        return column


def _far_text(psi: Mapping[str, float], sites: int) -> str:
    """Write the long-range coupling as a term: with what the ends repeat, or (open) between the sites that there are."""
    terms = []
    for r in range(2, int(psi["reach"]) + 1):
        strength = f"{r ** -psi['s']:.10g}"
        if not psi["open"]:
            terms.append(f"{strength}*(u[n+{r}]+u[n-{r}]-2*u[n])")
            continue
        # A site beyond the end does not pull: (1 + sign) / 2 is 1 inside and 0 outside.
        last = (sites - 1) / 2 + 0.25 - r
        terms.append(f"{strength}/2*((1+sign({last}-n))*(u[n+{r}]-u[n])+(1+sign({last}+n))*(u[n-{r}]-u[n]))")
    return " + ".join(terms)


def far_matrix(psi: Mapping[str, float], sites: int) -> Float[ndarray, "sites sites"]:
    """Give the open long-range coupling as a matrix."""
    distance = np.abs(np.subtract.outer(np.arange(sites), np.arange(sites))).astype(float)
    pull = np.zeros((sites, sites))
    far = (distance >= 2) & (distance <= psi["reach"])
    pull[far] = distance[far] ** -psi["s"]
    return pull - np.diag(pull.sum(axis=1))


def rounding_error(field: ndarray, step: float, inner: float, origin: float) -> ndarray:
    """Give the mean error of readings rounded to origin + k * step, for a field with noise of the size `inner` before it.

    The Fourier series of the sawtooth, damped by the noise (Widrow & Kollar, Quantization Noise (2008), chapter 4).
    """
    phase = 2 * np.pi * (field - origin) / step
    waves = (
        (-1) ** k * step / (np.pi * k) * np.exp(-2 * (np.pi * k * inner / step) ** 2) * np.sin(k * phase)
        for k in range(1, 30)
    )
    return np.asarray(sum(waves))


def _delayed(past: Factor, delay: float, is_complex: bool) -> list[Force]:
    """Give the field as it was, and i times it: known functions of time."""
    label = f"u[n] at t-{delay:.6g}"
    if not is_complex:
        return [Force(read_term("1"), None, lambda t: past(t - delay)[None], label)]

    def now(t: ndarray) -> ndarray:
        field = past(t - delay)
        return np.stack([field.real, field.imag])

    def turned(t: ndarray) -> ndarray:
        field = past(t - delay)
        return np.stack([-field.imag, field.real])

    return [Force(read_term("1+i"), None, now, label), Force(read_term("1+i"), None, turned, f"i*({label})")]


@dataclass(frozen=True, eq=False)
class Model:
    """A declared equation and what was added to it.

    Attributes:
        declared: its terms, all of unknown coefficients.
        order: of the time derivative.
        changes: the effects added so far, in that order.
    """

    declared: Library
    order: int
    changes: tuple[Change, ...] = ()

    def with_change(self, change: Change) -> Model:
        """Add an effect."""
        return replace(self, changes=(*self.changes, change))

    def without(self, number: int) -> Model:
        """Take the effect of this number away."""
        return replace(self, changes=self.changes[:number] + self.changes[number + 1 :])

    def forces(self, sites: int, is_complex: bool, record: int = 0) -> list[Force]:
        """Give all terms on the chain of one record, the declared ones first."""
        declared = [Force(term, label=term.text) for term in self.declared.terms]
        return declared + [force for change in self.changes for force in change.forces(sites, is_complex, record)]

    def records(self, data: Sequence[Samples]) -> list[Record]:
        """Set the equation up on each trajectory."""
        found = []
        ends = next((change.ends for change in self.changes if change.ends), None)
        # Pieces of one record share their forces, so that they can be integrated as one.
        shared: dict[tuple[object, ...], list[Force]] = {}
        for number, samples in enumerate(data):
            seen = samples if ends is None else replace(samples, ends=ends)
            pasts = [change.past[min(number, len(change.past) - 1)] for change in self.changes if change.past]
            kind = (samples.sites, samples.is_complex, *map(id, pasts))
            if kind not in shared:
                shared[kind] = self.forces(samples.sites, samples.is_complex, number)
            forces = shared[kind]
            weights = np.stack([np.ones(samples.sites) if one.weights is None else one.weights for one in forces])
            for change in self.changes:
                scale = change.scales(samples.sites)
                weights = weights if scale is None else weights * scale
            wide = seen.ends == "unknown" and samples.sites >= MIN_SITES
            found.append(
                prepare(
                    seen, tuple(one.term for one in forces), self.order,
                    None if np.all(weights == 1) else weights,
                    tuple(one.factor for one in forces) if any(one.factor for one in forces) else None,
                    (REACH, REACH) if wide else (0, 0),
                )
            )  # fmt: skip
        return found


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model fitted to data.

    Attributes:
        model: with its parameters where the fit ended.
        data: what it was fitted to.
        records: the trajectories as the fit saw them, the instrument's effects taken off.
        solution: coefficients (of all forces), states, noise.
        psi_errors: standard errors of the parameters of each change, by name.
    """

    model: Model
    data: tuple[Samples, ...]
    records: tuple[Record, ...]
    solution: Solution
    psi_errors: tuple[Mapping[str, float], ...] = ()

    @property
    def sigma(self) -> Float[ndarray, " levels"]:
        """Standard deviation of what is left of u and v, each real part."""
        return self.solution.sigma

    @property
    def count(self) -> float:
        """How many numbers were observed."""
        return float(np.sum(self.solution.counts))

    @property
    def parameters(self) -> float:
        """How many numbers were fitted."""
        own = (len(one.free) if one.effective is None else one.effective for one in self.model.changes)
        return self.solution.parameters + sum(own)

    def gain(self, simpler: Fitted) -> float:
        """Twice the log of the likelihood ratio to a simpler model, the noise's sizes being fitted too.

        The count of numbers is lessened by that of the parameters, so that for a model that lacks nothing it is distributed
        as chi squared.
        """
        spare = max(1 - self.parameters / self.count, 0.05)
        pairs = zip(self.solution.counts, self.solution.misfit, simpler.solution.misfit, strict=True)
        return float(sum(n * spare * np.log(max(b, 1e-300) / max(a, 1e-300)) for n, a, b in pairs if n))

    def curves(self) -> Iterator[tuple[Float[ndarray, " time"], Float[ndarray, "time order parts sites"]]]:
        """Give times, and u and v of every site at them, for each trajectory."""
        state = self.solution.state
        for record, nodes, splines in zip(self.records, state.nodes, state.splines, strict=True):
            yield record.times, whole_field(record, nodes, splines)

    def residuals(self) -> list[Float[ndarray, "time levels parts sites"]]:
        """Give what is left of the readings, 0 where nothing was seen."""
        found = []
        for record, nodes, splines in zip(
            self.records, self.solution.state.nodes, self.solution.state.splines, strict=True
        ):
            whole = whole_field(record, nodes, splines)[:, : record.value.shape[1]]
            found.append(np.where(record.seen, record.value - whole, 0.0))
        return found


def whole_field(record: Record, nodes: ndarray, splines: ndarray | None) -> Float[ndarray, "time order parts sites"]:
    """Give u and v of every site at the sample times."""
    dynamics = record.stretches.dynamics
    return dynamics.whole(nodes, record.stretches.driven(record.times, splines))


def rates(record: Record, state: State, number: int) -> Float[ndarray, "time order parts sites"]:
    """Give du/dt and, for order 2, dv/dt of every site at the sample times; 0 at sites without an equation."""
    stretches = record.stretches
    dynamics = stretches.dynamics
    nodes, splines = state.nodes[number], state.splines[number]
    f = None if stretches.inputs is None else stretches.inputs(record.times)
    driven = stretches.driven(record.times, splines)
    rate = dynamics.linear(state.coefficients, record.times, nodes, f, driven, derivatives=False)[0]
    return dynamics.whole(rate, None)


def strengths(fitted: Fitted) -> Float[ndarray, " terms"]:
    """Give the RMS of what each term, with its coefficient, contributes to the highest derivative along the fitted motion."""
    coefficients = fitted.solution.state.coefficients
    total, count = np.zeros(len(coefficients)), 0
    for number, record in enumerate(fitted.records):
        stretches, nodes = record.stretches, fitted.solution.state.nodes[number]
        f = None if stretches.inputs is None else stretches.inputs(record.times)
        driven = stretches.driven(record.times, fitted.solution.state.splines[number])
        values = stretches.dynamics.linear(coefficients, record.times, nodes, f, driven, derivatives=False)[1]
        total += np.sum((np.moveaxis(values, 1, -1) * coefficients) ** 2, axis=tuple(range(values.ndim - 1)))
        count += values.size // values.shape[1]
    return np.asarray(np.sqrt(total / max(count, 1)))


def pace(curves: Iterable[tuple[Float[ndarray, " time"], Float[ndarray, "time order parts sites"]]]) -> float:
    """Give the angular frequency that motions have on the whole: RMS of du/dt over that of u about its mean at each site."""
    change, size = 0.0, 0.0
    for times, states in curves:
        rate = states[:, 1] if states.shape[1] > 1 else np.gradient(states[:, 0], times, axis=0)
        change += float(np.sum(rate**2))
        size += float(np.sum((states[:, 0] - np.mean(states[:, 0], axis=0)) ** 2))
    return float(np.sqrt(change / size)) if size > 0 else 0.0


def without(fitted: Fitted, number: int) -> Fitted:
    """Take the change of this number out of a fit's model and its coefficients out of its state; nothing is fitted again."""
    samples = fitted.data[0]
    counts = [len(change.forces(samples.sites, samples.is_complex)) for change in fitted.model.changes]
    begin = len(fitted.model.declared.terms) + sum(counts[:number])
    state = fitted.solution.state
    coefficients = np.delete(state.coefficients, np.arange(begin, begin + counts[number]))
    return replace(
        fitted,
        model=fitted.model.without(number),
        solution=replace(fitted.solution, state=replace(state, coefficients=coefficients)),
    )


def first_fit(
    model: Model, data: Sequence[Samples], steps: int = 40, coefficients: Float[ndarray, " terms"] | None = None
) -> Fitted:
    """Fit a model from a blind start, or from coefficients that another method found.

    Raises:
        InputError: the samples do not even give a start.
    """
    data = tuple(without_halves(samples) for samples in data)
    records = model.records(data)
    begin = (
        approach(data, records, steps)
        if coefficients is None
        else replace(guess(data, records), coefficients=coefficients)
    )
    solution = maximise(records, begin, steps=steps, tolerance=0.01)
    if not solution.converged:
        other = maximise(records, guess(data, records), steps=steps, tolerance=0.01)
        if other.converged or other.criterion < solution.criterion:
            solution = other
    return Fitted(model, data, tuple(records), solution)


def cut(data: Sequence[Samples], longest: int) -> list[Samples]:
    """Cut trajectories into pieces of at most so many samples; each starts from a state of its own.

    A model that is far off can follow the readings for a short time only; in pieces, what it lacks shows as a force.
    """
    pieces: list[Samples] = []
    for samples in data:
        count = -(-len(samples.t) // longest)
        rows = np.array_split(np.arange(len(samples.t)), count)
        pieces += [rows_of(samples, int(some[0]), int(some[-1]) + 1) for some in rows]
    return pieces


def rows_of(samples: Samples, begin: int, end: int) -> Samples:
    """Give the samples of some rows."""

    def part(field: ndarray | None) -> ndarray | None:
        return None if field is None else field[begin:end]

    u = part(samples.u)
    assert u is not None
    return replace(samples, t=samples.t[begin:end], u=u, v=part(samples.v), f=part(samples.f))


def carried(fitted: Fitted, data: Sequence[Samples]) -> State:
    """Give a fit's states as the start of a fit to the same samples, cut otherwise; drives at unknown ends start anew."""
    state = fitted.solution.state
    sizes = [len(samples.t) for samples in data]
    if [len(nodes) for nodes in state.nodes] == sizes:
        return state
    nodes = np.split(np.concatenate(state.nodes), np.cumsum(sizes)[:-1])
    splines: list[ndarray | None] = [None] * len(nodes)
    if any(one is not None for one in state.splines):
        splines = list(guess(data, fitted.model.records(data)).splines)
    return State(state.coefficients, tuple(nodes), tuple(splines))


def corrected(
    model: Model,
    state: State,
    plain: Sequence[Record],
) -> list[Record]:
    """Take the instrument's effects off the readings, as they are for the present states."""
    instrument = [change for change in model.changes if change.effect.acts in INSTRUMENT]
    if not instrument:
        return list(plain)
    found = []
    for number, record in enumerate(plain):
        levels = record.value.shape[1]
        field = whole_field(record, state.nodes[number], state.splines[number])[:, :levels]
        rate = rates(record, state, number)[:, :levels]
        wrong = sum(change.misreading(record.times, field, rate) for change in instrument)
        found.append(replace(record, value=np.where(record.seen, record.value - wrong, 0.0)))
    return found


def refit(model: Model, data: Sequence[Samples], start: State, *, steps: int = 20, tolerance: float = 0.02) -> Fitted:
    """Fit a model from known states, its parameters psi kept.

    `start` may have fewer coefficients than the model has forces: those of added forces start at 0.
    """
    records = model.records(data)
    count = len(records[0].stretches.dynamics.terms)
    coefficients = np.zeros(count)
    kept = min(count, len(start.coefficients))
    coefficients[:kept] = start.coefficients[:kept]
    nodes, splines = list(start.nodes), list(start.splines)
    for number, record in enumerate(records):
        dynamics = record.stretches.dynamics
        drive, own = record.stretches.drive, splines[number]
        known = own is None if drive is None else own is not None and len(own) == drive.count
        if nodes[number].shape[1] != dynamics.size or not known:
            fresh = guess([data[number]], [record])
            nodes[number], splines[number] = fresh.nodes[0], fresh.splines[0]
    state = State(coefficients, tuple(nodes), tuple(splines))
    seen = corrected(model, state, records)
    solution = maximise(seen, state, steps=steps, tolerance=tolerance, accuracy=ACCURACY)
    return Fitted(model, tuple(data), tuple(seen), solution)
