"""The right-hand side of the equation of motion and of the variational equations, for many stretches at once.

The derivatives z of the states y, one row for each number that is varied, follow

    dz/dt = (dF/dy) z + dF/dxi

where dy/dt = F(t, y; xi) is linear in the coefficients xi (Hairer, Norsett & Wanner, Solving Ordinary Differential
Equations I, section I.14). The batch is the last axis of z, so that the innermost loops are long even on short chains.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.dynamics import Dynamics
from latticebench.methods.engine.friction import Course, Sliding
from latticebench.systems.compiler import Slot

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

# Where terms read more places than this of each part, all sites are taken to couple: one product of matrices is faster.
WIDE = 8


@dataclass(frozen=True, eq=False)
class Outside:
    """What acts from outside at times of a batch.

    Attributes:
        t: times.
        f: measured input at all sites, or None.
        curve: u and, for order 2, v of the sites without an equation, or None.
        basis: the B-splines that are not zero there, from the first one of the stretch on, with their values and
            slopes; None where nothing is derived by them.
    """

    t: Float[ndarray, " batch"]
    f: Float[ndarray, "batch sites"] | None = None
    curve: Float[ndarray, "batch order parts border"] | None = None
    basis: tuple[Int[ndarray, "batch splines"], ndarray, ndarray] | None = None


@dataclass(frozen=True, eq=False)
class Rubbed:
    """What dry friction does over a step.

    Attributes:
        line: what stands for sign(v).
        changes: derivatives of its mean and its trend by what is varied, or None.
    """

    line: Sliding
    changes: Float[ndarray, "2 columns moving batch"] | None

    def at(self, x: float) -> tuple[ndarray, ndarray | None]:
        """Return the line at a share of the step, and its derivatives."""
        changes = None if self.changes is None else self.changes[0] + (x - 0.5) * self.changes[1]
        return self.line.at(x), changes


@dataclass(frozen=True, eq=False)
class Rates:
    """Rates of states and of their derivatives.

    The columns of z are, in this order, those of the start, the coefficients, the numbers of resonators, the drive.

    Attributes:
        dynamics: the equation.
        coefficients: xi.
        by_terms: whether z has columns of the coefficients and of the numbers of resonators.
        driving: columns of the drive.
    """

    dynamics: Dynamics
    coefficients: Float[ndarray, " terms"]
    by_terms: bool
    driving: int

    @property
    def numbers(self) -> int:
        """The columns of the coefficients and of the numbers of resonators."""
        return len(self.dynamics.terms) + self._of_unread if self.by_terms else 0

    @property
    def _of_unread(self) -> int:
        return sum(one.numbers for one in self.dynamics.resonators) if self.by_terms else 0

    def at(
        self,
        outside: Outside,
        y: Float[ndarray, "batch state"],
        z: Float[ndarray, "columns state batch"] | None,
        out: Float[ndarray, "columns state batch"] | None,
        sliding: Float[ndarray, "batch moving"] | None = None,
        changes: Float[ndarray, "columns moving batch"] | None = None,
    ) -> Float[ndarray, "batch state"]:
        """Return dy/dt, and write dz/dt into `out` if there is a z.

        Dry friction acts along `sliding`, see `Dynamics.linear`, of which `changes` are the derivatives.
        """
        dynamics = self.dynamics
        rate, values, slopes = dynamics.linear(
            self.coefficients, outside.t, y, outside.f, outside.curve, derivatives=z is not None, sliding=sliding
        )
        if z is not None and out is not None:
            self._vary(out, z, values, slopes, outside)
            if changes is not None:
                out[:, dynamics.count : dynamics.read] += self._pull(outside.t).T * changes
            if dynamics.resonators:
                self._vary_unread(out, z, y, np.tensordot(self.coefficients, values[0], 1))
        return rate

    def rubbed(self, h: Float[ndarray, " batch"], y: ndarray, z: Any, first: Outside, middle: Outside) -> Rubbed:
        """Look ahead over a step of length h, from its beginning to its middle, before any site turns."""
        dynamics = self.dynamics
        rest, moving = dynamics.rest, slice(dynamics.count, dynamics.read)
        pull = h[:, None] * self._yielding * self._pull(middle.t)

        def ahead(outside: Outside, y_there: ndarray, z_there: Any) -> tuple[ndarray, Any]:
            sliding = np.tanh(y_there[:, moving] / rest) if rest else np.sign(y[:, moving])
            if z_there is None:
                return self.at(outside, y_there, None, None, sliding), None
            out = np.empty(z_there.shape)
            changes = ((1 - sliding**2) / rest).T * z_there[:, moving] if rest else None
            return self.at(outside, y_there, z_there, out, sliding, changes), out

        rate, varied = ahead(first, y, z)
        halfway, later = y + h[:, None] / 2 * rate, None if z is None else z + h / 2 * varied
        if not rest:
            held = (y[:, moving] * halfway[:, moving] <= 0) & (
                np.abs(h[:, None] * rate[:, moving] - pull * np.sign(y[:, moving])) < -pull
            )
            halfway[:, moving][held] = 0.0
            if later is not None:
                later[:, moving] *= ~held.T
        onwards, beyond = ahead(middle, halfway, later)
        course = Course(y[:, moving], h[:, None] * rate[:, moving], h[:, None] * onwards[:, moving])
        line = Sliding.soft(course, rest) if rest else Sliding.abrupt(course, pull)
        if z is None:
            return Rubbed(line, None)
        by_v, by_early, by_middle, by_pull = np.moveaxis(np.swapaxes(line.by, 2, 3)[:, :, None], 1, 0)
        changes = by_v * z[:, moving] + h * (by_early * varied[:, moving] + by_middle * beyond[:, moving])
        if self.by_terms:
            own = self._first(len(z))
            for number, size in zip(dynamics.rubbing, dynamics.rubbing_sizes(middle.t), strict=True):
                changes[:, own + number] += by_pull[:, 0] * h * (self._yielding * size).T
        return Rubbed(line, changes)

    def _pull(self, t: Float[ndarray, " batch"]) -> Float[ndarray, "batch moving"]:
        """Return the coefficient of sign(v)."""
        return np.asarray(np.tensordot(self.coefficients[self.dynamics.rubbing], self.dynamics.rubbing_sizes(t), 1))

    @functools.cached_property
    def _yielding(self) -> Float[ndarray, " moving"]:
        """By how much more a force changes the speed of a site if what carries the site gives way."""
        found = np.ones(self.dynamics.count)
        for one in self.dynamics.resonators:
            found[list(one.sites)] += one.slopes[1, -1]
        return found

    def _first(self, columns: int) -> int:
        """Return the first column of the coefficients."""
        return columns - self.driving - self.numbers

    def _vary(
        self, out: ndarray, z: ndarray, values: ndarray, slopes: dict[tuple[int, Slot], ndarray], outside: Outside
    ) -> None:
        """Write dz/dt of u and v into `out`."""
        dynamics = self.dynamics
        order, parts, count = dynamics.order, dynamics.parts, dynamics.count
        columns, batch = len(z), z.shape[-1]
        blocks = z[:, : dynamics.read].reshape(columns, order, parts, count, batch)
        field = blocks
        if len(dynamics.border):
            field = np.zeros((columns, order, parts, dynamics.sites, batch))
            field[..., dynamics.moving, :] = blocks
        if outside.basis is not None:
            border = dynamics.border
            place, *curves = outside.basis
            rows = np.arange(batch)[:, None]
            # The columns of the drive: spline coefficient, part, site.
            for part in range(parts):
                for number, site in enumerate(border):
                    column = columns - self.driving + (place * parts + part) * len(border) + number
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
        if self.by_terms:
            own = self._first(columns)
            target[own : own + len(dynamics.terms), -1] += np.transpose(values, (1, 0, 3, 2))

    def _vary_unread(self, out: ndarray, z: ndarray, y: ndarray, force: Float[ndarray, "batch moving"]) -> None:
        """Write dz/dt of the resonators, and add what they do to their sites; the terms push with `force`."""
        dynamics = self.dynamics
        first = len(z) - self.driving - self._of_unread
        varied = dynamics.felt(np.swapaxes(z, 0, 1), np.swapaxes(out[:, dynamics.count : dynamics.read], 0, 1))
        felt = dynamics.felt(y.T, force.T)
        for (one, place, v), change, own in zip(dynamics.beside, varied, felt, strict=True):
            swing, pushed = np.tensordot(one.slopes, change, 1)
            out[:, place], out[:, place + 1] = z[:, place + 1], swing
            out[:, v] += pushed[:, None]
            if self.by_terms:
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
