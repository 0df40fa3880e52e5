"""How a motion depends on its coefficients and on where it starts: variational equations along a chain.

With the state y of a lattice (see `Dynamics`), dy/dt = F(t, y; xi) and F linear in the coefficients xi, the derivatives of the
end of a stretch of motion by its start and by the coefficients follow from

    d/dt (dy/dy0) = (dF/dy) (dy/dy0),   d/dt (dy/dxi_j) = (dF/dy) (dy/dxi_j) + dF/dxi_j

(Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, section I.14). dF/dy comes from the term language, so that
the derivatives are exact up to the integrator's error, which is that of the Runge-Kutta formulas of Dormand and Prince of order 8
(the same book, section II.5), with steps of fixed length inside a stretch. Dry friction, sign(v), jumps where a site turns round and
holds a site that is at rest; it counts as its mean over one step (`Dynamics.linear`), so that it can be integrated and derived, and
becomes the jump as the steps get shorter.

All stretches between sample times are integrated side by side. Where a stretch is short, a site feels only its near neighbours in
it; sites far apart are then disturbed together and told apart afterwards (Curtis, Powell & Reid, IMA J. Appl. Math. 13, 117 (1974)),
so that long chains cost no more a site than short ones.

`Condensed` puts the stretches together: the least-squares problem for the start, the drive at unknown ends and the coefficients,
linearised about given states (Bock, Springer Ser. Chem. Phys. 18, 102 (1981)). Fits and the statistical bound both use it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.systems.compiler import Slot, compiled, partials
from latticebench.systems.errors import InputError
from latticebench.systems.stencil import Ends, ghosts, observed
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    import scipy.sparse
    from jaxtyping import Float, Int
    from numpy import ndarray

Input = Callable[["ndarray"], "ndarray"]
Factor = Callable[["ndarray"], "ndarray"]

# So many numbers of one stage are worked on at a time: twelve such arrays stay in the processor's cache.
CHUNK = 60_000
MAX_SUBSTEPS = 256
# Beyond the reach of a disturbance, less than this share of its largest value is left.
TAIL = 1e-9
# Least squares by orthogonal factors up to this many operations, by normal equations beyond.
MAX_QR_WORK = 6e9


@dataclass(frozen=True, eq=False)
class Drive:
    """The motion of the sites at unknown ends, which have no equation: a B-spline in time for each.

    Attributes:
        knots: B-spline knots, those at both ends repeated degree + 1 times.
        degree: of the polynomials.
    """

    knots: Float[ndarray, " knots"]
    degree: int

    @property
    def count(self) -> int:
        """The number m of B-splines."""
        return len(self.knots) - self.degree - 1

    def basis(
        self, t: Float[ndarray, " time"]
    ) -> tuple[Int[ndarray, " time"], Float[ndarray, "time local"], Float[ndarray, "time local"]]:
        """Give the index of the first B-spline that lives at each time, and the values and slopes of it and the next ones."""
        degree = self.degree
        span = np.clip(np.searchsorted(self.knots, t, side="right") - 1, degree, self.count - 1)
        # Cox and de Boor's recursion, one degree at a time; `lower` keeps the last but one for the slopes.
        value = np.ones((len(t), 1))
        lower = value
        for d in range(1, degree + 1):
            lower = value
            value = np.zeros((len(t), d + 1))
            for j in range(d):
                left = self.knots[span + j + 1 - d]
                right = self.knots[span + j + 1]
                share = lower[:, j] / (right - left)
                value[:, j] += share * (right - t)
                value[:, j + 1] += share * (t - left)
        slope = np.zeros((len(t), degree + 1))
        for j in range(degree):
            share = degree * lower[:, j] / (self.knots[span + j + 1] - self.knots[span + j + 1 - degree])
            slope[:, j] -= share
            slope[:, j + 1] += share
        return span - degree, value, slope


@dataclass(frozen=True, eq=False)
class Transition:
    """What the motion makes of its start over K stretches; the derivatives' rows are what is varied.

    Attributes:
        end: states at the ends (K, S).
        by_state: d end / d start, (K, S, S), or one sparse (S, S) matrix a stretch for long chains.
        by_coefficient: d end / d xi (K, P, S).
        by_drive: d end / d (spline coefficients that live in the stretch), (K, components * Q, S).
        first: the first of those Q spline coefficients (K,).
    """

    end: Float[ndarray, "stretch state"]
    by_state: Float[ndarray, "stretch state state"] | Sequence[scipy.sparse.csr_array]
    by_coefficient: Float[ndarray, "stretch terms state"]
    by_drive: Float[ndarray, "stretch driven state"] | None = None
    first: Int[ndarray, " stretch"] | None = None


@dataclass(frozen=True, eq=False)
class Dynamics:
    """d^order u_n / dt^order = sum_j xi_j w_jn g_jn(t) T_j on a chain, for many states at once.

    A state is [u] or [Re u, Im u] of the M sites that have an equation, for order 2 followed by the velocity likewise:
    S = order * parts * M numbers. Those are all N sites, or with unknown ends the ones whose whole stencil lies inside.

    Attributes:
        terms: T_j.
        order: 1 or 2.
        is_complex: whether u is.
        sites: N.
        ends: how the chain ends.
        weights: w_jn (terms, N), 1 everywhere when None; a row of zeros with a single 1 makes a term of one site.
        factors: g_jn, one a term or None for 1: gives at times (B,) an array that broadcasts to (parts, B, N), so that
            T_j = 1 (1+i for a complex field) with a factor is any known force.
        least_reach: the stencil is at least this wide, so that equations with different terms leave the same sites without
            an equation at unknown ends.
    """

    terms: tuple[Term, ...]
    order: int
    is_complex: bool
    sites: int
    ends: Ends
    weights: Float[ndarray, "terms sites"] | None = None
    factors: tuple[Factor | None, ...] | None = None
    least_reach: tuple[int, int] = (0, 0)

    @functools.cached_property
    def reach(self) -> tuple[int, int]:
        """The widest stencil."""
        left, right = self.least_reach
        return max(left, *(term.reach[0] for term in self.terms)), max(right, *(term.reach[1] for term in self.terms))

    @property
    def parts(self) -> int:
        """1 for a real field, 2 for a complex one."""
        return 1 + self.is_complex

    @functools.cached_property
    def moving(self) -> slice:
        """The sites that have an equation."""
        return observed(self.sites, self.reach, self.ends)

    @functools.cached_property
    def count(self) -> int:
        """Their number M."""
        return len(range(*self.moving.indices(self.sites)))

    @property
    def size(self) -> int:
        """The length S of a state."""
        return self.order * self.parts * self.count

    @functools.cached_property
    def border(self) -> Int[ndarray, " border"]:
        """The sites that have no equation."""
        return np.setdiff1d(np.arange(self.sites), np.arange(self.sites)[self.moving])

    def pack(self, u: ndarray, v: ndarray | None) -> Float[ndarray, "time state"]:
        """Write u (T, N) and v (T, N), for order 1 left out, as states of the moving sites."""
        fields = [u] if self.order == 1 else [u, np.zeros_like(u) if v is None else v]
        blocks = [split_parts(one[:, self.moving], self.is_complex) for one in fields]
        return np.stack(blocks, axis=1).reshape(len(u), self.size)

    def linear(
        self,
        coefficients: Float[ndarray, " terms"],
        t: Float[ndarray, " batch"],
        y: Float[ndarray, "batch state"],
        f: Float[ndarray, "batch sites"] | None = None,
        driven: Float[ndarray, "batch order parts border"] | None = None,
        *,
        derivatives: bool = True,
        step: Float[ndarray, " batch"] | None = None,
    ) -> tuple[ndarray, ndarray, dict[tuple[int, Slot], ndarray]]:
        """Evaluate the right-hand side and its derivatives.

        With steps of length h the term sign(v[n]) is tanh(2 v / (h b)), b the larger of the acceleration by all other terms and
        of the friction's own: about its mean over the step in which the site turns round, and where the site is at rest a
        friction that stops it within a step and holds it against any smaller acceleration (as in Moreau's time stepping,
        Nonsmooth Mechanics and Applications (1988)). Derivatives are taken with b held.

        Returns:
            dy/dt (B, S); the terms' values with their weights (parts, terms, B, M); and for each part and variable of the
            stencil the derivative of the highest time derivative (B, M), empty without `derivatives`.
        """
        windows = self._windows(y, t, f, driven)
        bundle = self._values
        shape = (len(t), self.count)
        values = np.empty((self.parts, len(self.terms), *shape))
        flat = values.reshape(-1, *shape)
        for k, value in enumerate(bundle.function(*(windows(slot) for slot in bundle.slots))):
            flat[k] = value
        if self.weights is not None:
            values *= self.weights[:, None, self.moving]
        factors = self._factors(t)
        for term, factor in factors.items():
            values[:, term] *= factor
        found: dict[tuple[int, Slot], ndarray] = {}
        rate = np.empty((len(t), self.order, self.parts, self.count))
        if self.order == 2:
            rate[:, 0] = y.reshape(rate.shape)[:, 1]
        if step is not None and self._rubbing:
            found = self._softened(coefficients, values, rate[:, 0, 0], step, factors, derivatives)
        rate[:, -1] = np.moveaxis(np.tensordot(coefficients, values, (0, 1)), 0, 1)
        if derivatives:
            slopes, places = self._partials
            outputs = slopes.function(*(windows(slot) for slot in slopes.slots)) if places else ()
            for (term, part, slot), value in zip(places, outputs, strict=True):
                share = coefficients[term] * value
                if self.weights is not None:
                    share = share * self.weights[term, self.moving]
                if term in factors:
                    share = share * factors[term][part]
                found[part, slot] = found[part, slot] + share if (part, slot) in found else share
        return rate.reshape(y.shape), values, found

    @functools.cached_property
    def _rubbing(self) -> tuple[int, ...]:
        """The terms of dry friction."""
        if self.order == 1 or self.is_complex:
            return ()
        return tuple(k for k, term in enumerate(self.terms) if term.jumps)

    def _softened(
        self,
        coefficients: ndarray,
        values: ndarray,
        v: ndarray,
        step: ndarray,
        factors: dict[int, ndarray],
        derivatives: bool,
    ) -> dict[tuple[int, Slot], ndarray]:
        """Write dry friction as its mean over a step into `values`, and give its derivative."""
        others = np.delete(np.arange(len(self.terms)), self._rubbing)
        push = np.abs(np.tensordot(coefficients[others], values[0, others], (0, 0)))
        total = np.zeros_like(v)
        for term in self._rubbing:
            size = np.ones_like(v) if self.weights is None else self.weights[term, self.moving] * np.ones_like(v)
            if term in factors:
                size = size * factors[term][0]
            width = np.maximum(
                step[:, None] / 2 * np.maximum(push, np.abs(coefficients[term] * size)), np.finfo(float).tiny
            )
            soft = np.tanh(v / width)
            values[0, term] = size * soft
            if derivatives:
                total += coefficients[term] * size * (1 - soft**2) / width
        return {(0, Slot("v", 0, "re")): total} if derivatives else {}

    def _factors(self, t: ndarray) -> dict[int, ndarray]:
        """Evaluate the factors at the sites that have an equation, each (parts, B, M)."""
        found = {}
        for term, factor in enumerate(self.factors or ()):
            if factor is not None:
                whole = np.broadcast_to(factor(t), (self.parts, len(t), self.sites))
                found[term] = whole[..., self.moving]
        return found

    @functools.cached_property
    def _values(self) -> Any:
        return compiled(tuple(term.text for term in self.terms), self.is_complex)

    @functools.cached_property
    def _partials(self) -> Any:
        return partials(tuple(term.text for term in self.terms), self.is_complex)

    @functools.cached_property
    def _pad(self) -> tuple[ndarray, ndarray | None]:
        index, factor = ghosts(self.sites, *self.reach, self.ends)
        return index, None if np.all(factor == 1) else factor

    def padded(self, field: ndarray) -> ndarray:
        """Add to the last axis, the N sites, what the ends repeat."""
        index, factor = self._pad
        if self.ends != "unknown":
            field = np.take(field, index, axis=-1)
        return field if factor is None else field * factor

    def whole(self, y: ndarray, driven: ndarray | None) -> ndarray:
        """Put the sites without an equation beside the others: (..., order, parts, N)."""
        blocks = y.reshape(*y.shape[:-1], self.order, self.parts, self.count)
        if len(self.border) == 0:
            return blocks
        left = self.reach[0]
        whole = np.zeros((*blocks.shape[:-1], self.sites))
        whole[..., self.moving] = blocks
        if driven is not None:
            whole[..., :left] = driven[..., :left]
            whole[..., self.moving.stop :] = driven[..., left:]
        return whole

    def _windows(self, y: ndarray, t: ndarray, f: ndarray | None, driven: ndarray | None) -> Callable[[Slot], Any]:
        fields = self.padded(self.whole(y, driven))
        force = None if f is None else self.padded(f)
        n = (np.arange(self.sites) - (self.sites - 1) / 2)[self.moving]

        def window(slot: Slot) -> Any:
            first = self.reach[0] + slot.offset
            if slot.name == "t":
                return t[:, None]
            if slot.name == "n":
                return n
            if slot.name == "f":
                if force is None:
                    raise InputError("the terms use f[n], but there is no measured input")
                return force[:, first : first + self.count]
            return fields[:, int(slot.name == "v"), int(slot.part == "im"), first : first + self.count]

        return window


def split_parts(field: ndarray, is_complex: bool) -> Float[ndarray, "time parts sites"]:
    """Write a field (T, N) as its real and, for a complex one, imaginary part."""
    return np.stack([field.real, field.imag] if is_complex else [field], axis=1).astype(float)


# One stretch after another, side by side -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Stretches:
    """K stretches of motion, from `begin` to `end`, with what acts on them from outside.

    Attributes:
        dynamics: the equation.
        begin, end: times (K,).
        inputs: gives f (B, N) at times (B,), or None.
        drive: the splines of the sites at unknown ends, or None where every site has an equation.
        held: the drive is known and nothing is derived by it.
    """

    dynamics: Dynamics
    begin: Float[ndarray, " stretch"]
    end: Float[ndarray, " stretch"]
    inputs: Input | None = None
    drive: Drive | None = None
    held: bool = False

    def joins(self, other: Stretches) -> bool:
        """Say whether both follow the same equation, without inputs or a drive of their own, so that they can be integrated as one."""
        one, two = self.dynamics, other.dynamics
        outside = (self.inputs, self.drive, other.inputs, other.drive)
        same = ("terms", "order", "is_complex", "sites", "ends", "least_reach", "factors")
        return (
            all(given is None for given in outside)
            and all(getattr(one, name) == getattr(two, name) for name in same)
            and np.array_equal(1.0 if one.weights is None else one.weights, 1.0 if two.weights is None else two.weights)
        )

    @functools.cached_property
    def _active(self) -> tuple[ndarray, int]:
        """The first B-spline of each stretch, and how many live in a stretch at most."""
        assert self.drive is not None
        first = self.drive.basis(self.begin)[0]
        last = self.drive.basis(self.end)[0] + self.drive.degree
        width = min(int(np.max(last - first)) + 1, self.drive.count)
        return np.minimum(first, self.drive.count - width), width

    def driven(self, t: Float[ndarray, " batch"], splines: ndarray | None) -> ndarray | None:
        """Give u and, for order 2, v of the sites without an equation: (B, order, parts, border).

        `splines` are the B-splines' coefficients (m, parts, border).
        """
        if self.drive is None or splines is None:
            return None
        first, *curves = self.drive.basis(t)
        local = splines[first[:, None] + np.arange(self.drive.degree + 1)]
        return np.stack([np.einsum("bl,blps->bps", curve, local) for curve in curves[: self.dynamics.order]], axis=1)

    def run(
        self,
        coefficients: Float[ndarray, " terms"],
        start: Float[ndarray, "stretch state"],
        substeps: Int[ndarray, " stretch"],
        splines: ndarray | None = None,
    ) -> Float[ndarray, "stretch state"]:
        """Integrate the states alone, each stretch in its number of steps; not finite where the motion is unbounded."""
        end = np.empty_like(start)
        with np.errstate(all="ignore"):
            for count in np.unique(substeps):
                chosen = np.flatnonzero(substeps == count)
                end[chosen] = self._march(coefficients, chosen, start[chosen], None, int(count), splines)[0]
        return end

    def substeps(
        self,
        coefficients: Float[ndarray, " terms"],
        start: Float[ndarray, "stretch state"],
        tolerance: float | Float[ndarray, " state"] | Float[ndarray, "stretch state"],
        splines: ndarray | None = None,
    ) -> Int[ndarray, " stretch"]:
        """Find how many steps each stretch needs, by halving until no number of a state moves by more than its tolerance."""
        tolerance = np.broadcast_to(tolerance, start.shape)
        needed = np.ones(len(start), dtype=int)
        open_ = np.arange(len(start))
        coarse = self.run(coefficients, start, needed, splines)
        while len(open_) and needed[open_[0]] < MAX_SUBSTEPS:
            part = Stretches(self.dynamics, self.begin[open_], self.end[open_], self.inputs, self.drive)
            fine = part.run(coefficients, start[open_], 2 * needed[open_], splines)
            with np.errstate(all="ignore"):
                # Two solutions that are both unbounded do not get better by shorter steps.
                lost = ~np.all(np.isfinite(fine), axis=1)
                wrong = ~np.all(np.abs(fine - coarse) <= tolerance[open_], axis=1) & ~lost
            open_, coarse = open_[wrong], fine[wrong]
            needed[open_] *= 2
        return needed

    def vary(
        self,
        coefficients: Float[ndarray, " terms"],
        start: Float[ndarray, "stretch state"],
        substeps: Int[ndarray, " stretch"],
        splines: ndarray | None = None,
    ) -> Transition:
        """Integrate the states with their derivatives by the start, the coefficients and the drive."""
        dynamics = self.dynamics
        far = 4 * max(1, *dynamics.reach)
        while (colours := self._colours(far)) < dynamics.count:
            found = self._vary(coefficients, start, substeps, splines, colours, far)
            if found is not None:
                return found
            far *= 2
        found = self._vary(coefficients, start, substeps, splines, dynamics.count, dynamics.count)
        assert found is not None
        return found

    def _colours(self, far: int) -> int:
        """How many groups of sites keep the sites of a group more than 2 far apart; all sites where that saves little."""
        count, wanted = self.dynamics.count, 2 * far + 1
        if self.dynamics.ends in ("periodic", "antiperiodic"):
            # Round a ring the groups must close up.
            wanted = next((p for p in range(wanted, count) if count % p == 0), count)
        return wanted if 2 * wanted < count else count

    def _vary(
        self,
        coefficients: ndarray,
        start: ndarray,
        substeps: ndarray,
        splines: ndarray | None,
        colours: int,
        far: int,
    ) -> Transition | None:
        """Disturb each group of sites at once; None where a disturbance got farther than `far` sites."""
        dynamics = self.dynamics
        size, count, blocks = dynamics.size, dynamics.count, dynamics.order * dynamics.parts
        states = blocks * colours
        terms = len(dynamics.terms)
        extra = 0
        if self.drive is not None and not self.held:
            extra = self._active[1] * dynamics.parts * len(dynamics.border)
        seeds = np.zeros((states + terms + extra, size))
        for block in range(blocks):
            seeds[block * colours + np.arange(count) % colours, block * count + np.arange(count)] = 1.0
        stretches = len(start)
        end = np.empty_like(start)
        dense = colours == count
        by_state: Any = np.empty((stretches, states, size))
        by_coefficient = np.empty((stretches, terms, size))
        by_drive = np.empty((stretches, extra, size)) if extra else None
        chunk = max(1, CHUNK // seeds.size)
        with np.errstate(all="ignore"):
            for number in np.unique(substeps):
                alike = np.flatnonzero(substeps == number)
                for chosen in np.split(alike, np.arange(chunk, len(alike), chunk)):
                    varied = np.broadcast_to(seeds, (len(chosen), *seeds.shape))
                    end[chosen], z = self._march(coefficients, chosen, start[chosen], varied, int(number), splines)
                    by_state[chosen] = z[:, :states]
                    by_coefficient[chosen] = z[:, states : states + terms]
                    if by_drive is not None:
                        by_drive[chosen] = z[:, states + terms :]
        if not dense:
            by_state = _spread(by_state, dynamics, colours, far)
            if by_state is None:
                return None
        return Transition(end, by_state, by_coefficient, by_drive, self._active[0] if extra else None)

    def _march(
        self,
        coefficients: ndarray,
        chosen: ndarray,
        y: ndarray,
        z: ndarray | None,
        count: int,
        splines: ndarray | None,
    ) -> tuple[ndarray, Any]:
        """Take `count` Runge-Kutta steps with the states y (B, S) and, where given, their derivatives z (B, columns, S)."""
        from scipy.integrate import DOP853

        a, b, c = DOP853.A, DOP853.B, DOP853.C
        begin = self.begin[chosen]
        h = (self.end[chosen] - begin) / count
        slopes_y = np.empty((len(b), *y.shape))
        slopes_z = None if z is None else np.empty((len(b), *z.shape))
        for step in range(count):
            for stage in range(len(b)):
                t = begin + (step + c[stage]) * h
                at_y, at_z = y, z
                if stage:
                    at_y = y + h[:, None] * _combine(a[stage, :stage], slopes_y)
                    if z is not None:
                        at_z = z + h[:, None, None] * _combine(a[stage, :stage], slopes_z)
                f = None if self.inputs is None else self.inputs(t)
                driven = self.driven(t, splines)
                rate, values, slopes = self.dynamics.linear(
                    coefficients, t, at_y, f, driven, derivatives=z is not None, step=h
                )
                slopes_y[stage] = rate
                if slopes_z is not None:
                    self._vary_rate(slopes_z[stage], at_z, values, slopes, t, chosen)
            y = y + h[:, None] * _combine(b, slopes_y)
            if z is not None:
                z = z + h[:, None, None] * _combine(b, slopes_z)
        return y, z

    def _vary_rate(
        self,
        out: ndarray,
        z: Any,
        values: ndarray,
        slopes: dict[tuple[int, Slot], ndarray],
        t: ndarray,
        chosen: ndarray,
    ) -> None:
        """Write d/dt of the derivatives z (B, columns, S) into `out`."""
        dynamics = self.dynamics
        order, parts, count = dynamics.order, dynamics.parts, dynamics.count
        terms = len(dynamics.terms)
        field = dynamics.whole(z, None)
        extra = 0
        if self.drive is not None and not self.held:
            first, width = self._active
            border = dynamics.border
            extra = width * parts * len(border)
            at, *curves = self.drive.basis(t)
            place = at[:, None] - first[chosen][:, None] + np.arange(self.drive.degree + 1)
            rows = np.arange(len(t))[:, None]
            # The columns of the drive: spline coefficient, part, site.
            for part in range(parts):
                for number, site in enumerate(border):
                    column = z.shape[1] - extra + (place * parts + part) * len(border) + number
                    for level in range(order):
                        field[rows, column, level, part, site] = curves[level]
        padded = dynamics.padded(field)
        target = out.reshape(*z.shape[:2], order, parts, count)
        if order == 2:
            target[:, :, 0] = z.reshape(target.shape)[:, :, 1]
        target[:, :, -1] = 0.0
        for (part, slot), slope in slopes.items():
            begin = dynamics.reach[0] + slot.offset
            window = padded[:, :, int(slot.name == "v"), int(slot.part == "im"), begin : begin + count]
            target[:, :, -1, part] += (slope[:, None, :] if np.ndim(slope) == 2 else slope) * window
        own = z.shape[1] - extra - terms
        target[:, own : own + terms, -1] += np.transpose(values, (2, 1, 0, 3))


def _combine(weights: ndarray, slopes: ndarray | None) -> ndarray:
    """Add the first stages' slopes up, each with its weight."""
    assert slopes is not None
    used = slopes[: len(weights)]
    return np.asarray((weights @ used.reshape(len(weights), -1)).reshape(used.shape[1:]))


def _spread(grouped: ndarray, dynamics: Dynamics, colours: int, far: int) -> list[scipy.sparse.csr_array] | None:
    """Tell the sites of a group apart: one sparse (S, S) matrix a stretch, rows the start; None where they overlap."""
    import scipy.sparse

    count, blocks = dynamics.count, dynamics.order * dynamics.parts
    ring = dynamics.ends in ("periodic", "antiperiodic")
    site = np.arange(count)
    offset = np.arange(-far, far + 1)
    source = site[:, None] + offset
    inside = np.ones(source.shape, dtype=bool) if ring else (source >= 0) & (source < count)
    target = np.broadcast_to(site[:, None], source.shape)[inside]
    source = (source % count)[inside]
    edge = np.abs(np.broadcast_to(offset, inside.shape)[inside]) == far
    shaped = grouped.reshape(len(grouped), blocks, colours, blocks, count)
    entries = shaped[:, :, source % colours, :, target]
    # NumPy puts the axis of the paired indices first: (pair, stretch, from block, to block).
    if np.any(edge) and np.max(np.abs(entries[edge]), initial=0.0) > TAIL * np.max(np.abs(entries)):
        return None
    into, out = np.meshgrid(np.arange(blocks), np.arange(blocks), indexing="ij")
    rows = (into[None] * count + source[:, None, None]).ravel()
    columns = (out[None] * count + target[:, None, None]).ravel()
    shape = (dynamics.size, dynamics.size)
    return [scipy.sparse.csr_array((entries[:, k].ravel(), (rows, columns)), shape=shape) for k in range(len(grouped))]


# The stretches put together ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Condensed:
    """What one trajectory's samples say about the coefficients, its own start and drive being unknown too.

    Attributes:
        rows, target: least squares for a change of the coefficients: rows @ change = target, in units of the noise.
        own: gives the change of the start (S,) and of the drive's splines (m * parts * border,) that goes with it.
        transition, defects, stretches: what it was made from.
    """

    rows: Float[ndarray, "rows terms"]
    target: Float[ndarray, " rows"]
    own: Callable[[ndarray], tuple[ndarray, ndarray]]
    transition: Transition
    defects: Float[ndarray, "stretch state"]
    stretches: Stretches

    def moves(self, change: Float[ndarray, " terms"]) -> tuple[Float[ndarray, "time state"], ndarray]:
        """Give the change of all states (K + 1, S) and of the splines (m, parts, border) for one of the coefficients."""
        start, splines = self.own(change)
        moved = np.empty((len(self.defects) + 1, len(start)))
        moved[0] = start
        shared = np.tensordot(self.transition.by_coefficient, change, (1, 0)) + self.defects
        if len(splines):
            assert self.transition.by_drive is not None
            local = _local_columns(self.stretches, self.transition)
            shared = shared + np.einsum("kq,kqs->ks", splines[local], self.transition.by_drive)
        for k, forced in enumerate(shared):
            moved[k + 1] = moved[k] @ self.transition.by_state[k] + forced
        dynamics = self.stretches.dynamics
        each = max(dynamics.parts * len(dynamics.border), 1)
        return moved, splines.reshape(len(splines) // each, dynamics.parts, len(dynamics.border))


def _local_columns(stretches: Stretches, transition: Transition) -> Int[ndarray, "stretch local"]:
    """Find the places among all spline coefficients of the ones that live in each stretch (K, Q)."""
    assert transition.by_drive is not None
    assert transition.first is not None
    width = transition.by_drive.shape[1]
    each = stretches.dynamics.parts * len(stretches.dynamics.border)
    return np.asarray(transition.first[:, None] * each + np.arange(width))


def condense(
    stretches: Stretches,
    transition: Transition,
    weights: Float[ndarray, "time state"],
    residuals: Float[ndarray, "time state"] | None = None,
    defects: Float[ndarray, "stretch state"] | None = None,
    edge_weights: ndarray | None = None,
    edge_residuals: ndarray | None = None,
) -> Condensed:
    """Eliminate all states but the first, and then the start and the drive, from the linearised least squares.

    Minimises sum (weights * (residuals - change of state))^2 over the changes that follow
    change_{k+1} = (d end / d start) change_k + (d end / d xi) change of xi + defects_k.

    Args:
        stretches: between K + 1 sample times.
        transition: their derivatives.
        weights: one over the noise of each observed state (K + 1, S), 0 where nothing was seen.
        residuals: observed minus present states, 0 when None.
        defects: end of each stretch minus the next state, 0 when None.
        edge_weights: `weights` for the sites without an equation, (K + 1, order, parts, border).
        edge_residuals: `residuals` for them.
    """
    dynamics = stretches.dynamics
    size, terms = dynamics.size, transition.by_coefficient.shape[1]
    count = len(transition.end)
    residuals = np.zeros((count + 1, size)) if residuals is None else residuals
    defects = np.zeros((count, size)) if defects is None else defects
    edge = _edge_rows(stretches, edge_weights, edge_residuals)
    splines = edge.shape[1] - 1 if edge is not None else 0
    columns = size + splines + terms
    sparse = isinstance(transition.by_state, Sequence) and size > 300
    if not sparse and (count + 1) * size * columns**2 < MAX_QR_WORK:
        sums: Any = _Triangle(columns)
    else:
        sums = _Squares(size, columns, sparse)
    if edge is not None:
        wide = np.zeros((len(edge), columns + 1))
        wide[:, size : size + splines] = edge[:, :-1]
        wide[:, -1] = edge[:, -1]
        sums.add_rows(wide)
    local = _local_columns(stretches, transition) if splines else None
    if isinstance(sums, _Triangle):
        _gather(sums, transition, weights, residuals, defects, splines, local)
    else:
        _square(sums, transition, weights, residuals, defects, splines, local)
    rows, target, solve = sums.reduce(terms)

    def own(change: ndarray) -> tuple[ndarray, ndarray]:
        found = solve(change)
        return found[:size], found[size:]

    return Condensed(rows, target, own, transition, defects, stretches)


def _gather(
    sums: _Triangle,
    transition: Transition,
    weights: ndarray,
    residuals: ndarray,
    defects: ndarray,
    splines: int,
    local: ndarray | None,
) -> None:
    """Follow what the start, the drive, the coefficients and (last row) the defects do, and collect many times at once."""
    count, size = defects.shape
    z = np.zeros((sums.columns + 1, size))
    z[:size] = np.eye(size)
    block = max(1, CHUNK // z.size)
    kept = np.empty((min(block, count + 1), *z.shape))
    for k in range(count + 1):
        number = k % block
        kept[number] = z
        if number == block - 1 or k == count:
            now = slice(k - number, k + 1)
            sums.add(kept[: number + 1], weights[now], residuals[now])
        if k == count:
            break
        z = z @ transition.by_state[k]
        z[size + splines : -1] += transition.by_coefficient[k]
        z[-1] += defects[k]
        if local is not None:
            assert transition.by_drive is not None
            z[size + local[k]] += transition.by_drive[k]


def _square(
    sums: _Squares,
    transition: Transition,
    weights: ndarray,
    residuals: ndarray,
    defects: ndarray,
    splines: int,
    local: ndarray | None,
) -> None:
    """Do the same for normal equations, one time after another."""
    count, size = defects.shape
    state: Any = np.eye(size)
    if sums.sparse:
        import scipy.sparse

        state = scipy.sparse.csr_array(scipy.sparse.identity(size, format="csr"))
    other = np.zeros((sums.columns + 1 - size, size))
    for k in range(count + 1):
        # The last row of `other` is what the defects alone would do.
        sums.add(state, other, weights[k], residuals[k])
        if k == count:
            break
        through = transition.by_state[k]
        state = state @ through
        other = other @ through
        other[splines:-1] += transition.by_coefficient[k]
        other[-1] += defects[k]
        if local is not None:
            assert transition.by_drive is not None
            other[local[k]] += transition.by_drive[k]
        if sums.sparse:
            state.data[np.abs(state.data) < TAIL * 1e-3 * np.max(np.abs(state.data))] = 0.0
            state.eliminate_zeros()


def _edge_rows(stretches: Stretches, weights: ndarray | None, residuals: ndarray | None) -> ndarray | None:
    """Make the rows that hold the drive to what was seen of the sites without an equation; the last column is the target."""
    if stretches.drive is None or stretches.held or weights is None:
        return None
    dynamics, drive = stretches.dynamics, stretches.drive
    residuals = np.zeros_like(weights) if residuals is None else residuals
    times = np.append(stretches.begin, stretches.end[-1])
    first, *curves = drive.basis(times)
    each = dynamics.parts * len(dynamics.border)
    place = first[:, None] + np.arange(drive.degree + 1)
    blocks = []
    for level in range(dynamics.order):
        for number in range(each):
            part, site = divmod(number, len(dynamics.border))
            weight = weights[:, level, part, site]
            seen = np.flatnonzero(weight > 0)
            block = np.zeros((len(seen), drive.count * each + 1))
            block[np.arange(len(seen))[:, None], place[seen] * each + number] = curves[level][seen] * weight[seen, None]
            block[:, -1] = residuals[seen, level, part, site] * weight[seen]
            blocks.append(block)
    return np.concatenate(blocks)


def _triangular(rows: ndarray) -> ndarray:
    """Give the R of rows = Q R."""
    factor: Any = np.linalg.qr(rows, mode="r")
    return np.asarray(factor)


class _Triangle:
    """Rows of a least-squares problem, kept as their orthogonal factor R."""

    def __init__(self, columns: int) -> None:
        self.columns = columns
        self.kept: list[ndarray] = []
        self.waiting = 0

    def add_rows(self, rows: ndarray) -> None:
        self.kept.append(rows)
        self.waiting += len(rows)
        if self.waiting > 6 * self.columns:
            self.kept = [_triangular(np.concatenate(self.kept))]
            self.waiting = len(self.kept[0])

    def add(self, z: ndarray, weights: ndarray, residuals: ndarray) -> None:
        """Add the readings at B times: z (B, columns + 1, S), weights and residuals (B, S)."""
        rows = np.moveaxis(z, 1, 2).copy()
        rows[..., -1] = residuals - rows[..., -1]
        rows *= weights[..., None]
        seen = weights > 0
        if np.any(seen):
            self.add_rows(rows[seen])

    def reduce(self, terms: int) -> tuple[ndarray, ndarray, Callable[[ndarray], ndarray]]:
        from scipy.linalg import solve_triangular

        own = self.columns - terms
        rows = np.concatenate(self.kept)
        scale = np.linalg.norm(rows[:, :-1], axis=0)
        scale[scale == 0] = 1.0
        # What the samples do not hold at all stays where it is.
        ridge = np.zeros((own, self.columns + 1))
        ridge[np.arange(own), np.arange(own)] = 1e-9 * scale[:own]
        factor = _triangular(np.concatenate([rows, ridge]))
        upper, coupled, aim = factor[:own, :own], factor[:own, own:-1], factor[:own, -1]

        def solve(change: ndarray) -> ndarray:
            return np.asarray(solve_triangular(upper, aim - coupled @ change))

        return factor[own:, own:-1], factor[own:, -1], solve


class _Squares:
    """The same problem as normal equations; the states' block is sparse for long chains."""

    def __init__(self, size: int, columns: int, sparse: bool) -> None:
        self.size, self.columns, self.sparse = size, columns, sparse
        self.block: Any = np.zeros((size, size))
        if sparse:
            import scipy.sparse

            self.block = scipy.sparse.csr_array((size, size))
        self.across = np.zeros((size, columns - size + 1))
        self.rest = np.zeros((columns - size + 1, columns - size + 1))

    def add_rows(self, rows: ndarray) -> None:
        tail = rows[:, self.size :]
        self.rest += tail.T @ tail

    def add(self, state: Any, other: ndarray, weights: ndarray, residuals: ndarray) -> None:
        tail = other.copy()
        tail[-1] = residuals - tail[-1]
        tail *= weights
        if self.sparse:
            import scipy.sparse

            weighted = state @ scipy.sparse.diags_array(weights, format="csr")
        else:
            weighted = state * weights
        self.block = self.block + weighted @ weighted.T
        self.across += weighted @ tail.T
        self.rest += tail @ tail.T

    def reduce(self, terms: int) -> tuple[ndarray, ndarray, Callable[[ndarray], ndarray]]:
        import scipy.linalg
        import scipy.sparse.linalg

        diagonal = self.block.diagonal()
        ridge = 1e-14 * np.where(diagonal > 0, diagonal, 1.0)
        if self.sparse:
            import scipy.sparse

            matrix = scipy.sparse.csc_array(self.block + scipy.sparse.diags_array(ridge))
            divide = scipy.sparse.linalg.splu(
                matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            ).solve
        else:
            factor = scipy.linalg.cho_factor(self.block + np.diag(ridge))

            def divide(right: ndarray) -> ndarray:
                return np.asarray(scipy.linalg.cho_solve(factor, right))

        solved = divide(self.across)
        left = self.rest - self.across.T @ solved
        left = (left + left.T) / 2
        # Then the drive, and what is left is about the coefficients.
        drive = len(left) - 1 - terms
        inner = np.zeros((drive, terms + 1))
        if drive:
            held = np.diag(left)[:drive]
            near = left[:drive, :drive] + np.diag(1e-14 * np.where(held > 0, held, 1.0))
            inner = scipy.linalg.solve(near, left[:drive, drive:], assume_a="pos")
            left = left[drive:, drive:] - left[drive:, :drive] @ inner
        scale = np.sqrt(np.maximum(np.diag(left)[:-1], 1e-300))
        values, vectors = np.linalg.eigh(left[:-1, :-1] / scale / scale[:, None])
        root = np.sqrt(np.maximum(values, 0.0))
        rows = root[:, None] * vectors.T * scale
        target = np.where(root > 1e-8, vectors.T @ (left[:-1, -1] / scale) / np.maximum(root, 1e-8), 0.0)

        def solve(change: ndarray) -> ndarray:
            splines = inner[:, -1] - inner[:, :-1] @ change
            start = solved[:, -1] - solved[:, :-1] @ np.concatenate([splines, change])
            return np.concatenate([start, splines])

        return rows, target, solve
