"""The equation of motion on a chain, evaluated for many states at once, with its derivatives by the state.

    d^order u_n / dt^order = sum_j xi_j w_jn g_jn(t) T_j

The right-hand side is linear in the coefficients xi, so the values of the terms are its derivatives by them. The
derivatives by the state come from the term language and are exact.

Dry friction, sign(v), jumps where a site turns round and holds a site that is at rest; see
`latticebench.methods.engine.friction` for how it is integrated and derived.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from latticebench.methods.engine.resonator import Resonator
from latticebench.systems.compiler import Compiled, Slot, compiled, partials
from latticebench.systems.errors import InputError
from latticebench.systems.stencil import Ends, Stencil, numbers
from latticebench.systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float, Int
    from numpy import ndarray

Factor = Callable[["ndarray"], "ndarray"]

# Places of what terms read in `Dynamics._read`.
FIELDS, INPUT, TIMES, NUMBERS = range(4)


@dataclass(frozen=True, eq=False)
class Dynamics:
    """The equation of motion of a chain.

    A state consists of order * parts * M numbers: u, or Re u and Im u, of the M sites that have an equation and,
    for order 2, their velocities likewise. All N sites have an equation unless the ends are unknown; then only those do
    whose whole stencil lies inside the chain.

    Attributes:
        terms: T_j.
        order: 1 or 2.
        is_complex: whether u is complex.
        sites: N.
        ends: how the chain ends.
        weights: w_jn (terms, N); None for 1 everywhere. A row with a single 1 and zeros makes a term act at one site.
        factors: g_jn of each term, None for 1: a function that maps times (B,) to an array that broadcasts to
            (parts, B, N). The term 1 (1+i for a complex field) with a factor is an arbitrary known force.
        least_reach: least width of the stencil to the left and to the right. With it, equations of different terms
            leave the same sites without an equation at unknown ends.
        rest: speed below which dry friction is viscous; 0 for friction that jumps.
        resonators: of which nothing is read; their y and y' come after u and v in the state.
    """

    terms: tuple[Term, ...]
    order: int
    is_complex: bool
    sites: int
    ends: Ends
    weights: Float[ndarray, "terms sites"] | None = None
    factors: tuple[Factor | None, ...] | None = None
    least_reach: tuple[int, int] = (0, 0)
    rest: float = 0.0
    resonators: tuple[Resonator, ...] = ()

    @functools.cached_property
    def reach(self) -> tuple[int, int]:
        """The number of neighbours to the left and to the right in the widest stencil."""
        left, right = self.least_reach
        return max(left, *(term.reach[0] for term in self.terms)), max(right, *(term.reach[1] for term in self.terms))

    @property
    def parts(self) -> int:
        """1 for a real field, 2 for a complex one."""
        return 1 + self.is_complex

    @functools.cached_property
    def stencil(self) -> Stencil:
        """The sites that all terms read."""
        return Stencil.chain(self.sites, self.reach, self.ends)

    @functools.cached_property
    def moving(self) -> slice:
        """The sites that have an equation."""
        return self.stencil.inner[0]

    @functools.cached_property
    def count(self) -> int:
        """The number M of sites that have an equation."""
        return len(self.stencil.own)

    @property
    def read(self) -> int:
        """The length of the part of a state that is u and v."""
        return self.order * self.parts * self.count

    @property
    def size(self) -> int:
        """The length S of a state."""
        return self.read + sum(one.size for one in self.resonators)

    def sized(self, levels: Sequence[float]) -> Float[ndarray, " state"]:
        """Return sizes of u and, for order 2, of v as those of a whole state; what is not read has the same."""
        own = [np.repeat(levels, self.parts * self.count), *(np.asarray(levels) for _ in self.resonators)]
        return np.concatenate(own)

    @property
    def mirror(self) -> Float[ndarray, " state"]:
        """The signs that the numbers of a state change as time goes back: -1 for velocities and imaginary parts."""
        blocks = np.ones((self.order, self.parts, self.count))
        if self.order == 2:
            blocks[1] = -1
        else:
            blocks[:, 1:] = -1
        return np.concatenate([blocks.ravel(), *(np.array([1.0, -1.0]) for _ in self.resonators)])

    @functools.cached_property
    def border(self) -> Int[ndarray, " border"]:
        """The sites that have no equation."""
        return self.stencil.border

    def pack(self, u: ndarray, v: ndarray | None) -> Float[ndarray, "time state"]:
        """Write u (T, N) and, for order 2, v (T, N) as states; a v that is None counts as zero."""
        fields = [u] if self.order == 1 else [u, np.zeros_like(u) if v is None else v]
        blocks = [split_parts(one[:, self.moving], self.is_complex) for one in fields]
        return np.stack(blocks, axis=1).reshape(len(u), self.read)

    def linear(
        self,
        coefficients: Float[ndarray, " terms"],
        t: Float[ndarray, " batch"],
        y: Float[ndarray, "batch state"],
        f: Float[ndarray, "batch sites"] | None = None,
        driven: Float[ndarray, "batch order parts border"] | None = None,
        *,
        derivatives: bool = True,
        sliding: Float[ndarray, "batch moving"] | None = None,
    ) -> tuple[ndarray, ndarray, dict[tuple[int, Slot], ndarray]]:
        """Evaluate the right-hand side and its derivatives.

        Args:
            coefficients: xi.
            t: times (B,).
            y: states.
            f: measured input at all sites; needed if a term uses it.
            driven: u and, for order 2, v of the sites that have no equation.
            derivatives: whether the derivatives by the state are wanted.
            sliding: what stands for sign(v[n]) in dry friction; None leaves it as it is. Derivatives keep it fixed.

        Returns:
            dy/dt (B, S); the values of the terms with their weights and factors (parts, terms, B, M); for each part of
            the equation and each variable of the stencil, the derivative of the highest time derivative (B, M). The
            last is empty without `derivatives`.

        Raises:
            InputError: a term uses f[n], and there is no input.
        """
        read = self._read(y, t, f, driven)
        shape = (len(t), self.count)
        values = np.empty((self.parts, len(self.terms), *shape))
        for function, places, alike in self._values:
            for part, value in enumerate(function(*[read[of][where] for of, where in places])):
                values[part, alike if len(alike) > 1 else alike[0]] = value
        if sliding is not None:
            values[0, self.rubbing] = sliding
        if self.weights is not None:
            values *= self.weights[:, None, self.moving]
        factors = self._factors(t)
        for term, factor in factors.items():
            values[:, term] *= factor
        found: dict[tuple[int, Slot], ndarray] = {}
        rate = np.empty((len(t), self.order, self.parts, self.count))
        if self.order == 2:
            rate[:, 0] = y[:, : self.read].reshape(rate.shape)[:, 1]
        summed = np.matmul(coefficients, values.reshape(self.parts, len(self.terms), -1))
        rate[:, -1] = summed.reshape(self.parts, *shape).swapaxes(0, 1)
        if derivatives:
            self._add_slopes(found, read, coefficients, factors)
        return self._with_unread(rate.reshape(len(t), -1), y), values, found

    def _with_unread(self, rate: Float[ndarray, "batch read"], y: Float[ndarray, "batch state"]) -> ndarray:
        """Return the rates with those of the resonators, and with what these do to their sites."""
        if not self.resonators:
            return rate
        later = np.empty_like(y)
        later[:, : self.read] = rate
        for (one, place, v), felt in zip(self.beside, self.felt(y.T, rate[:, self.count :].T), strict=True):
            own, pushed = one.rates(felt)
            later[:, place], later[:, place + 1] = y[:, place + 1], own
            later[:, v] += pushed[:, None]
        return later

    @functools.cached_property
    def beside(self) -> tuple[tuple[Resonator, int, Int[ndarray, " sites"]], ...]:
        """Each resonator with where its y is in a state, before its y', and where v of its sites is."""
        places = range(self.read, self.size, Resonator.size)
        return tuple((one, y, self.count + np.array(one.sites)) for one, y in zip(self.resonators, places, strict=True))

    def felt(
        self, state: Float[ndarray, "state *batch"], force: Float[ndarray, "moving *batch"]
    ) -> list[Float[ndarray, "5 *batch"]]:
        """Return y, y', and the sums of u, v and the terms' force over its sites, of each resonator."""
        found = []
        for _, place, v in self.beside:
            sums = (one.sum(axis=0) for one in (state[v - self.count], state[v], force[v - self.count]))
            found.append(np.stack([state[place], state[place + 1], *sums]))
        return found

    def acting(self, coefficients: Float[ndarray, " terms"]) -> tuple[Dynamics, Float[ndarray, " terms"]]:
        """Return the equation of the terms whose coefficients are not zero, on the same sites, and these."""
        kept = np.flatnonzero(coefficients)
        if len(kept) in (0, len(coefficients)):
            return self, coefficients
        fewer = replace(
            self,
            terms=tuple(self.terms[k] for k in kept),
            weights=None if self.weights is None else self.weights[kept],
            factors=None if self.factors is None else tuple(self.factors[k] for k in kept),
            least_reach=self.reach,
        )
        return fewer, coefficients[kept]

    def evaluator(
        self,
        t: Float[ndarray, " batch"],
        y: Float[ndarray, "batch state"],
        f: Float[ndarray, "batch sites"] | None = None,
        driven: Float[ndarray, "batch order parts border"] | None = None,
    ) -> Callable[[Term], Float[ndarray, "batch parts moving"]]:
        """Return a function that evaluates terms, without weights and factors, at the sites that have an equation.

        The terms must not reach farther than the equation. See `linear` for the arguments and what is raised.
        """
        read = self._read(y, t, f, driven)

        def value(term: Term) -> ndarray:
            bundle = compiled((term.text,), self.is_complex)
            found = np.empty((len(t), self.parts, self.count))
            for part, one in enumerate(bundle.function(*[read[of][where] for of, where in self._places(bundle)])):
                found[:, part] = one
            return found

        return value

    def _add_slopes(
        self,
        found: dict[tuple[int, Slot], ndarray],
        read: Sequence[Any],
        coefficients: ndarray,
        factors: dict[int, ndarray],
    ) -> None:
        """Add to `found` the derivatives of all terms by the variables of the stencil, times their coefficients."""
        for function, places, variables, alike in self._partials:
            acting = [term for term in alike if coefficients[term] != 0]
            if not acting:
                continue
            strength = [self._strength(acting, coefficients, factors, part) for part in range(self.parts)]
            outputs = function(*[read[of][where] for of, where in places])
            for variable, value in zip(variables, outputs, strict=True):
                share, other = strength[variable[0]] * value, found.get(variable)
                found[variable] = share if other is None else other + share

    def _strength(
        self, terms: Sequence[int], coefficients: ndarray, factors: dict[int, ndarray], part: int
    ) -> float | ndarray:
        """Return the sum of coefficient times weight times factor of terms that are the same function."""
        total: float | ndarray = 0.0
        for term in terms:
            own = coefficients[term] if self.weights is None else coefficients[term] * self.weights[term, self.moving]
            total = total + (own * factors[term][part] if term in factors else own)
        return total

    @functools.cached_property
    def rubbing(self) -> list[int]:
        """The numbers of the terms that are dry friction."""
        if self.order == 1 or self.is_complex:
            return []
        return [k for k, term in enumerate(self.terms) if term.jumps]

    def rubbing_sizes(self, t: Float[ndarray, " batch"]) -> Float[ndarray, "rubbing batch moving"]:
        """Return weight times factor of each term that is dry friction."""
        found, factors = np.ones((len(self.rubbing), len(t), self.count)), self._factors(t, self.rubbing)
        for size, term in zip(found, self.rubbing, strict=True):
            size *= 1.0 if self.weights is None else self.weights[term, self.moving]
            size *= factors[term][0] if term in factors else 1.0
        return found

    def _factors(self, t: ndarray, terms: Sequence[int] | None = None) -> dict[int, ndarray]:
        """Evaluate the factors, of all terms or of some, at the sites that have an equation; each is (parts, B, M)."""
        found = {}
        for term, factor in enumerate(self.factors or ()):
            if factor is not None and (terms is None or term in terms):
                whole = np.broadcast_to(factor(t), (self.parts, len(t), self.sites))
                found[term] = whole[..., self.moving]
        return found

    @functools.cached_property
    def _values(self) -> Any:
        # Each term is compiled once, whatever the equation that it stands in, and evaluated once for all its weights.
        bundles = [(compiled((text,), self.is_complex), alike) for text, alike in self._alike.items()]
        return [(one.function, self._places(one), alike) for one, alike in bundles]

    @functools.cached_property
    def _partials(self) -> Any:
        found = []
        for text, alike in self._alike.items():
            slopes, variables = partials((text,), self.is_complex)
            if variables:
                by = [(part, slot) for _, part, slot in variables]
                found.append((slopes.function, self._places(slopes), by, alike))
        return found

    @functools.cached_property
    def _alike(self) -> dict[str, list[int]]:
        """The numbers of the terms that are the same function of the stencil."""
        found: dict[str, list[int]] = {}
        for number, term in enumerate(self.terms):
            found.setdefault(term.text, []).append(number)
        return found

    def whole(self, y: ndarray, driven: ndarray | None) -> ndarray:
        """Return the fields of all sites (..., order, parts, N); the border is 0 where `driven` is None."""
        blocks = y[..., : self.read].reshape(*y.shape[:-1], self.order, self.parts, self.count)
        if len(self.border) == 0:
            return blocks
        whole = np.zeros((*blocks.shape[:-1], self.sites))
        whole[..., self.moving] = blocks
        if driven is not None:
            whole[..., self.border] = driven
        return whole

    def window(self, slot: Slot) -> tuple[Any, ...]:
        """Return where a slot of u or v is in padded fields (., order, parts, ...), for all sites with an equation."""
        if slot not in self._known_windows:
            self._known_windows[slot] = (slice(None), *slot.place, *self.stencil.window(slot.vector))
        return self._known_windows[slot]

    @functools.cached_property
    def _known_windows(self) -> dict[Slot, tuple[Any, ...]]:
        return {}

    def _places(self, bundle: Compiled) -> list[tuple[int, Any]]:
        """Return which of the arrays of `_read` a compiled function takes, and which part of each."""
        found: list[tuple[int, Any]] = []
        for slot in bundle.slots:
            if slot.name == "t":
                found.append((TIMES, (slice(None), None)))
            elif slot.name == "n":
                found.append((NUMBERS, self.moving))
            elif slot.name == "f":
                found.append((INPUT, (slice(None), *self.stencil.window(slot.vector))))
            else:
                found.append((FIELDS, self.window(slot)))
        return found

    def _read(self, y: ndarray, t: ndarray, f: ndarray | None, driven: ndarray | None) -> tuple[Any, ...]:
        """Return what terms are functions of: `FIELDS`, `INPUT`, `TIMES` and `NUMBERS`."""
        pad = self.stencil.pad
        return pad(self.whole(y, driven)), _NoInput() if f is None else pad(f), t, self._numbers

    @functools.cached_property
    def _numbers(self) -> ndarray:
        return numbers(self.sites)


class _NoInput:
    """Stands where a measured input would be."""

    def __getitem__(self, _: object) -> ndarray:
        raise InputError("the terms use f[n], but there is no measured input")


def split_parts(field: ndarray, is_complex: bool) -> Float[ndarray, "time parts sites"]:
    """Write a field (T, N) as its real part and, for a complex field, its imaginary part."""
    return np.stack([field.real, field.imag] if is_complex else [field], axis=1).astype(float)
