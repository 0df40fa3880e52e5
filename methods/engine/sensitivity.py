"""How a motion depends on where it starts and on its coefficients: variational equations along a chain.

The state y of a lattice (see `latticebench.methods.engine.dynamics`) and its derivatives (see
`latticebench.methods.engine.variational`) are integrated by a Runge-Kutta method of Dormand and Prince (Hairer, Norsett
& Wanner, Solving Ordinary Differential Equations I, section II.5), with steps of equal length inside a stretch.

All stretches between sample times are integrated side by side. In a short stretch a site is influenced by near
neighbours only. Sites far apart are then disturbed together and their effects are separated afterwards (see
`latticebench.methods.engine.colouring`), so that the cost per site does not grow with the length of the chain.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.engine.colouring import spread, spread_dense
from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.engine.variational import Outside, Rates

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
        acting, rates = replace(self, dynamics=dynamics), Rates(dynamics, coefficients, by_terms=False, driving=0)
        with np.errstate(all="ignore"):
            for count in np.unique(substeps):
                chosen = np.flatnonzero(substeps == count)
                end[chosen] = acting._march(rates, chosen, start[chosen], None, int(count), splines)[0]
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
        extra = self._driving
        rates = Rates(dynamics, coefficients, by_terms, extra)
        terms = rates.numbers
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
                    end[chosen], z = self._march(rates, chosen, start[chosen], varied, int(number), splines)
                    z = np.moveaxis(z, -1, 0)
                    by_state[chosen] = z[:, :states]
                    by_coefficient[chosen] = z[:, states : states + terms]
                    if by_drive is not None:
                        by_drive[chosen] = z[:, states + terms :]
        if colours < count:
            by_state = (spread_dense if dense else spread)(by_state, dynamics, colours, far)
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
        rates: Rates,
        chosen: ndarray,
        y: ndarray,
        z: ndarray | None,
        count: int,
        splines: ndarray | None,
    ) -> tuple[ndarray, Any]:
        """Take `count` steps with the states y (B, S) and, if given, their derivatives z (columns, S, B)."""
        a, b, c = self._tableau
        begin = self.begin[chosen]
        h = (self.end[chosen] - begin) / count
        slopes_y = np.empty((len(b), *y.shape))
        slopes_z = None if z is None else np.empty((len(b), *z.shape))
        rubs = bool(self.dynamics.rubbing)
        # Where there is dry friction, the motion is looked ahead to the middle of each step.
        shares = np.append(c[: len(b)], 0.5) if rubs else c[: len(b)]
        for step in range(count):
            outside = self._outside(chosen, h, step, shares[:, None], splines, slopes=z is not None)
            rubbed = rates.rubbed(h, y, z, outside[0], outside[-1]) if rubs else None
            for stage, at in enumerate(outside[: len(b)]):
                at_y, at_z = y, z
                if stage:
                    at_y = y + h[:, None] * _combine(a[stage, :stage], slopes_y)
                    if z is not None:
                        at_z = z + h * _combine(a[stage, :stage], slopes_z)
                sliding = () if rubbed is None else rubbed.at(c[stage])
                slopes_y[stage] = rates.at(at, at_y, at_z, None if slopes_z is None else slopes_z[stage], *sliding)
            y = y + h[:, None] * _combine(b, slopes_y)
            if z is not None:
                z = z + h * _combine(b, slopes_z)
        return y, z

    def _outside(
        self, chosen: ndarray, h: ndarray, step: int, shares: ndarray, splines: ndarray | None, *, slopes: bool
    ) -> list[Outside]:
        """Return what acts from outside at shares (stages, 1) of a step; for `slopes` with the border's B-splines."""
        begin = self.begin[chosen]
        times = begin + (step + shares) * h
        # Of all stages at once: on short chains each call costs more than what it does.
        flat, stages = times.ravel(), len(times)
        driven = self.driven(flat, splines)
        curves = [None] * stages if driven is None else list(driven.reshape(*times.shape, *driven.shape[1:]))
        # An input that is held jumps from one step to the next: each sees its own side.
        inside = begin + (step + 0.5 + INSIDE * (shares - 0.5)) * h
        inputs = [None if self.inputs is None else self.inputs(one) for one in inside]
        basis: list[Any] = [None] * stages
        if self.drive is not None and not self.held and slopes:
            first, value, slope = (np.split(one, stages) for one in self.drive.basis(flat))
            within = self._active[0][chosen, None] - np.arange(value[0].shape[1])
            basis = [(at[:, None] - within, *known) for at, *known in zip(first, value, slope, strict=True)]
        return [Outside(*one) for one in zip(times, inputs, curves, basis, strict=True)]

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
