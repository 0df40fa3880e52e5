"""The weak form of a lattice's equation: its integrals over test functions, and the covariance of their errors.

The equation d^order u_n / dt^order = sum_j xi_j T_j is multiplied by test functions phi_k of compact support and
integrated, with the derivatives moved onto phi_k (Messenger & Bortz, Multiscale Model. Simul. 19, 1474 (2021); J.
Comput. Phys. 443, 110525 (2021)):

    order 1:   - int phi_k' u_n dt = sum_j xi_j int phi_k T_j dt
    order 2:     int phi_k'' u_n dt = sum_j xi_j int phi_k T_j dt

The integrands are evaluated on a spline through the samples (`latticebench.methods.engine.spline_state`). The test
functions (1 - s^2)^p are a few knot intervals wide; the trapezoidal rule on an even grid is spectrally accurate for
them, because p derivatives vanish at the ends. (WSINDy takes the support of phi from the changepoint of a Fourier
spectrum, which needs even times, no gaps and periodic data; a spline needs none of these.) Where the velocity was
observed, u and v are one spline. In statistical terms this equals the first-order weak form - int phi' v together with
the constraint v = u', at half its size.

To first order in the noise of the state, the residual of the weak equations is L(xi) (c_seen - c), where c are the
coefficients of the spline and L follows from the derivatives of the terms; its covariance is L cov(c) L^T (WENDy:
Bortz, Messenger & Dukic, Bull. Math. Biol. 85, 110 (2023)).

Equations are made some sites at a time (`Block`), so that memory does not grow with the chain;
`latticebench.methods.engine.weak_covariance` goes through the blocks.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.inputs import inputs
from latticebench.methods.engine.spline_state import estimate_state
from latticebench.systems.arrays import PIECE, rows_of
from latticebench.systems.compiler import Slot, compiled, partials
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Stencil, numbers

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy import ndarray

# Half the support of a test function in knot intervals, and its power p.
HALF_WIDTH = 3.5
POWER = 12
# Below this relative noise, round-off limits the accuracy; test functions four times wider then serve as well.
EXACT = 1e-8
# Relative accuracy of quadrature and splines: the part of a weak equation's error that is not noise.
ACCURACY = 1e-10
# Points of the trapezoidal rule in half a support; with (1 - s^2)^12 its error is below ACCURACY.
POINTS = 40


def bumps(
    t: Float[ndarray, " grid"], centres: Float[ndarray, " tests"], half_width: float, power: int
) -> Float[ndarray, "derivatives tests grid"]:
    """Evaluate the test functions phi = (1 - s^2)^p, s = (t - centre) / half_width, and two derivatives in t.

    phi and its first p - 1 derivatives vanish at s = +-1, and phi is 0 beyond.

    Returns:
        phi (dimensionless), phi' (1 over time) and phi'' (1 over time squared).
    """
    s = (t - centres[:, None]) / half_width
    inside = np.maximum(1 - s**2, 0.0)
    first = -2 * power * s * inside ** (power - 1) / half_width
    second = 2 * power * inside ** (power - 2) * ((2 * power - 1) * s**2 - 1) / half_width**2
    return np.stack([inside**power, first, second])


@dataclass(frozen=True, eq=False)
class Block:
    """Some neighbouring sites with weak equations, in the order in which they share sites.

    Attributes:
        lead: how many of the sites are those that the block before ends with.
        sites: the sites of the equations (M,).
        columns: the sites that their terms read, increasing.
        place: where among the columns each is that is read (offsets, M).
        factor: by which it is multiplied (offsets, M).
    """

    lead: int
    sites: Int[ndarray, " sites"]
    columns: Int[ndarray, " columns"]
    place: Int[ndarray, "offsets sites"]
    factor: Float[ndarray, "offsets sites"]


@dataclass(frozen=True, eq=False)
class Slopes:
    """The derivatives of the residuals of a block's weak equations by the states of the channels that they read.

    Attributes:
        channel: numbers of the channels that each site's equations read (M, reads).
        matrix: the derivatives by w of those (M, reads, parts, tests, coefficients).
    """

    channel: Int[ndarray, "sites reads"]
    matrix: Float[ndarray, "sites reads parts tests coefficients"]

    def moved(self, change: Float[ndarray, "sites reads coefficients"]) -> Float[ndarray, "equations tests"]:
        """Return by how much the residuals move where the state of the channels does."""
        found = np.matmul(self.matrix, change[:, :, None, :, None])[..., 0].sum(axis=1)
        return np.asarray(found.reshape(-1, found.shape[-1]))

    def draw(self, w: Float[ndarray, "channels coefficients"], pull: Float[ndarray, " rows"], lead: int) -> None:
        """Move a state by what pulls at the residuals of all sites but the first `lead`."""
        each = pull.reshape(len(self.matrix), 1, *self.matrix.shape[2:4], 1)[lead:]
        np.subtract.at(w, self.channel[lead:], np.sum(self.matrix[lead:] * each, axis=(2, 3)))


class WeakForm:
    """The weak equations of one trajectory: one per test function, site and part, ordered by site, then part.

    Args:
        samples: the trajectory.
        library: the terms.
        order: of the equation.
        half_width: half the support of the test functions, in knot intervals of the state.
        power: p of (1 - s^2)^p.
        most: values that are computed with at once.

    Attributes:
        state: splines through the samples.
        grid: times at which the integrands are evaluated (G,).
        tests: the test functions and two derivatives, times the step of the grid (3, tests, G).
        support: half the support of a test function, in units of time.
        sites: the sites that have a weak equation, in the order in which they share sites: a ring is folded.
        parts: 1 for a real field, 2 for a complex one.
        shared: an equation shares sites with so many that come after it in this order, at most.

    Raises:
        InputError: too few samples or sites.
    """

    def __init__(
        self, samples: Samples, library: Library, order: int, half_width: float = HALF_WIDTH, power: int = POWER,
        most: int = PIECE,
    ) -> None:  # fmt: skip
        """Estimate the state, then place the test functions."""
        self.samples, self.library, self.order, self.most = samples, library, order, most
        self.parts = 1 + samples.is_complex
        self.state = estimate_state(samples, order)
        self._place_tests(half_width, power)
        self.value = self.state.basis(self.grid, 0)
        self.rate = self.state.basis(self.grid, 1)
        self.stencil = Stencil.chain(samples.sites, library.reach, samples.ends)
        self.whole = self._whole()
        read = [self.stencil.neighbours(offset) for offset in self.stencil.offsets]
        kept = np.flatnonzero(np.all([self.whole[place] | (factor == 0) for place, factor in read], axis=0))
        if len(kept) == 0:
            raise InputError(
                f"{samples.source}: no site has its whole stencil seen more than {self.state.degree} times; "
                "there are too many missing values or too few sites"
            )
        count, reach = len(kept), sum(library.reach)
        order_of = np.arange(count)
        if self.stencil.is_ring:
            order_of = np.minimum(2 * order_of, 2 * (count - 1 - order_of) + 1)
            reach *= 2
        kept = kept[np.argsort(order_of)]
        self.sites = self.stencil.own[kept]
        self.shared = min(reach, count - 1)
        self._place, self._factor = (np.stack([one[number][kept] for one in read]) for number in range(2))
        self._n = numbers(samples.sites)
        self.terms = compiled(library.texts, samples.is_complex)
        self.partials = partials(library.texts, samples.is_complex)

    def _place_tests(self, half_width: float, power: int) -> None:
        state, t = self.state, self.samples.t
        span = t[-1] - t[0]
        intervals = len(state.knots) - 2 * state.degree - 1
        if state.noise[0] < EXACT * state.size:
            intervals = max(state.intervals // 4, min(intervals, 12))
        self.support = support = float(min(half_width * span / intervals, span / 3))
        count = max(int(np.ceil((span - 2 * support) / span * intervals)) + 1, 2)
        self.grid = np.linspace(t[0], t[-1], int(np.ceil(POINTS * span / support)) + 1)
        centres = np.linspace(t[0] + support, t[-1] - support, count)
        self.tests = bumps(self.grid, centres, support, power) * (self.grid[1] - self.grid[0])

    def _whole(self) -> Bool[ndarray, " sites"]:
        """Return which sites were observed often enough, and whose input was."""
        f = self.samples.f
        if f is None:
            return self.state.whole
        seen = np.zeros(f.shape[1], int)
        for some in rows_of(f):
            seen += np.sum(~np.isnan(f[some]), axis=0)
        return np.asarray(self.state.whole & (seen > 1))

    @property
    def count(self) -> int:
        """The number of test functions."""
        return int(self.tests.shape[1])

    @functools.cached_property
    def cuts(self) -> Int[ndarray, " cuts"]:
        """Where the blocks begin among the sites, and the end of the last one."""
        coefficients = self.state.seen.shape[1]
        reads = len(self.stencil.offsets) * self.parts
        each = max(
            self.parts * reads * self.count * coefficients,
            (self.shared + 1) * (self.parts * self.count) ** 2,
            len(self.grid) * self.parts * len(self.library.terms),
        )
        if len(self.state.factors) > 1:
            each += reads * coefficients**2
        number = min(len(self.sites) * each // self.most, len(self.sites) // max(2 * self.shared, 1))
        return np.linspace(0, len(self.sites), max(1, number) + 1).round().astype(int)

    def block(self, number: int) -> Block:
        """Return a block of sites; it begins with those that it shares with the one before."""
        begin, end = (int(one) for one in self.cuts[number : number + 2])
        some = slice(max(begin - self.shared, 0), end)
        columns = np.unique(self._place[:, some])
        place = np.searchsorted(columns, self._place[:, some])
        return Block(begin - some.start, self.sites[some], columns, place, self._factor[:, some])

    def blocks(self) -> Iterator[Block]:
        """Yield blocks of sites that go through all equations."""
        return map(self.block, range(len(self.cuts) - 1))

    def channels(self, block: Block) -> Int[ndarray, " channels"]:
        """Return the numbers of the channels that a block reads."""
        return np.asarray((block.columns[:, None] * self.parts + np.arange(self.parts)).ravel())

    def fields(self, w: Float[ndarray, "channels coefficients"], block: Block) -> tuple[ndarray, ndarray]:
        """Evaluate the state on the grid, at the columns of a block: u and v, each (G, columns)."""
        channels = self.channels(block)
        c = np.matmul(self.state.factor(channels), w[channels][..., None])[..., 0].T
        u, v = self.value @ c, self.rate @ c
        if self.parts == 1:
            return u, v
        return u[:, ::2] + 1j * u[:, 1::2], v[:, ::2] + 1j * v[:, 1::2]

    def rows(
        self, w: Float[ndarray, "channels coefficients"], block: Block
    ) -> tuple[Float[ndarray, "equations tests"], Float[ndarray, "equations tests terms"]]:
        """Return both sides: (-1)^order int phi^(order) u, and int phi T_j in units of the term times time."""
        u, v = self.fields(w, block)
        shape = (len(self.grid), len(block.sites))
        with np.errstate(all="ignore"):
            values = self.terms.function(*self._arrays(self.terms.slots, u, v, block))
        listed = np.stack([np.broadcast_to(value, shape) for value in values]).reshape(self.parts, -1, *shape)
        design = np.einsum("kg,ptgs->spkt", self.tests[0], listed.astype(float), optimize=True)
        own = u[:, np.searchsorted(block.columns, block.sites)]
        target = np.einsum("kg,pgs->spk", self._main, np.stack([own.real, own.imag][: self.parts]), optimize=True)
        equations = len(block.sites) * self.parts
        return target.reshape(equations, self.count), design.reshape(equations, self.count, -1)

    def pieces(self, w: Float[ndarray, "channels coefficients"]) -> Iterator[Float[ndarray, "rows terms_and_target"]]:
        """Yield `rows` of all equations, block by block, the left side in the last column."""
        for block in self.blocks():
            target, design = (one[block.lead * self.parts :] for one in self.rows(w, block))
            yield np.concatenate([design, target[..., None]], axis=-1).reshape(target.size, -1)

    @functools.cached_property
    def height(self) -> float:
        """RMS of the left side on the observed state."""
        squares, count = 0.0, 0
        for block in self.blocks():
            u = self.fields(self.state.seen, block)[0][:, np.searchsorted(block.columns, block.sites[block.lead :])]
            squares += float(np.sum(np.abs(self._main @ u) ** 2))
            count += u.shape[1] * self.parts * self.count
        return float(np.sqrt(squares / count))

    @property
    def _main(self) -> ndarray:
        return np.asarray(-self.tests[1] if self.order == 1 else self.tests[2])

    def _arrays(self, slots: Sequence[Slot], u: ndarray, v: ndarray, block: Block) -> list[ndarray]:
        """Return the values of the variables of the stencil at the sites of a block (G, M)."""
        shape = (len(self.grid), len(block.sites))
        arrays: list[ndarray] = []
        f = self._input(block) if any(slot.name == "f" for slot in slots) else None
        for slot in slots:
            if slot.name in ("t", "n"):
                values = self.grid[:, None] if slot.name == "t" else self._n[block.sites]
                arrays.append(np.broadcast_to(values, shape))
                continue
            field = {"u": u, "v": v, "f": f}[slot.name]
            assert field is not None
            offset = self.stencil.offsets.index(slot.vector)
            read = field[:, block.place[offset]] * block.factor[offset]
            arrays.append(read.imag if slot.part == "im" else read.real)
        return arrays

    def _input(self, block: Block) -> Float[ndarray, "grid columns"]:
        """Return the measured input at the columns of a block; at sites that are not used there may be none at all."""
        assert self.samples.f is not None
        f = np.where(self.whole[block.columns], self.samples.f[:, block.columns], 0.0)
        return inputs(replace(self.samples, u=f, v=None, f=f), self.grid)

    def slopes(
        self, w: Float[ndarray, "channels coefficients"], coefficients: Float[ndarray, " terms"], block: Block
    ) -> Slopes:
        """Return the derivative of the residuals of a block's weak equations by the state."""
        slopes = self._derivatives(w, coefficients, block)
        offsets = self.stencil.offsets
        own = [((0,) * len(offsets[0]), part) for part in range(self.parts)]
        read = sorted({*own, *((slot.vector, int(slot.part == "im")) for _, slot in slopes)})
        matrix = np.zeros((len(block.sites), len(read), self.parts, self.count, self.value.shape[1]))
        for part, one in enumerate(own):
            matrix[:, read.index(one), part] = self._main @ self.value
        for (part, slot), slope in slopes.items():
            profile = (slope * block.factor[offsets.index(slot.vector)]).T
            target = matrix[:, read.index((slot.vector, int(slot.part == "im"))), part]
            for k, (some, columns, product) in enumerate(self._products[slot.name]):
                target[:, k, columns] -= profile[:, some] @ product
        place = np.stack([block.place[offsets.index(vector)] * self.parts + part for vector, part in read], axis=1)
        channel = self.channels(block)[place]
        if len(self.state.factors) == 1:
            return Slopes(channel, matrix @ self.state.factors[0])
        return Slopes(channel, np.matmul(matrix, self.state.factor(channel)[:, :, None]))

    @functools.cached_property
    def _products(self) -> dict[str, list[tuple[slice, slice, ndarray]]]:
        """The part of the grid and of the splines where each test function acts, and its product with these splines."""
        found: dict[str, list[tuple[slice, slice, ndarray]]] = {}
        for name, basis in (("u", self.value), ("v", self.rate)):
            found[name] = []
            for test in self.tests[0]:
                some = np.flatnonzero(test)
                points = slice(int(some[0]), int(some[-1]) + 1)
                some = np.flatnonzero(np.any(self.value[points], axis=0))
                columns = slice(int(some[0]), int(some[-1]) + 1)
                found[name].append((points, columns, test[points, None] * basis[points, columns]))
        return found

    def _derivatives(self, w: ndarray, coefficients: ndarray, block: Block) -> dict[tuple[int, Slot], ndarray]:
        """Return sum_j xi_j dT_j / d(slot) for each part and variable u or v of the stencil, each (G, M)."""
        bundle, places = self.partials
        found: dict[tuple[int, Slot], ndarray] = {}
        if not places or not np.any(coefficients):
            return found
        shape = (len(self.grid), len(block.sites))
        arrays = self._arrays(bundle.slots, *self.fields(w, block), block)
        # |u| has no derivative at 0; what is not finite there is left out.
        with np.errstate(all="ignore"):
            values = bundle.function(*arrays)
        for (term, part, slot), value in zip(places, values, strict=True):
            if coefficients[term] and slot.name in "uv":
                slope = np.broadcast_to(np.where(np.isfinite(value), value, 0.0), shape) * coefficients[term]
                found[part, slot] = found.get((part, slot), 0.0) + slope
        return found
