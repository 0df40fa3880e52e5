"""How a fitted model's readings would answer to anything that might be added to it, to first order.

Along a fitted trajectory a small extra force s(t) on the equation moves the state by z, with

    dz/dt = (dF/dy) z + B s(t),   z(0) = 0

(B puts a force into the highest derivative). The flow's derivatives come from `methods.engine.sensitivity`, on a grid
that has an even number of steps between two samples; Simpson's rule takes the integral of the force. What the start of
each trajectory, the drive at unknown ends and the coefficients already in the model can absorb is projected out: what
is left of a column is what the data can say about it. All rows are in units of the noise.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis.model import ACCURACY, Fitted, rates
from latticebench.diagnosis.placed import Force, read_term
from latticebench.methods.engine.record import Record
from latticebench.methods.engine.sensitivity import Stretches, Transition
from latticebench.methods.engine.shooting import tolerances
from latticebench.systems.stencil import Ends, evaluate
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Steps between two samples where one Runge-Kutta step was enough, and at most.
FINE = 2
FINEST = 8
# A column that keeps less than this of its length has nothing of its own to say.
VISIBLE = 1e-5


@dataclass(frozen=True, eq=False)
class Path:
    """One fitted trajectory on a fine grid, with the derivatives of its flow.

    Attributes:
        record: its samples.
        times: fine grid (F,), every `steps`-th of them a sample time.
        steps: fine intervals between samples.
        field: u and, for order 2, v at every site on the fine grid (F, order, parts, N).
        pairs: derivative of the state over two fine intervals (F // 2, S, S), rows the start.
        late: the same over the second of the two.
        weight: one over the noise of each number of a reading, 0 where it was not seen (T, levels, parts, N).
        own: orthonormal columns of what the start and the drive can do (rows, own).
        force: measured input on the fine grid (F, N), or None.
    """

    record: Record
    times: Float[ndarray, " fine"]
    steps: int
    field: Float[ndarray, "fine order parts sites"]
    pairs: Float[ndarray, "pair state state"]
    late: Float[ndarray, "pair state state"]
    weight: Float[ndarray, "time levels parts sites"]
    own: Float[ndarray, "rows own"]
    force: Float[ndarray, "fine sites"] | None

    @property
    def is_complex(self) -> bool:
        """Whether the field is complex."""
        return self.record.stretches.dynamics.is_complex

    def fields(self) -> tuple[ndarray, ndarray | None]:
        """Return u and v (None for order 1) on the fine grid, (F, N) each."""
        whole = self.field[:, :, 0] + 1j * self.field[:, :, 1] if self.is_complex else self.field[:, :, 0]
        return whole[:, 0], (whole[:, 1] if whole.shape[1] > 1 else None)

    def sources(self, terms: Sequence[Term], ends: Ends | None = None) -> Float[ndarray, "terms fine parts sites"]:
        """Return terms along the path at the sites that have an equation; 0 where their stencil is not whole."""
        dynamics = self.record.stretches.dynamics
        u, v = self.fields()
        ends = ends or dynamics.ends
        reach = max(t.reach[0] for t in terms), max(t.reach[1] for t in terms)
        values = evaluate(terms, u, v, self.force, self.times, ends=ends, reach=reach)
        sites = np.zeros((len(terms), len(self.times), dynamics.parts, dynamics.sites))
        inside = slice(reach[0], dynamics.sites - reach[1]) if ends == "unknown" else slice(0, dynamics.sites)
        sites[..., inside] = np.moveaxis(values, 0, 2)
        return sites[..., dynamics.moving]

    def turning(self) -> Float[ndarray, "fine parts sites"]:
        """Return the mean of sign(v) over what v may be: erf(v / (sqrt(2) s)).

        The noise s on v is that of u over a step where v is not observed. Where a site turns round or is at rest, it is
        unknown which way friction acts.
        """
        from scipy.special import erf

        noise = [1 / float(np.max(self.weight[:, level], initial=1e-300)) for level in range(self.weight.shape[1])]
        spread = noise[1] if len(noise) > 1 else noise[0] / float(np.mean(np.diff(self.record.times)))
        v = self.field[:, 1][..., self.record.stretches.dynamics.moving]
        return np.asarray(erf(v / (np.sqrt(2) * spread)))

    def answer(self, source: Float[ndarray, "columns fine parts sites"]) -> Float[ndarray, "rows columns"]:
        """Return what forces do to the readings, in units of the noise, one column each."""
        dynamics = self.record.stretches.dynamics
        size = dynamics.size
        columns = len(source)
        kick = np.zeros((len(self.times), columns, size))
        kick[..., size - dynamics.parts * dynamics.count :] = np.moveaxis(source, 0, 1).reshape(
            len(self.times), columns, -1
        )
        h = np.diff(self.times)[::2, None, None]
        gain = h / 3 * (kick[:-1:2] @ self.pairs + 4 * (kick[1::2] @ self.late) + kick[2::2])
        z = np.zeros((len(self.pairs) + 1, columns, size))
        for k, through in enumerate(self.pairs):
            z[k + 1] = z[k] @ through + gain[k]
        return self.readings(z[:: self.steps // 2])

    def readings(self, z: Float[ndarray, "time columns state"]) -> Float[ndarray, "rows columns"]:
        """Return what was seen of shifts of the state, in units of the noise."""
        dynamics = self.record.stretches.dynamics
        whole = dynamics.whole(z, None)[:, :, : self.weight.shape[1]]
        return self.rows(np.moveaxis(whole, 1, 0))

    def rows(self, columns: Float[ndarray, "columns time levels parts sites"]) -> Float[ndarray, "rows columns"]:
        """Return arrays in the shape of the readings as columns: what was seen, in units of the noise."""
        seen = self.weight > 0
        return np.ascontiguousarray((columns * self.weight)[:, seen].T)

    def free(self, columns: Float[ndarray, "rows columns"]) -> Float[ndarray, "rows columns"]:
        """Return columns without what the start and the drive can do."""
        return np.asarray(columns - self.own @ (self.own.T @ columns))


@dataclass(frozen=True, eq=False)
class Tangent:
    """A fitted model's paths, what they leave, and what its own parameters can absorb.

    Attributes:
        fitted: the model.
        paths: one per trajectory.
        residual: what is left of the readings (rows,), in units of the noise, free of what the model can do.
        raw: the same before the model's own parameters were taken off; they differ as far as the fit is not at its
            optimum.
        known: orthonormal columns of what the model's coefficients and psi can do (rows, known).
        jacobian: the same before that: each parameter's own column (rows, parameters), coefficients first, then psi.
    """

    fitted: Fitted
    paths: tuple[Path, ...]
    residual: Float[ndarray, " rows"]
    raw: Float[ndarray, " rows"]
    known: Float[ndarray, "rows known"]
    jacobian: Float[ndarray, "rows parameters"]

    @property
    def spare(self) -> float:
        """Degrees of freedom of the residual."""
        return float(max(len(self.residual) - sum(path.own.shape[1] for path in self.paths) - self.known.shape[1], 1))

    def columns(self, make: Callable[[int, Path], Float[ndarray, "rows columns"]]) -> Float[ndarray, "rows columns"]:
        """Return the columns of all paths under each other, free of starts and drives."""
        return np.concatenate([path.free(make(number, path)) for number, path in enumerate(self.paths)])

    def new(self, columns: Float[ndarray, "rows columns"]) -> Float[ndarray, "rows columns"]:
        """Return columns without what the model can do already; those that it can do wholly become 0."""
        left = np.asarray(columns - self.known @ (self.known.T @ columns))
        left -= self.known @ (self.known.T @ left)
        gone = np.linalg.norm(left, axis=0) <= VISIBLE * np.linalg.norm(columns, axis=0)
        left[:, gone] = 0.0
        return left


def linearise(fitted: Fitted) -> Tangent:
    """Return the tangent of a fitted model."""
    paths = tuple(_path(fitted, number) for number in range(len(fitted.records)))
    residual = np.concatenate(
        [path.free(path.rows(left[None]))[:, 0] for path, left in zip(paths, fitted.residuals(), strict=True)]
    )
    rough = Tangent(fitted, paths, residual, residual, np.zeros((len(residual), 0)), np.zeros((len(residual), 0)))
    jacobian = np.concatenate(
        [
            rough.columns(lambda _, path: path.answer(own_forces(path))),
            rough.columns(functools.partial(by_psi, fitted)),
        ],
        axis=1,
    )
    known = orthonormal(jacobian)
    return replace(rough, known=known, jacobian=jacobian, residual=residual - known @ (known.T @ residual))


def orthonormal(columns: Float[ndarray, "rows columns"]) -> Float[ndarray, "rows rank"]:
    """Return orthonormal columns with the same span; directions that are the same to rounding count once."""
    if columns.shape[1] == 0:
        return columns
    length = np.linalg.norm(columns, axis=0)
    kept = length > 0
    if not np.any(kept):
        return columns[:, :0]
    left, values, _ = np.linalg.svd(columns[:, kept] / length[kept], full_matrices=False)
    return np.asarray(left[:, values > 1e-7 * values[0]])


def own_forces(path: Path) -> Float[ndarray, "terms fine parts sites"]:
    """Return the model's own forces along a path, without their coefficients."""
    dynamics = path.record.stretches.dynamics
    values = path.sources(dynamics.terms)
    if dynamics.weights is not None:
        values = values * dynamics.weights[:, None, None, dynamics.moving]
    for term, factor in enumerate(dynamics.factors or ()):
        if factor is not None:
            whole = np.broadcast_to(factor(path.times), (dynamics.parts, len(path.times), dynamics.sites))
            values[term] *= np.moveaxis(whole[..., dynamics.moving], 0, 1)
    return values


def by_psi(fitted: Fitted, number: int, path: Path) -> Float[ndarray, "rows psi"]:
    """Return the columns of the parameters that are not coefficients, one effect after another."""
    found = [_by_effect(fitted, place, number, path) for place in range(len(fitted.model.effects))]
    rows = int(np.sum(path.weight > 0))
    return np.concatenate([np.zeros((rows, 0)), *found], axis=1)


def _by_effect(fitted: Fitted, place: int, number: int, path: Path) -> ndarray:
    """Return the columns of one effect's psi."""
    placed = fitted.model.effects[place]
    dynamics = path.record.stretches.dynamics
    state = fitted.solution.state
    rows = int(np.sum(path.weight > 0))
    if not placed.free:
        return np.zeros((rows, 0))
    if placed.effect.acts in ("offset", "gain", "curve", "clock"):
        levels = path.weight.shape[1]
        field = path.field[:: path.steps][:, :levels]
        rate = rates(path.record, state, number)[:, :levels]
        columns = [placed.misreading_by(name, path.record.times, field, rate) for name in placed.free]
        return path.rows(np.stack(columns))
    coefficients = state.coefficients
    if placed.effect.acts == "one equation":
        assert placed.site is not None
        total = np.tensordot(coefficients, own_forces(path), (0, 0))
        mask = np.eye(dynamics.sites)[placed.site] / (1 + placed.psi["scale"])
        return path.answer((total * mask[dynamics.moving])[None])
    # Central differences of the force by each parameter; the coefficients stay.
    begin = len(fitted.model.declared.terms)
    for earlier in fitted.model.effects[:place]:
        begin += len(earlier.forces(dynamics.sites, dynamics.is_complex, number))
    sources = []
    for name in placed.free:
        value = placed.psi[name]
        step = 1e-4 * max(abs(value), 1e-3)
        sides = []
        for sign in (1, -1):
            moved = placed.moved({name: value + sign * step}).forces(dynamics.sites, dynamics.is_complex, number)
            end = begin + len(moved)
            sides.append(force_along(path, moved, coefficients[begin:end]))
        sources.append((sides[0] - sides[1]) / (2 * step))
    return path.answer(np.stack(sources))


def force_along(path: Path, forces: Sequence[Force], coefficients: ndarray | None = None) -> ndarray:
    """Return forces along a path.

    Their sum (fine, parts, sites) where coefficients are given, otherwise each of them (forces, fine, parts, sites).
    """
    dynamics = path.record.stretches.dynamics
    texts = list(dict.fromkeys(force.term.text for force in forces))
    terms = [read_term(text) for text in texts]
    values = dict(zip(texts, path.sources(terms), strict=True))
    values |= {term.text: path.turning() for term in terms if term.jumps}
    found = []
    for force in forces:
        value = values[force.term.text]
        if force.weights is not None:
            value = value * force.weights[dynamics.moving]
        if force.factor is not None:
            whole = np.broadcast_to(force.factor(path.times), (dynamics.parts, len(path.times), dynamics.sites))
            value = value * np.moveaxis(whole[..., dynamics.moving], 0, 1)
        found.append(value)
    stacked = np.stack(found)
    return stacked if coefficients is None else np.tensordot(coefficients, stacked, (0, 0))


def _path(fitted: Fitted, number: int) -> Path:
    """Return one fitted trajectory on a fine grid."""
    record, state = fitted.records[number], fitted.solution.state
    stretches = record.stretches
    dynamics = stretches.dynamics
    nodes, splines = state.nodes[number], state.splines[number]
    coefficients = state.coefficients
    needed = stretches.substeps(
        coefficients, nodes[:-1], tolerances(record, fitted.sigma, ACCURACY * float(np.min(fitted.sigma))), splines
    )
    steps = min(FINE * int(np.max(needed)), FINEST)
    begin = stretches.begin[:, None] + np.diff(record.times)[:, None] * np.arange(steps) / steps
    times = np.append(begin.ravel(), record.times[-1])
    fine = replace(stretches, begin=times[:-1], end=times[1:], held=False)
    starts = np.empty((len(stretches.begin), steps, dynamics.size))
    starts[:, 0] = nodes[:-1]
    each = np.maximum(1, -(-needed // steps))
    for k in range(steps - 1):
        part = replace(stretches, begin=begin[:, k], end=begin[:, k + 1])
        starts[:, k + 1] = part.run(coefficients, starts[:, k], each, splines)
    flat = starts.reshape(-1, dynamics.size)
    varied = fine.vary(coefficients, flat, np.repeat(each, steps), splines)
    through = varied.by_state
    if isinstance(through, Sequence):
        through = np.stack([one.toarray() for one in through])
    pairs, late = through[::2] @ through[1::2], through[1::2]
    states = np.concatenate([flat, nodes[-1:]])
    field = dynamics.whole(states, fine.driven(times, splines))
    sigma = fitted.sigma
    weight = record.seen / sigma[:, None, None]
    force = fitted.data[number].forcing()(times) if fitted.data[number].f is not None else None
    path = Path(record, times, steps, field, pairs, late, weight, np.zeros((int(np.sum(record.seen)), 0)), force)
    z = np.zeros((len(pairs) + 1, dynamics.size, dynamics.size))
    z[0] = np.eye(dynamics.size)
    for k, over in enumerate(pairs):
        z[k + 1] = z[k] @ over
    own = path.readings(z[:: steps // 2])
    if fine.drive is not None and splines is not None:
        own = np.concatenate([own, _by_drive(path, fine, varied)], axis=1)
    return replace(path, own=orthonormal(own))


def _by_drive(path: Path, fine: Stretches, varied: Transition) -> ndarray:
    """Return the columns of the splines at unknown ends.

    They are what the splines do to the moving sites, and what is seen of themselves.
    """
    dynamics, drive = fine.dynamics, fine.drive
    assert drive is not None
    assert varied.by_drive is not None
    assert varied.first is not None
    border, parts = dynamics.border, dynamics.parts
    each = parts * len(border)
    width = varied.by_drive.shape[1]
    local = varied.first[:, None] * each + np.arange(width)
    z = np.zeros((len(fine.begin) + 1, drive.count * each, dynamics.size))
    through = varied.by_state
    for k in range(len(fine.begin)):
        z[k + 1] = z[k] @ through[k]
        z[k + 1, local[k]] += varied.by_drive[k]
    whole = dynamics.whole(z[:: path.steps], None)[:, :, : path.weight.shape[1]]
    times = path.record.times
    first, *curves = drive.basis(times)
    for level in range(path.weight.shape[1]):
        for offset in range(drive.degree + 1):
            for number in range(each):
                part, site = divmod(number, len(border))
                column = (first + offset) * each + number
                whole[np.arange(len(times)), column, level, part, border[site]] += curves[level][:, offset]
    return path.rows(np.moveaxis(whole, 1, 0))
