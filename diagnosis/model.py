"""A declared equation with effects added to it, fitted to recordings as whole trajectories.

    d^order u_n / dt^order = sum_j xi_j T_j   (declared)   +   what the added effects' terms contribute
    y = u + what the instrument's effects make of it + noise

Coefficients of terms enter linearly and are fitted by `methods.engine.shooting.maximise`, together with every
trajectory's start. All other parameters (a frequency, a delay, a site's mass, a sensor's gain) are `psi`: Gauss-Newton
steps on the tangent of the fitted model (`diagnosis.tangent`), each followed by a fit of the rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.placed import Force, PlacedEffect
from latticebench.methods.engine.record import Record, prepare, without_halves
from latticebench.methods.engine.shooting import Solution, State, maximise
from latticebench.methods.engine.starts import approach, guess
from latticebench.systems.effects import INSTRUMENT
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# With unknown ends all equations leave the same sites without one, as far as the chain is long enough.
REACH = 2
MIN_SITES = 9
# Accuracy of the integration between samples, in units of the noise; friction that jumps would cost much more of it.
ACCURACY = 0.1


@dataclass(frozen=True, eq=False)
class Model:
    """A declared equation and what was added to it.

    Attributes:
        declared: its terms, all of unknown coefficients.
        order: of the time derivative.
        effects: those added so far, in that order.
    """

    declared: Library
    order: int
    effects: tuple[PlacedEffect, ...] = ()

    def with_effect(self, placed: PlacedEffect) -> Model:
        """Return the model with one effect more."""
        return replace(self, effects=(*self.effects, placed))

    def without(self, number: int) -> Model:
        """Return the model without the effect of this number."""
        return replace(self, effects=self.effects[:number] + self.effects[number + 1 :])

    def forces(self, sites: int, is_complex: bool, record: int = 0) -> list[Force]:
        """Return all terms on the chain of one record, the declared ones first."""
        declared = [Force(term, label=term.text) for term in self.declared.terms]
        return declared + [force for placed in self.effects for force in placed.forces(sites, is_complex, record)]

    def records(self, data: Sequence[Samples]) -> list[Record]:
        """Return the equation set up on each trajectory."""
        found = []
        ends = next((placed.ends for placed in self.effects if placed.ends), None)
        # Pieces of one record share their forces, so that they can be integrated as one.
        shared: dict[tuple[object, ...], list[Force]] = {}
        for number, samples in enumerate(data):
            seen = samples if ends is None else replace(samples, ends=ends)
            pasts = [placed.past[min(number, len(placed.past) - 1)] for placed in self.effects if placed.past]
            kind = (samples.sites, samples.is_complex, *map(id, pasts))
            if kind not in shared:
                shared[kind] = self.forces(samples.sites, samples.is_complex, number)
            forces = shared[kind]
            weights = np.stack([np.ones(samples.sites) if one.weights is None else one.weights for one in forces])
            for placed in self.effects:
                scale = placed.scales(samples.sites)
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
        psi_errors: standard errors of the parameters of each effect, by name.
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
        own = (len(one.free) if one.effective is None else one.effective for one in self.model.effects)
        return self.solution.parameters + sum(own)

    def gain(self, simpler: Fitted) -> float:
        """Return twice the log of the likelihood ratio to a simpler model, the noise's sizes being fitted too.

        The count of numbers is lessened by that of the parameters, so that for a model that lacks nothing it is
        distributed as chi squared.
        """
        spare = max(1 - self.parameters / self.count, 0.05)
        pairs = zip(self.solution.counts, self.solution.misfit, simpler.solution.misfit, strict=True)
        return float(sum(n * spare * np.log(max(b, 1e-300) / max(a, 1e-300)) for n, a, b in pairs if n))

    def curves(self) -> Iterator[tuple[Float[ndarray, " time"], Float[ndarray, "time order parts sites"]]]:
        """Return times, and u and v of every site at them, for each trajectory."""
        state = self.solution.state
        for record, nodes, splines in zip(self.records, state.nodes, state.splines, strict=True):
            yield record.times, whole_field(record, nodes, splines)

    def residuals(self) -> list[Float[ndarray, "time levels parts sites"]]:
        """Return what is left of the readings, 0 where nothing was seen."""
        found = []
        for record, nodes, splines in zip(
            self.records, self.solution.state.nodes, self.solution.state.splines, strict=True
        ):
            whole = whole_field(record, nodes, splines)[:, : record.value.shape[1]]
            found.append(np.where(record.seen, record.value - whole, 0.0))
        return found


def whole_field(record: Record, nodes: ndarray, splines: ndarray | None) -> Float[ndarray, "time order parts sites"]:
    """Return u and v of every site at the sample times."""
    dynamics = record.stretches.dynamics
    return dynamics.whole(nodes, record.stretches.driven(record.times, splines))


def rates(record: Record, state: State, number: int) -> Float[ndarray, "time order parts sites"]:
    """Return du/dt and, for order 2, dv/dt of every site at the sample times; 0 at sites without an equation."""
    stretches = record.stretches
    dynamics = stretches.dynamics
    nodes, splines = state.nodes[number], state.splines[number]
    f = None if stretches.inputs is None else stretches.inputs(record.times)
    driven = stretches.driven(record.times, splines)
    rate = dynamics.linear(state.coefficients, record.times, nodes, f, driven, derivatives=False)[0]
    return dynamics.whole(rate, None)


def strengths(fitted: Fitted) -> Float[ndarray, " terms"]:
    """Return the RMS of each term, times its coefficient, along the fitted motion (terms,)."""
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
    """Return the angular frequency that motions have on the whole.

    This is the RMS of du/dt over that of u about its mean at each site.
    """
    speed, size = 0.0, 0.0
    for times, states in curves:
        rate = states[:, 1] if states.shape[1] > 1 else np.gradient(states[:, 0], times, axis=0)
        speed += float(np.sum(rate**2))
        size += float(np.sum((states[:, 0] - np.mean(states[:, 0], axis=0)) ** 2))
    return float(np.sqrt(speed / size)) if size > 0 else 0.0


def without(fitted: Fitted, number: int) -> Fitted:
    """Return a fit without the effect of this number in its model and state; nothing is fitted again."""
    samples = fitted.data[0]
    counts = [len(placed.forces(samples.sites, samples.is_complex)) for placed in fitted.model.effects]
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
    """Return the fit of a model from a blind start, or from coefficients that another method found.

    Raises:
        InputError: the samples do not suffice for a start.
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
    """Return trajectories cut into pieces of at most so many samples, each with an initial state of its own.

    A model that is far off can follow the readings for a short time only; in pieces, what it lacks shows as a force.
    """
    pieces: list[Samples] = []
    for samples in data:
        count = -(-len(samples.t) // longest)
        rows = np.array_split(np.arange(len(samples.t)), count)
        pieces += [rows_of(samples, int(some[0]), int(some[-1]) + 1) for some in rows]
    return pieces


def rows_of(samples: Samples, begin: int, end: int) -> Samples:
    """Return the samples of some rows."""

    def part(field: ndarray | None) -> ndarray | None:
        return None if field is None else field[begin:end]

    u = part(samples.u)
    assert u is not None
    return replace(samples, t=samples.t[begin:end], u=u, v=part(samples.v), f=part(samples.f))


def carried(fitted: Fitted, data: Sequence[Samples]) -> State:
    """Return a fit's state as the start of a fit to the same samples cut otherwise.

    Drives at unknown ends start anew.
    """
    state = fitted.solution.state
    sizes = [len(samples.t) for samples in data]
    if [len(nodes) for nodes in state.nodes] == sizes:
        return state
    nodes = np.split(np.concatenate(state.nodes), np.cumsum(sizes)[:-1])
    splines: list[ndarray | None] = [None] * len(nodes)
    if any(one is not None for one in state.splines):
        splines = list(guess(data, fitted.model.records(data)).splines)
    return State(state.coefficients, tuple(nodes), tuple(splines))


def corrected(model: Model, state: State, plain: Sequence[Record]) -> list[Record]:
    """Return the readings without the instrument's effects, as these are for the present states."""
    instrument = [placed for placed in model.effects if placed.effect.acts in INSTRUMENT]
    if not instrument:
        return list(plain)
    found = []
    for number, record in enumerate(plain):
        levels = record.value.shape[1]
        field = whole_field(record, state.nodes[number], state.splines[number])[:, :levels]
        rate = rates(record, state, number)[:, :levels]
        wrong = sum(placed.misreading(record.times, field, rate) for placed in instrument)
        found.append(replace(record, value=np.where(record.seen, record.value - wrong, 0.0)))
    return found


def refit(model: Model, data: Sequence[Samples], start: State, *, steps: int = 20, tolerance: float = 0.02) -> Fitted:
    """Return the fit of a model from known states, its parameters psi kept.

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
