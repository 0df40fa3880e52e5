"""How a motion depends on where it starts and on its coefficients: variational equations along a chain.

The state y of a lattice (see `latticebench.methods.engine.dynamics`) obeys dy/dt = F(t, y; xi), where F is linear in
the coefficients xi. The derivatives of the end of a stretch of motion by its start and by the coefficients follow from

    d/dt (dy/dy0) = (dF/dy) (dy/dy0),   d/dt (dy/dxi_j) = (dF/dy) (dy/dxi_j) + dF/dxi_j

(Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, section I.14). The integrator is the Runge-Kutta
method of order 8 of Dormand and Prince (the same book, section II.5), with steps of equal length inside a stretch.

All stretches between sample times are integrated side by side. In a short stretch a site is influenced by near
neighbours only. Sites far apart are then disturbed together and their effects are separated afterwards (Curtis, Powell
& Reid, IMA J. Appl. Math. 13, 117 (1974)), so that the cost per site does not grow with the length of the chain.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.systems.compiler import Slot

if TYPE_CHECKING:
    import scipy.sparse
    from jaxtyping import Float, Int
    from numpy import ndarray

Input = Callable[["ndarray"], "ndarray"]

# Numbers of one stage that are worked on at a time: fewer cost calls, more leave the processor's cache.
CHUNK = 200_000
MAX_SUBSTEPS = 256
# Inputs are evaluated in this part of a step.
INSIDE = 1 - 1e-9
# The largest share of a disturbance that may be left beyond its reach.
TAIL = 1e-9
# Where terms read more places than this of each part, all sites are taken to couple: one product of matrices is faster.
WIDE = 8


@dataclass(frozen=True, eq=False)
class Transition:
    """The ends of K stretches of motion, with their derivatives; the rows of a derivative stand for what is varied.

    Attributes:
        end: states at the ends (K, S).
        by_state: d end / d start, (K, S, S), or one sparse (S, S) matrix per stretch for long chains.
        by_coefficient: d end / d xi and, after these, by the numbers of resonators (K, P, S).
        by_drive: d end / d (coefficients of the B-splines that are not zero in the stretch), (K, components * Q, S).
        first: the first of those Q B-splines (K,).
    """

    end: Float[ndarray, "stretch state"]
    by_state: Float[ndarray, "stretch state state"] | Sequence[scipy.sparse.csr_array]
    by_coefficient: Float[ndarray, "stretch terms state"]
    by_drive: Float[ndarray, "stretch driven state"] | None = None
    first: Int[ndarray, " stretch"] | None = None


@dataclass(frozen=True, eq=False)
class Stretches:
    """K stretches of motion, from `begin` to `end`, with what acts on them from outside.

    Attributes:
        dynamics: the equation.
        begin, end: times (K,).
        inputs: function that maps times (B,) to the measured input f (B, N), or None.
        drive: B-splines that the sites without an equation follow, or None where every site has one.
        held: whether the drive is known, so that nothing is derived by it.
        integrator: the Runge-Kutta method of order 8 with 12 stages, or the one of order 5 with 6, both of Dormand and
            Prince; the latter is faster where the samples are dense.
    """

    dynamics: Dynamics
    begin: Float[ndarray, " stretch"]
    end: Float[ndarray, " stretch"]
    inputs: Input | None = None
    drive: BSplines | None = None
    held: bool = False
    integrator: Literal["dop853", "rk45"] = "dop853"

    def joins(self, other: Stretches) -> bool:
        """Whether both can be integrated as one: they follow one equation, without inputs or a drive."""
        one, two = self.dynamics, other.dynamics
        outside = (self.inputs, self.drive, other.inputs, other.drive)
        same = ("terms", "order", "is_complex", "sites", "ends", "least_reach", "rest", "factors", "resonators")
        return (
            all(given is None for given in outside)
            and all(getattr(one, name) == getattr(two, name) for name in same)
            and np.array_equal(1.0 if one.weights is None else one.weights, 1.0 if two.weights is None else two.weights)
        )

    @functools.cached_property
    def _active(self) -> tuple[ndarray, int]:
        """The first B-spline that is not zero in each stretch, and how many there are in a stretch at most."""
        assert self.drive is not None
        first = self.drive.basis(self.begin)[0]
        last = self.drive.basis(self.end)[0] + self.drive.degree
        width = min(int(np.max(last - first)) + 1, self.drive.count)
        return np.minimum(first, self.drive.count - width), width

    def driven(self, t: Float[ndarray, " batch"], splines: ndarray | None) -> ndarray | None:
        """Return u and, for order 2, v of the sites without an equation: (B, order, parts, border).

        Args:
            t: times (B,).
            splines: coefficients of the B-splines (m, parts, border).
        """
        if self.drive is None or splines is None:
            return None
        curve = self.drive.curve(splines)
        return np.stack([curve(t, derivative) for derivative in range(self.dynamics.order)], axis=1)

    def run(
        self,
        coefficients: Float[ndarray, " terms"],
        start: Float[ndarray, "stretch state"],
        substeps: Int[ndarray, " stretch"],
        splines: ndarray | None = None,
    ) -> Float[ndarray, "stretch state"]:
        """Integrate each stretch in its number of steps; the end is not finite where the motion is unbounded."""
        end = np.empty_like(start)
        dynamics, coefficients = self.dynamics.acting(coefficients)
        acting = replace(self, dynamics=dynamics)
        with np.errstate(all="ignore"):
            for count in np.unique(substeps):
                chosen = np.flatnonzero(substeps == count)
                end[chosen] = acting._march(coefficients, chosen, start[chosen], None, int(count), splines)[0]
        return end

    def substeps(
        self,
        coefficients: Float[ndarray, " terms"],
        start: Float[ndarray, "stretch state"],
        tolerance: float | Float[ndarray, " state"] | Float[ndarray, "stretch state"],
        splines: ndarray | None = None,
        most: int | Int[ndarray, " stretch"] = MAX_SUBSTEPS,
        least: Int[ndarray, " stretch"] | None = None,
    ) -> Int[ndarray, " stretch"]:
        """Return how many steps each stretch needs, from `least` (1 if None) to at most `most` times as many.

        Steps are halved until no number of the end moves by more than its tolerance.
        """
        tolerance = np.broadcast_to(tolerance, start.shape)
        needed = np.ones(len(start), dtype=int) if least is None else least.copy()
        most, times = np.broadcast_to(most, len(start)), 1
        open_ = np.flatnonzero(most > 1)
        coarse = self.run(coefficients, start, needed, splines)[open_]
        while len(open_):
            part = replace(self, begin=self.begin[open_], end=self.end[open_])
            fine = part.run(coefficients, start[open_], 2 * needed[open_], splines)
            with np.errstate(all="ignore"):
                # Shorter steps do not help where the motion is unbounded.
                lost = ~np.all(np.isfinite(fine), axis=1)
                wrong = ~np.all(np.abs(fine - coarse) <= tolerance[open_], axis=1) & ~lost
            open_, coarse = open_[wrong], fine[wrong]
            needed[open_] *= 2
            times *= 2
            more = most[open_] > times
            open_, coarse = open_[more], coarse[more]
        return needed

    def vary(
        self,
        coefficients: Float[ndarray, " terms"],
        start: Float[ndarray, "stretch state"],
        substeps: Int[ndarray, " stretch"],
        splines: ndarray | None = None,
        *,
        by_terms: bool = True,
        dense: bool = False,
    ) -> Transition:
        """Return the ends of all stretches with their derivatives by the start, the coefficients and the drive.

        Without `by_terms` the derivatives by the coefficients are left out: `by_coefficient` is (K, 0, S). With `dense`
        the derivatives by the start are an array on long chains, too.
        """
        dynamics = self.dynamics
        far = 4 * max(1, *dynamics.reach)
        while not dynamics.resonators and (colours := self._colours(far)) < dynamics.count:
            found = self.vary_in_groups(
                coefficients, start, substeps, splines, colours, far, by_terms=by_terms, dense=dense
            )
            if found is not None:
                return found
            far *= 2
        found = self.vary_in_groups(
            coefficients, start, substeps, splines, dynamics.count, dynamics.count, by_terms=by_terms
        )
        assert found is not None
        return found

    @property
    def _driving(self) -> int:
        """The columns of the drive, which come last."""
        if self.drive is None or self.held:
            return 0
        return self._active[1] * self.dynamics.parts * len(self.dynamics.border)

    def _colours(self, far: int) -> int:
        """Return how many groups keep sites of one group more than 2 `far` apart; all sites if that saves little."""
        count, wanted = self.dynamics.count, 2 * far + 1
        if self.dynamics.stencil.is_ring:
            # Round a ring the groups must close up.
            wanted = next((p for p in range(wanted, count) if count % p == 0), count)
        return wanted if 2 * wanted < count else count

    def vary_in_groups(
        self,
        coefficients: ndarray,
        start: ndarray,
        substeps: ndarray,
        splines: ndarray | None,
        colours: int,
        far: int,
        *,
        by_terms: bool = True,
        dense: bool = False,
    ) -> Transition | None:
        """Do the work of `vary` with the sites in groups, those of each disturbed together.

        Args:
            coefficients: see `vary`.
            start: see `vary`.
            substeps: see `vary`.
            splines: see `vary`.
            colours: number of groups; site n belongs to group n modulo `colours`.
            far: farthest sites, counted from the disturbed one, that are looked at.
            by_terms: see `vary`.
            dense: see `vary`.

        Returns:
            the transition, or None if a disturbance gets farther than `far` sites.
        """
        dynamics = self.dynamics
        size, count, blocks = dynamics.size, dynamics.count, dynamics.order * dynamics.parts
        states = blocks * colours + size - dynamics.read
        terms = len(dynamics.terms) + sum(one.numbers for one in dynamics.resonators) if by_terms else 0
        extra = self._driving
        seeds = self._seeds(states + terms + extra, colours)
        stretches = len(start)
        end = np.empty_like(start)
        by_state: Any = np.empty((stretches, states, size))
        by_coefficient = np.empty((stretches, terms, size))
        by_drive = np.empty((stretches, extra, size)) if extra else None
        chunk = max(1, CHUNK // seeds.size)
        with np.errstate(all="ignore"):
            for number in np.unique(substeps):
                alike = np.flatnonzero(substeps == number)
                for chosen in np.split(alike, np.arange(chunk, len(alike), chunk)):
                    varied = np.broadcast_to(seeds[:, :, None], (*seeds.shape, len(chosen)))
                    end[chosen], z = self._march(
                        coefficients, chosen, start[chosen], varied, int(number), splines, by_terms=by_terms
                    )
                    z = np.moveaxis(z, -1, 0)
                    by_state[chosen] = z[:, :states]
                    by_coefficient[chosen] = z[:, states : states + terms]
                    if by_drive is not None:
                        by_drive[chosen] = z[:, states + terms :]
        if colours < count:
            by_state = (_spread_dense if dense else _spread)(by_state, dynamics, colours, far)
            if by_state is None:
                return None
        return Transition(end, by_state, by_coefficient, by_drive, self._active[0] if extra else None)

    def _seeds(self, columns: int, colours: int) -> Float[ndarray, "columns state"]:
        """Return the derivatives at the start: one row disturbs the sites of one group in one block of the state."""
        count, blocks = self.dynamics.count, self.dynamics.order * self.dynamics.parts
        site, seeds = np.arange(count), np.zeros((columns, self.dynamics.size))
        for block in range(blocks):
            seeds[block * colours + site % colours, block * count + site] = 1.0
        for number in range(self.dynamics.size - blocks * count):
            seeds[blocks * colours + number, blocks * count + number] = 1.0
        return seeds

    def _march(
        self,
        coefficients: ndarray,
        chosen: ndarray,
        y: ndarray,
        z: ndarray | None,
        count: int,
        splines: ndarray | None,
        *,
        by_terms: bool = True,
    ) -> tuple[ndarray, Any]:
        """Take `count` steps with the states y (B, S) and, if given, their derivatives z (columns, S, B)."""
        a, b, c = self._tableau
        begin = self.begin[chosen]
        h = (self.end[chosen] - begin) / count
        slopes_y = np.empty((len(b), *y.shape))
        slopes_z = None if z is None else np.empty((len(b), *z.shape))
        for step in range(count):
            times = begin + (step + c[: len(b), None]) * h
            # Of all stages at once: on short chains each call costs more than what it does.
            curves, basis = self._at_border(times, splines, slopes=z is not None)
            for stage, t in enumerate(times):
                at_y, at_z = y, z
                if stage:
                    at_y = y + h[:, None] * _combine(a[stage, :stage], slopes_y)
                    if z is not None:
                        at_z = z + h * _combine(a[stage, :stage], slopes_z)
                # An input that is held jumps from one step to the next: each sees its own side.
                inside = begin + (step + 0.5 + INSIDE * (c[stage] - 0.5)) * h
                f = None if self.inputs is None else self.inputs(inside)
                curve = None if curves is None else curves[stage]
                rate, values, slopes = self.dynamics.linear(
                    coefficients, t, at_y, f, curve, derivatives=z is not None, step=h
                )
                slopes_y[stage] = rate
                if slopes_z is not None:
                    at = None if basis is None else basis[stage]
                    self._vary_rate(slopes_z[stage], at_z, values, slopes, at, chosen, by_terms=by_terms)
                    if self.dynamics.resonators:
                        force = np.tensordot(coefficients, values[0], 1)
                        self._vary_unread(slopes_z[stage], at_z, at_y, force, by_terms=by_terms)
            y = y + h[:, None] * _combine(b, slopes_y)
            if z is not None:
                z = z + h * _combine(b, slopes_z)
        return y, z

    def _at_border(
        self, times: Float[ndarray, "stage batch"], splines: ndarray | None, *, slopes: bool
    ) -> tuple[list[ndarray] | None, list[tuple[ndarray, ndarray, ndarray]] | None]:
        """Return the motion of the sites without an equation and, for `slopes`, the B-splines, at times of stages."""
        flat, stages = times.ravel(), len(times)
        driven = self.driven(flat, splines)
        curves = None if driven is None else list(driven.reshape(*times.shape, *driven.shape[1:]))
        if self.drive is None or self.held or not slopes:
            return curves, None
        first, value, slope = (np.split(one, stages) for one in self.drive.basis(flat))
        return curves, list(zip(first, value, slope, strict=True))

    def _vary_rate(
        self,
        out: ndarray,
        z: Any,
        values: ndarray,
        slopes: dict[tuple[int, Slot], ndarray],
        basis: tuple[ndarray, ndarray, ndarray] | None,
        chosen: ndarray,
        *,
        by_terms: bool,
    ) -> None:
        """Write d/dt of the derivatives z (columns, S, B) into `out`.

        The batch is the last axis, so that the innermost loops are long even on short chains.
        """
        dynamics = self.dynamics
        order, parts, count = dynamics.order, dynamics.parts, dynamics.count
        columns, terms = len(z), len(dynamics.terms)
        batch = len(chosen)
        unread = sum(one.numbers for one in dynamics.resonators) if by_terms else 0
        blocks = z[:, : dynamics.read].reshape(columns, order, parts, count, batch)
        field, extra = blocks, 0
        if len(dynamics.border):
            field = np.zeros((columns, order, parts, dynamics.sites, batch))
            field[..., dynamics.moving, :] = blocks
        if basis is not None:
            first, width = self._active
            border = dynamics.border
            extra = width * parts * len(border)
            at, *curves = basis
            place = at[:, None] - first[chosen][:, None] + np.arange(curves[0].shape[1])
            rows = np.arange(batch)[:, None]
            # The columns of the drive: spline coefficient, part, site.
            for part in range(parts):
                for number, site in enumerate(border):
                    column = columns - extra + (place * parts + part) * len(border) + number
                    for level in range(order):
                        field[column, level, part, site, rows] = curves[level]
        target = out[:, : dynamics.read].reshape(columns, order, parts, count, batch)
        if order == 2:
            target[:, 0] = blocks[:, 1]
        target[:, -1] = 0.0
        if len(slopes) > WIDE * parts**2 and not len(dynamics.border):
            product = self._jacobian(slopes, batch) @ np.transpose(z[:, : dynamics.read], (2, 1, 0))
            target[:, -1] = np.transpose(product, (2, 1, 0)).reshape(target[:, -1].shape)
        else:
            padded = dynamics.stencil.pad(field, after=1)
            for (part, slot), slope in slopes.items():
                window = padded[dynamics.window(slot)]
                target[:, -1, part] += (np.atleast_2d(slope).T if np.ndim(slope) else slope) * window
        if by_terms:
            own = columns - extra - unread - terms
            target[own : own + terms, -1] += np.transpose(values, (1, 0, 3, 2))

    def _vary_unread(self, out: ndarray, z: Any, y: ndarray, force: ndarray, *, by_terms: bool) -> None:
        """Write d/dt of the resonators' derivatives, and add what they do to those of their sites.

        Their states are y, and the terms push with `force` (B, M).
        """
        dynamics = self.dynamics
        first = len(z) - self._driving - sum(one.numbers for one in dynamics.resonators)
        varied = dynamics.felt(np.swapaxes(z, 0, 1), np.swapaxes(out[:, dynamics.count : dynamics.read], 0, 1))
        felt = dynamics.felt(y.T, force.T)
        for (one, place, v), change, own in zip(dynamics.beside, varied, felt, strict=True):
            swing, pushed = np.tensordot(one.slopes, change, 1)
            out[:, place], out[:, place + 1] = z[:, place + 1], swing
            out[:, v] += pushed[:, None]
            if by_terms:
                for number, (swing, pushed) in enumerate(one.by_numbers(own), first):
                    out[number, place + 1] += swing
                    out[number, v] += pushed
                first += one.numbers

    def _jacobian(self, slopes: dict[tuple[int, Slot], ndarray], batch: int) -> Float[ndarray, "batch rate state"]:
        """Return the derivatives of the highest rates (parts, sites) by the states, for sites that couple to many."""
        dynamics, sites = self.dynamics, np.arange(self.dynamics.count)
        found = np.zeros((batch, dynamics.parts, dynamics.count, dynamics.order, dynamics.parts, dynamics.count))
        for (part, slot), slope in slopes.items():
            place, factor = dynamics.stencil.neighbours(slot.vector)
            found[:, part, sites, slot.place[0], slot.place[1], place] += slope * factor
        return found.reshape(batch, dynamics.parts * dynamics.count, dynamics.read)

    @functools.cached_property
    def _tableau(self) -> tuple[ndarray, ndarray, ndarray]:
        """The coefficients of the integrator."""
        from scipy.integrate import DOP853, RK45

        method = DOP853 if self.integrator == "dop853" else RK45
        return method.A, method.B, method.C


def _combine(weights: ndarray, slopes: ndarray | None) -> ndarray:
    """Return the weighted sum of the slopes of the first stages."""
    assert slopes is not None
    used = slopes[: len(weights)]
    return np.asarray((weights @ used.reshape(len(weights), -1)).reshape(used.shape[1:]))


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Derivatives of sites by sites of their neighbourhood.

    Attributes:
        entries: (pair, stretch, block of the start, block of the end).
        source, target: the sites of each pair.
    """

    entries: ndarray
    source: ndarray
    target: ndarray

    @classmethod
    def of(cls, grouped: ndarray, dynamics: Dynamics, colours: int, far: int) -> _Pairs | None:
        """Separate the sites of each group; None where the effects of two sites overlap."""
        count, blocks = dynamics.count, dynamics.order * dynamics.parts
        ring = dynamics.stencil.is_ring
        site = np.arange(count)
        offset = np.arange(-far, far + 1)
        source = site[:, None] + offset
        inside = np.ones(source.shape, dtype=bool) if ring else (source >= 0) & (source < count)
        target = np.broadcast_to(site[:, None], source.shape)[inside]
        source = (source % count)[inside]
        edge = np.abs(np.broadcast_to(offset, inside.shape)[inside]) == far
        shaped = grouped.reshape(len(grouped), blocks, colours, blocks, count)
        # NumPy puts the axis of the paired indices first.
        entries = shaped[:, :, source % colours, :, target]
        if np.any(edge) and np.max(np.abs(entries[edge]), initial=0.0) > TAIL * np.max(np.abs(entries)):
            return None
        return cls(entries, source, target)


def _spread(grouped: ndarray, dynamics: Dynamics, colours: int, far: int) -> list[scipy.sparse.csr_array] | None:
    """Return one sparse (S, S) matrix per stretch, with rows for the start; None where effects overlap."""
    import scipy.sparse

    pairs = _Pairs.of(grouped, dynamics, colours, far)
    if pairs is None:
        return None
    count, blocks = dynamics.count, dynamics.order * dynamics.parts
    into, out = np.meshgrid(np.arange(blocks), np.arange(blocks), indexing="ij")
    rows = (into[None] * count + pairs.source[:, None, None]).ravel()
    columns = (out[None] * count + pairs.target[:, None, None]).ravel()
    # All stretches have their entries in the same places, which are sorted once.
    order = np.lexsort((columns, rows))
    indices = columns[order].astype(np.int32)
    pointers = np.searchsorted(rows[order], np.arange(dynamics.size + 1)).astype(np.int32)
    entries = np.moveaxis(pairs.entries, 1, 0).reshape(len(grouped), -1)[:, order]
    shape = (dynamics.size, dynamics.size)
    return [scipy.sparse.csr_array((one, indices, pointers), shape=shape) for one in entries]


def _spread_dense(grouped: ndarray, dynamics: Dynamics, colours: int, far: int) -> ndarray | None:
    """Return the (K, S, S) derivatives of the ends by the start; None where effects overlap."""
    pairs = _Pairs.of(grouped, dynamics, colours, far)
    if pairs is None:
        return None
    count, blocks = dynamics.count, dynamics.order * dynamics.parts
    found = np.zeros((len(grouped), blocks, count, blocks, count))
    found[:, :, pairs.source, :, pairs.target] = pairs.entries
    return found.reshape(len(grouped), dynamics.size, dynamics.size)
