"""The paper's physics-informed neural network: a curve through the samples that obeys the library's equation.

A fully connected tanh network takes the time t and gives u_n(t) at every site, for second order also v_n(t), for a complex
field real and imaginary parts. Its weights and the coefficients xi are trained together on

    loss = data_weight * mean |u - samples|^2 / s_u^2  (and the same of v, where it was observed)
         + mean |du/dt - v|^2 / s_v^2                  (second order)
         + mean |rate - sum_j xi_j T_j|^2 / s_r^2      with rate = du/dt or dv/dt

by Adam, then L-BFGS. The first line is over the samples, the others over evenly spaced collocation times; s_u, s_v and s_r
are the sizes of the field, the velocity and the rate in the samples. The equation is asked for where the whole stencil was
observed (the paper's interior sites), or at every site where the chain's ends are known.

The gradient is written out by hand: tangents and values go through the layers as rows of one matrix, and one backward sweep
gives the derivative by all weights. The same code runs on NumPy arrays and, on another device, on torch tensors; and for one
network or, on torch tensors with one more axis in front, for several members that differ in their first weights.

What the paper has: the architecture, the outputs, both residuals, the mirrored data, Adam and L-BFGS as examples of
optimisers (its sections 2.2, 3 and 4.2). It says nothing on loss weights, learning rates, numbers of steps, numbers of
collocation points, initial weights or the scaling of time; the defaults of `PINN` are this project's.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from latticebench.methods.method import Abilities, Fit, History
from latticebench.systems.compiler import Slot, real_parts
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples
from latticebench.systems.stencil import Ends, evaluate, ghosts, observed

if TYPE_CHECKING:
    import sympy
    from jaxtyping import Float
    from numpy import ndarray

    # A NumPy array on the processor, a torch tensor elsewhere.
    Array = Any
    Evaluate = Callable[[ndarray], tuple[float, ndarray]]


# The equation -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Contracted:
    """A library's terms T_j and the derivatives of sum_j xi_j T_j, compiled into one function with shared subexpressions.

    `function(*slots, *xi)` takes one array a slot and one number a coefficient and gives the terms' real parts, for a complex
    field their imaginary parts, then one array (or number) for each of `places`: (part of the sum, slot it is derived by).
    """

    slots: tuple[Slot, ...]
    places: tuple[tuple[int, Slot], ...]
    function: Callable[..., Sequence[Any]]


@functools.lru_cache(maxsize=128)
def contracted(texts: tuple[str, ...], is_complex: bool, backend: str = "numpy") -> Contracted:
    """Compile terms for training.

    Args:
        texts: the terms.
        is_complex: whether u = p + i q is complex.
        backend: "numpy" or "torch".
    """
    import sympy
    from sympy.printing.pycode import PythonCodePrinter

    class Printer(PythonCodePrinter):  # type: ignore[misc]
        """Print whole powers as products, which are many times faster than pow, and signs as a function."""

        def _print_Pow(self, expr: sympy.Pow, rational: bool = False, sqrt: str = "sqrt") -> str:
            if expr.exp.is_Integer:
                return f"power({self._print(expr.base)}, {int(expr.exp)})"
            if expr.exp == sympy.Rational(1, 2):
                return f"sqrt({self._print(expr.base)})"
            if expr.exp == sympy.Rational(-1, 2):
                return f"(1/sqrt({self._print(expr.base)}))"
            return str(super()._print_Pow(expr, rational, sqrt))

        def _print_sign(self, expr: sympy.sign) -> str:
            return f"sign({self._print(expr.args[0])})"

    written = [real_parts(text, is_complex) for text in texts]
    symbols = {slot: symbol for found, _ in written for slot, symbol in found.items()}
    slots = tuple(sorted(symbols))
    parts = 1 + is_complex
    xi = sympy.symbols(f"xi:{len(texts)}", real=True)
    expressions = [one[part] for part in range(parts) for _, one in written]
    places = []
    for part in range(parts):
        total = sympy.Add(*(x * one[part] for x, (_, one) in zip(xi, written, strict=True)))
        for slot in slots:
            derivative = total.diff(symbols[slot]) if slot.name in ("u", "v") else sympy.Integer(0)
            # The slope of sign(x) is zero wherever it exists.
            derivative = derivative.replace(sympy.DiracDelta, lambda *_: sympy.Integer(0))
            if derivative != 0:
                expressions.append(derivative)
                places.append((part, slot))
    space: dict[str, Any] = {"power": power, "pi": math.pi}
    names = ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sqrt", "sign", "abs")
    if backend == "torch":
        import torch

        space |= {name: getattr(torch, name) for name in names} | {"atan": torch.atan}
    else:
        space |= {name: getattr(np, name) for name in names} | {"atan": np.arctan}
    printer = Printer({"fully_qualified_modules": False, "inline": True, "allow_unknown_functions": True})
    arguments = [symbols[slot] for slot in slots] + list(xi)
    return Contracted(
        slots, tuple(places), sympy.lambdify(arguments, expressions, modules=[space], printer=printer, cse=True)
    )


def power(base: Any, exponent: int) -> Any:
    """Give base**exponent for a whole exponent, by repeated squaring."""
    if exponent < 0:
        return 1 / power(base, -exponent)
    if exponent == 0:
        return base * 0 + 1
    half = power(base, exponent // 2) if exponent > 1 else None
    if half is None:
        return base
    return half * half * base if exponent % 2 else half * half


@dataclass(frozen=True, eq=False)
class Equation:
    """A library on one trajectory's collocation times.

    Fields come as one row a time, one block of N columns for each of u (its real, then its imaginary part) and, for second
    order, v likewise.

    Attributes:
        terms: the compiled library.
        count: how many terms J there are.
        parts: 1 for a real field, 2 for a complex one.
        order: of the time derivative.
        sites: N.
        reach: how far the stencil sees to the left and the right.
        inner: the sites at which the equation is asked for, as columns of a block.
        fold: the matrix (N, padded) that repeats sites beyond known ends, None where nothing is repeated.
        given: arrays for t, n and f, by slot.
    """

    terms: Contracted
    count: int
    parts: int
    order: int
    sites: int
    reach: tuple[int, int]
    inner: slice
    fold: Array | None
    given: dict[Slot, Array]

    def windows(self, fields: Array) -> list[Array]:
        """Cut the fields (..., P, blocks * N) into one array (..., P, inner) a slot."""
        width = self.inner.stop - self.inner.start
        blocks: dict[int, Array] = {}
        arrays = []
        for slot in self.terms.slots:
            if slot in self.given:
                arrays.append(self.given[slot])
                continue
            block = self.block(slot)
            if block not in blocks:
                columns = fields[..., block * self.sites : (block + 1) * self.sites]
                blocks[block] = columns if self.fold is None else columns @ self.fold
            first = self.reach[0] + slot.offset
            arrays.append(blocks[block][..., first : first + width])
        return arrays

    def block(self, slot: Slot) -> int:
        """Say which block of columns a slot is cut from."""
        return (self.parts if slot.name == "v" else 0) + (slot.part == "im")

    def rate_columns(self, part: int) -> slice:
        """Say which columns of the outputs hold the highest derivative's antiderivative at the inner sites."""
        first = ((self.order - 1) * self.parts + part) * self.sites
        return slice(first + self.inner.start, first + self.inner.stop)

    def pull_back(self, slopes: Sequence[Any], weights: Sequence[Array], gradient: Array) -> None:
        """Add the derivative by the fields of sum over parts <weights_part, sum_j xi_j T_j> to `gradient`.

        Args:
            slopes: the arrays that belong to `terms.places`.
            weights: one array (..., P, inner) a part.
            gradient: (..., P, blocks * N), changed in place.
        """
        width = self.inner.stop - self.inner.start
        padded: dict[int, Array] = {}
        for (part, slot), slope in zip(self.terms.places, slopes, strict=True):
            block, first = self.block(slot), self.reach[0] + slot.offset
            if self.fold is None:
                target = gradient[..., block * self.sites : (block + 1) * self.sites]
            else:
                if block not in padded:
                    padded[block] = gradient[..., :1] * self.fold[:1] * 0
                target = padded[block]
            target[..., first : first + width] += weights[part] * slope
        for block, columns in padded.items():
            gradient[..., block * self.sites : (block + 1) * self.sites] += columns @ self.fold.T  # type: ignore[union-attr]


# The samples, in the network's units --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scales:
    """Sizes estimated from the samples, all > 0: of the field about its mean, its velocity, its rate, and each term."""

    field: float
    velocity: float
    rate: float
    terms: Float[ndarray, " terms"]

    def coefficients(self) -> Float[ndarray, " terms"]:
        """Size of each coefficient: one at which the term alone is as large as the rate."""
        return self.rate / self.terms


def scales(data: Sequence[Samples], library: Library, order: int) -> Scales:
    """Estimate sizes by differences between neighbouring samples; a size that is 0 or unknown becomes 1."""
    fields, velocities, rates, terms = [], [], [], []
    for samples in data:
        u = samples.u
        velocity = _slope(samples.t, u) if samples.v is None or order == 1 else samples.v
        rate = velocity if order == 1 else _slope(samples.t, velocity)
        with np.errstate(all="ignore"):
            values = evaluate(
                library.terms, u, velocity if order == 2 else None, samples.f, samples.t, ends=samples.ends
            )
        fields.append((u - np.nanmean(u)).ravel())
        velocities.append(velocity.ravel())
        rates.append(rate.ravel())
        terms.append(np.sqrt(np.sum(values**2, axis=0)).reshape(len(library.terms), -1))

    def size(parts: list[ndarray]) -> float:
        squares = np.abs(np.concatenate(parts)) ** 2
        squares = squares[np.isfinite(squares)]
        found = float(np.sqrt(np.mean(squares))) if len(squares) else 0.0
        return found if found > 0 and np.isfinite(found) else 1.0

    each = [size([part[k] for part in terms]) for k in range(len(library.terms))]
    return Scales(size(fields), size(velocities), size(rates), np.array(each))


def _slope(t: ndarray, field: ndarray) -> ndarray:
    """Differences between neighbouring samples over the time between them, (T, N); NaN where there is no neighbour."""
    slope = np.full(field.shape, np.nan, dtype=field.dtype)
    for site in range(field.shape[1]):
        seen = np.isfinite(field[:, site])
        if np.sum(seen) > 1:
            slope[seen, site] = np.gradient(field[seen, site], t[seen])
    return slope


def inputs(samples: Samples, times: Float[ndarray, " time"]) -> Float[ndarray, "time sites"]:
    """Interpolate the measured input by cubic splines (by lines, where fewer than four values were seen).

    Raises:
        InputError: a site's input was never seen.
    """
    from scipy.interpolate import make_interp_spline

    assert samples.f is not None
    result = np.empty((len(times), samples.sites))
    for site in range(samples.sites):
        seen = np.isfinite(samples.f[:, site])
        if not np.any(seen):
            raise InputError(f"{samples.source}: every value of the input f{site + 1} is missing")
        degree = 3 if np.sum(seen) > 3 else min(1, int(np.sum(seen)) - 1)
        result[:, site] = make_interp_spline(samples.t[seen], samples.f[seen, site], k=degree)(times)
    return result


def columns(samples: Samples, order: int) -> Float[ndarray, "time outputs"]:
    """Write samples as the network's outputs: blocks of u and v, real before imaginary parts; NaN where not observed.

    A complex value of which one part is missing is missing.
    """
    gap = complex(np.nan, np.nan) if samples.is_complex else np.nan
    fields = [np.where(np.isnan(samples.u), gap, samples.u)]
    if order == 2:
        fields.append(np.full_like(samples.u, np.nan) if samples.v is None else samples.v)
    blocks = [part for one in fields for part in ((one.real, one.imag) if samples.is_complex else (one,))]
    return np.concatenate(blocks, axis=1).astype(float)


def equation(
    samples: Samples, library: Library, order: int, times: ndarray, xp: Any, move: Callable[..., Any]
) -> Equation:
    """Set a library up on a trajectory's collocation times.

    Args:
        samples: the trajectory.
        library: the terms.
        order: of the time derivative.
        times: collocation times (P,).
        xp: numpy or torch.
        move: what turns a NumPy array into one of `xp`.
    """
    ends: Ends = samples.ends
    sites, reach = samples.sites, library.reach
    index, factor = ghosts(sites, *reach, ends)
    inner = observed(sites, reach, ends)
    fold = None
    if ends != "unknown" and sum(reach) > 0:
        fold = np.zeros((sites, len(index)))
        fold[index, np.arange(len(index))] = factor
    compiled = contracted(library.texts, samples.is_complex, "numpy" if xp is np else "torch")
    shape = (len(times), inner.stop - inner.start)
    given: dict[Slot, Any] = {}
    forced = inputs(samples, times)[:, index] * factor if samples.f is not None and library.uses("f") else None
    for slot in compiled.slots:
        if slot.name == "t":
            given[slot] = move(np.broadcast_to(times[:, None], shape))
        elif slot.name == "n":
            given[slot] = move(np.broadcast_to((np.arange(sites) - (sites - 1) / 2)[inner], shape))
        elif slot.name == "f":
            assert forced is not None
            first = reach[0] + slot.offset
            given[slot] = move(forced[:, first : first + shape[1]])
    return Equation(
        compiled, len(library.terms), 1 + samples.is_complex, order, sites, reach, inner,
        None if fold is None else move(fold), given,
    )  # fmt: skip


# The network --------------------------------------------------------------------------------------------------------------


def shapes(layers: int, width: int, outputs: int) -> list[tuple[int, int]]:
    """Give the shape (in + 1, out) of each layer: its weights, and its bias as the last row."""
    sizes = [1, *[width] * layers, outputs]
    return [(before + 1, after) for before, after in itertools.pairwise(sizes)]


def initial_weights(
    form: Sequence[tuple[int, int]], frequency: float, draw: np.random.Generator
) -> Float[ndarray, " weights"]:
    """Draw a network's weights: the first layer uniform in +-frequency, the others as Glorot and Bengio (2010), biases 0.

    The first layer's biases are drawn as its weights are, so that the units bend at different times.
    """
    pieces = []
    for number, (rows, width) in enumerate(form):
        limit = frequency if number == 0 else math.sqrt(6 / (rows - 1 + width))
        layer = draw.uniform(-limit, limit, (rows, width))
        if number > 0:
            layer[-1] = 0.0
        pieces.append(layer.ravel())
    return np.concatenate(pieces)


@dataclass(frozen=True, eq=False)
class Workspace:
    """Arrays that every step writes anew: to allocate them each time would take longer than to fill them.

    With members each has one more axis in front.

    Attributes:
        stacks: output of each hidden layer, values (R) above their derivatives by x (P): (R + P, width).
        slopes: 1 - h^2 of each hidden layer (R, width).
        rates: derivative by x of what goes into each hidden layer's tanh (P, width).
        out: the outputs, values above derivatives (R + P, M).
        pull: the loss's derivative by `out`.
        pulls: the loss's derivative by each of `stacks`.
        spare: room for a product of each layer (P, width).
    """

    stacks: list[Array]
    slopes: list[Array]
    rates: list[Array]
    out: Array
    pull: Array
    pulls: list[Array]
    spare: list[Array]


def workspace(
    form: Sequence[tuple[int, int]], rows: int, tangents: int, move: Callable[..., Any], lead: tuple[int, ...] = ()
) -> Workspace:
    """Allocate for layers of these shapes, `rows` times and the derivative at `tangents` of them, for members in `lead`."""
    widths = [width for _, width in form[:-1]]
    total = rows + tangents

    def each(height: int) -> list[Any]:
        return [move(np.zeros((*lead, height, width))) for width in widths]

    out, pull = (move(np.zeros((*lead, total, form[-1][1]))) for _ in range(2))
    return Workspace(each(total), each(rows), each(tangents), out, pull, each(total), each(tangents))


def forward(layers: Sequence[Array], x: Array, work: Workspace, xp: Any) -> Array:
    """Send times through the network, and time derivatives with them.

    With h = tanh(z): dh/dx = (1 - h^2) dz/dx. Values and tangents are rows of one matrix, so that a layer is one product.

    Args:
        layers: one matrix (..., in + 1, out) a layer.
        x: scaled times (R, 1); the first P of them get their derivative as well.
        work: where the results go, and what `backward` needs of them.
        xp: numpy or torch.

    Returns:
        the outputs (..., R + P, M), values above derivatives by x.
    """
    rows = len(x)
    for number, layer in enumerate(layers[:-1]):
        stack, slope, rate = work.stacks[number], work.slopes[number], work.rates[number]
        value = stack[..., :rows, :]
        if number == 0:
            xp.multiply(x, layer[..., :1, :], out=value)
            rate[:] = layer[..., :1, :]
        else:
            xp.matmul(work.stacks[number - 1], layer[..., :-1, :], out=stack)
            rate[:] = stack[..., rows:, :]
        value += layer[..., -1:, :]
        xp.tanh(value, out=value)
        xp.multiply(value, value, out=slope)
        slope *= -1
        slope += 1
        xp.multiply(slope[..., : rate.shape[-2], :], rate, out=stack[..., rows:, :])
    xp.matmul(work.stacks[-1], layers[-1][..., :-1, :], out=work.out)
    work.out[..., :rows, :] += layers[-1][..., -1:, :]
    return work.out


def backward(layers: Sequence[Array], x: Array, work: Workspace, result: Sequence[Array], xp: Any) -> None:
    """Derive the loss by the weights, given its derivative `work.pull` by the outputs.

    Args:
        layers: as in `forward`.
        x: as in `forward`.
        work: as `forward` left it, with `pull` filled.
        result: one matrix a layer, overwritten.
        xp: numpy or torch.
    """
    rows = len(x)
    gradient = work.pull
    for number in range(len(layers) - 1, 0, -1):
        stack, slope, rate = work.stacks[number - 1], work.slopes[number - 1], work.rates[number - 1]
        xp.matmul(stack.mT, gradient, out=result[number][..., :-1, :])
        result[number][..., -1, :] = gradient[..., :rows, :].sum(-2)
        down, spare = work.pulls[number - 1], work.spare[number - 1]
        xp.matmul(gradient, layers[number][..., :-1, :].mT, out=down)
        # A tangent is s(z) z' with s = 1 - h^2; by z it gives -2 h s z'.
        points = rate.shape[-2]
        xp.multiply(stack[..., :points, :], rate, out=spare)
        spare *= down[..., rows:, :]
        spare *= 2
        down[..., :points, :] -= spare
        down[..., :rows, :] *= slope
        down[..., rows:, :] *= slope[..., :points, :]
        gradient = down
    result[0][..., :1, :] = x.mT @ gradient[..., :rows, :]
    result[0][..., 0, :] += gradient[..., rows:, :].sum(-2)
    result[0][..., 1, :] = gradient[..., :rows, :].sum(-2)


# The loss -----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sheet:
    """One set of samples that a network learns: the data and the equation at the collocation times."""

    equation: Equation
    data: Array
    seen: Array


class Problem:
    """The loss of one network and the coefficients, and its gradient, on one trajectory and its mirrored companion.

    For one network on NumPy arrays `...` below is nothing, else it is one axis of members.

    Attributes:
        form: the layers' shapes.
        count: how many weights there are.
        sheets: the sets of samples that share the network (the mirrored one is the second).
        x: scaled collocation times, then scaled sample times (R, 1).
    """

    def __init__(
        self, sheets: Sequence[Samples], library: Library, order: int, size: Scales, settings: PINN, share: float
    ) -> None:
        """Set up the arrays; `share` is this trajectory's part of the whole loss."""
        self.xp, self.move = arrays(settings.device)
        samples = sheets[0]
        start, end = float(samples.t[0]), float(samples.t[-1])
        self.half = (end - start) / 2
        grid = np.linspace(-1, 1, settings.collocation)
        times = start + self.half * (grid + 1)
        self.points = settings.collocation
        self.x = self.move(np.concatenate([grid, (samples.t - start) / self.half - 1])[:, None])
        self.order, self.size = order, size
        parts = 1 + samples.is_complex
        blocks = parts * order
        self.outputs = blocks * samples.sites
        self.units = self.move(np.repeat([size.field, size.velocity][:order], parts * samples.sites))
        self.form = shapes(settings.layers, settings.width, self.outputs * len(sheets))
        self.count = sum(rows * width for rows, width in self.form)
        self.work = workspace(self.form, len(self.x), self.points, self.move, settings.lead)
        self.sheets = []
        # Means over the samples and over the collocation points, shared among the sheets.
        self.data_weight = share * settings.data_weight / len(sheets)
        self.residual_weight = share / len(sheets)
        for one in sheets:
            target = columns(one, order)
            seen = np.isfinite(target)
            # u and v are means of their own, a complex field's two parts add up to |.|^2.
            each = np.concatenate([
                seen[:, k : k + parts * samples.sites] / max(1, np.sum(seen[:, k : k + samples.sites]))
                for k in range(0, self.outputs, parts * samples.sites)
            ], axis=1)  # fmt: skip
            scaled = np.where(seen, target, 0.0) / np.repeat([size.field, size.velocity][:order], parts * samples.sites)
            self.sheets.append(
                Sheet(equation(one, library, order, times, self.xp, self.move), self.move(scaled), self.move(each))
            )

    def split(self, weights: Array) -> list[Array]:
        """Cut the weights (..., count) into one matrix a layer."""
        layers, first = [], 0
        for rows, width in self.form:
            layers.append(weights[..., first : first + rows * width].reshape(*weights.shape[:-1], rows, width))
            first += rows * width
        return layers

    def loss(self, weights: Array, xi: Array, gradient: Array, coefficient_gradient: Array) -> Array:
        """Give the loss (...); write its derivative by the weights and add that by the coefficients xi.

        Args:
            weights: (..., count).
            xi: coefficients in the data's units (..., J).
            gradient: (..., count), overwritten.
            coefficient_gradient: (..., J), added to.
        """
        xp, points, rows = self.xp, self.points, len(self.x)
        layers = self.split(weights)
        out, pull = forward(layers, self.x, self.work, xp), self.work.pull
        total: Array = 0.0
        for number, sheet in enumerate(self.sheets):
            block = slice(number * self.outputs, (number + 1) * self.outputs)
            miss = out[..., points:rows, block] - sheet.data
            weighted = miss * sheet.seen
            total = total + self.data_weight * (weighted * miss).sum((-2, -1))
            pull[..., points:rows, block] = (2 * self.data_weight) * weighted
            total = total + self._residuals(sheet, out, pull, block, xi, coefficient_gradient)
        backward(layers, self.x, self.work, self.split(gradient), xp)
        return total

    def _residuals(
        self, sheet: Sheet, out: Array, pull: Array, block: slice, xi: Array, coefficient_gradient: Array
    ) -> Array:
        points, rows = self.points, len(self.x)
        law, factors = sheet.equation, multipliers(xi)
        fields = out[..., :points, block] * self.units
        rates = out[..., rows:, block] * (self.units / self.half)
        by_fields, by_rates = self.xp.zeros_like(fields), self.xp.zeros_like(rates)
        values = law.terms.function(*law.windows(fields), *factors)
        slopes = values[law.count * law.parts :]
        total: Array = 0.0
        weights = []
        width = law.inner.stop - law.inner.start
        scale = self.residual_weight / (self.size.rate**2 * points * width)
        for part in range(law.parts):
            terms = values[part * law.count : (part + 1) * law.count]
            where = law.rate_columns(part)
            left = rates[..., where] * 1.0
            for x, term in zip(factors, terms, strict=True):
                left -= x * term
            total = total + scale * (left * left).sum((-2, -1))
            left *= 2 * scale
            by_rates[..., where] += left
            coefficient_gradient -= self.xp.stack([(left * term).sum((-2, -1)) for term in terms], -1)
            weights.append(-left)
        law.pull_back(slopes, weights, by_fields)
        if self.order == 2:
            half = law.parts * law.sites
            gap = rates[..., :half] - fields[..., half:]
            scale = self.residual_weight / (self.size.velocity**2 * points * law.sites)
            total = total + scale * (gap * gap).sum((-2, -1))
            gap *= 2 * scale
            by_rates[..., :half] += gap
            by_fields[..., half:] -= gap
        pull[..., :points, block] = by_fields * self.units
        pull[..., rows:, block] = by_rates * (self.units / self.half)
        return total

    def left(self, weights: Array, xi: Array) -> tuple[Array, Array]:
        """Give the sums of squares (...) of rate - library and of the rate, over the collocation points."""
        out = forward(self.split(weights), self.x, self.work, self.xp)
        missed: Array = 0.0
        whole: Array = 0.0
        factors = multipliers(xi)
        for number, sheet in enumerate(self.sheets):
            law = sheet.equation
            block = slice(number * self.outputs, (number + 1) * self.outputs)
            fields = out[..., : self.points, block] * self.units
            rates = out[..., len(self.x) :, block] * (self.units / self.half)
            values = law.terms.function(*law.windows(fields), *factors)
            for part in range(law.parts):
                rate = rates[..., law.rate_columns(part)]
                terms = values[part * law.count : (part + 1) * law.count]
                gap = rate - sum(x * term for x, term in zip(factors, terms, strict=True))
                missed = missed + (gap * gap).sum((-2, -1))
                whole = whole + (rate * rate).sum((-2, -1))
        return missed, whole


def multipliers(xi: Array) -> list[Any]:
    """Give each coefficient as it multiplies a term (..., P, inner): a number for one network, (K, 1, 1) for members."""
    return list(xi.tolist()) if xi.ndim == 1 else [xi[:, k, None, None] for k in range(xi.shape[1])]


def arrays(device: str) -> tuple[Any, Callable[..., Any]]:
    """Give the array package of a device, and what moves a NumPy array there.

    Raises:
        InputError: there is no such device.
    """
    if device == "cpu":
        return np, lambda array: np.ascontiguousarray(array, dtype=float)
    import torch

    try:
        torch.zeros(1, dtype=torch.float64, device=device).cpu()
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).strip().splitlines()[0]
        raise InputError(f"device {device!r}: torch cannot use it in double precision ({reason}); use cpu") from None
    return torch, lambda array: torch.tensor(np.ascontiguousarray(array), dtype=torch.float64, device=device)


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep the linear algebra in one thread, which is fastest at these sizes and gives the same digits each time."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        yield


# Training -----------------------------------------------------------------------------------------------------------------


class Diary:
    """Records the way of the coefficients, of one network or of several members.

    Attributes:
        every: steps between two records.
    """

    def __init__(self, every: int, since: float | None = None) -> None:
        """Start the clock, now or when `time.perf_counter()` was `since`."""
        self.every = every
        self.start = time.perf_counter() if since is None else since
        self.step: list[int] = []
        self.seconds: list[float] = []
        self.loss: list[Any] = []
        self.coefficients: list[ndarray] = []

    def due(self, step: int) -> bool:
        """Say whether a step's turn to be recorded has come."""
        return step >= (self.step[-1] if self.step else -self.every) + self.every

    def note(self, step: int, loss: Any, coefficients: ndarray, *, always: bool = False) -> None:
        """Record a step if its turn has come, or `always`; a step that is there already is left as it is.

        Args:
            step: its number.
            loss: a number, or one a member.
            coefficients: (J,), or one row a member.
            always: whether its turn has come or not.
        """
        if self.due(step) or (always and step > self.step[-1]):
            self.step.append(step)
            self.seconds.append(time.perf_counter() - self.start)
            self.loss.append(loss)
            self.coefficients.append(np.array(coefficients))

    def history(self, member: int | None = None) -> History:
        """Give the records, of one member where there are several."""
        of = ... if member is None else np.s_[:, member]
        return History(
            np.array(self.step, dtype=float),
            np.array(self.seconds),
            np.array(self.loss)[of],
            np.array(self.coefficients)[of],
        )


def adam(
    evaluate_at: Evaluate,
    start: Array,
    steps: int,
    learning_rate: float,
    note: Callable[[int, Any, Array], None],
    xp: Any = np,
) -> Array:
    """Minimise by Adam (Kingma & Ba, 2015), the learning rate falling to 0 along half a cosine."""
    point = start * 1.0
    mean, square = xp.zeros_like(point), xp.zeros_like(point)
    for step in range(steps):
        value, gradient = evaluate_at(point)
        note(step, value, point)
        mean += 0.1 * (gradient - mean)
        square += 0.001 * (gradient * gradient - square)
        rate = learning_rate * 0.5 * (1 + math.cos(math.pi * step / steps)) / (1 - 0.9 ** (step + 1))
        point -= rate * mean / (xp.sqrt(square / (1 - 0.999 ** (step + 1))) + 1e-8)
    return point


def lbfgs(
    evaluate_at: Evaluate, start: ndarray, steps: int, memory: int, note: Callable[[int, float, ndarray], None]
) -> ndarray:
    """Minimise by L-BFGS (SciPy's L-BFGS-B without bounds) for at most `steps` evaluations.

    Where its line search gives up it starts again from the same point with an empty memory, until that does not help.
    """
    from scipy.optimize import minimize

    point, value, done = start, math.inf, 0

    def counted(x: ndarray) -> tuple[float, ndarray]:
        nonlocal done
        done += 1
        return evaluate_at(x)

    def accepted(intermediate_result: Any) -> None:
        note(done, float(intermediate_result.fun), intermediate_result.x)

    while done < steps:
        options = {"maxcor": memory, "maxfun": steps - done, "maxiter": steps, "maxls": 30, "ftol": 0.0, "gtol": 0.0}
        found = minimize(counted, point, jac=True, method="L-BFGS-B", callback=accepted, options=options)
        better = float(found.fun) < value
        if better:
            point, value = np.asarray(found.x), float(found.fun)
        if found.nit < 2 or not better:
            break
    return point


# Tries of a line search before it gives up.
SEARCH = 30


def lockstep(
    evaluate_at: Evaluate, start: Array, steps: int, memory: int, note: Callable[[int, Any, Array], None], xp: Any
) -> Array:
    """Minimise the losses of several members by L-BFGS, each on its own way, with one evaluation for all at a time.

    Each member looks for a step with the weak Wolfe conditions by bisection and doubling (Lewis & Overton, Math. Program. 141,
    135 (2013)). One that found it moves on while the others still look; what it does not add in that round is an
    empty pair in the shared memory. One whose search ends in nothing starts again downhill with an empty memory, once.

    Args:
        evaluate_at: gives the losses (K,) and gradients (K, n) at the points (K, n).
        start: the points (K, n).
        steps: most evaluations.
        memory: how many pairs are remembered.
        note: is told the evaluation's number, the losses and the points.
        xp: numpy or torch.
    """

    def dot(a: Array, b: Array) -> Array:
        return xp.einsum("kn,kn->k", a, b)

    point = start * 1.0
    value, gradient = evaluate_at(point)
    pairs = [(xp.zeros_like(point), xp.zeros_like(point), xp.zeros_like(value)) for _ in range(memory)]
    zero, one = xp.zeros_like(value), xp.ones_like(value)
    size = zero
    way, slope = -gradient, -dot(gradient, gradient)
    # The first step has length 1 at most.
    length = 1 / xp.sqrt(xp.where(slope < -1, -slope, one))
    low, high = zero, zero + math.inf
    fresh, alive, tries = zero == 0, slope < 0, zero
    for done in range(1, steps):
        trial = point + xp.where(alive, length, zero)[:, None] * way
        lower, steeper = evaluate_at(trial)
        rise = dot(steeper, way)
        short = alive & (lower <= value + 1e-4 * length * slope)
        found = short & (rise >= 0.9 * slope)
        low, high = xp.where(short, length, low), xp.where(alive & ~short, length, high)
        if bool(found.any()):
            moved = xp.where(found, length, zero)[:, None] * way
            turned = xp.where(found[:, None], steeper - gradient, xp.zeros_like(gradient))
            product, square = dot(moved, turned), dot(turned, turned)
            curved = product > 1e-14 * square
            weight = xp.where(curved, 1 / xp.where(curved, product, one), zero)
            pairs = [*pairs[1:], (moved, turned, weight)]
            size = xp.where(curved, product / xp.where(curved, square, one), size)
            value, point = xp.where(found, lower, value), point + moved
            gradient = xp.where(found[:, None], steeper, gradient)
            note(done, value, point)
            ahead = -_inverse(pairs, size, gradient, dot)
            way = xp.where(found[:, None], ahead, way)
        slope = dot(gradient, way)
        # Nothing found in many tries, or no way down: forget the pairs and go downhill, once.
        tries = xp.where(found, zero, tries + 1)
        lost = alive & ((tries >= SEARCH) | (slope >= 0))
        if bool(lost.any()):
            alive = alive & ~(lost & fresh & ~found)
            keep = xp.where(lost, zero, one)
            pairs = [(moved, turned, weight * keep) for moved, turned, weight in pairs]
            way = xp.where(lost[:, None], -gradient, way)
            slope = xp.where(lost, -dot(gradient, gradient), slope)
            alive, tries = alive & (slope < 0), xp.where(lost, zero, tries)
            if not bool(alive.any()):
                break
        fresh = xp.where(found | lost, lost, fresh)
        middle = xp.where(xp.isinf(high), 2 * length, (low + high) / 2)
        downhill = 1 / xp.sqrt(xp.where(slope < -1, -slope, one))
        length = xp.where(lost, downhill, xp.where(found, one, middle))
        low, high = xp.where(found | lost, zero, low), xp.where(found | lost, zero + math.inf, high)
    return point


def _inverse(
    pairs: Sequence[tuple[Array, Array, Array]], size: Array, gradient: Array, dot: Callable[..., Any]
) -> Array:
    """Multiply by the inverse Hessian that the pairs approximate (Nocedal & Wright, Numerical Optimization, algorithm 7.4)."""
    left = gradient * 1.0
    shares = []
    for moved, turned, weight in reversed(pairs):
        shares.append(weight * dot(moved, left))
        left -= shares[-1][:, None] * turned
    left *= size[:, None]
    for (moved, turned, weight), share in zip(pairs, reversed(shares), strict=True):
        left += (share - weight * dot(turned, left))[:, None] * moved
    return left


@dataclass(frozen=True)
class PINN:
    """The paper's network; see the module for its loss.

    Attributes:
        layers, width: hidden layers and tanh units in each (the paper's 3 and 40).
        mirror: learn the samples of -u in the same network, too (the paper's data augmentation for even terms).
        collocation: evenly spaced times, ends included, at which the equation is asked for.
        data_weight: weight of the samples against the equation, both as shares of their own size.
        frequency: the first layer's weights and biases start uniform in +- this, in radians per half the time span.
        coefficient_scale: unit of a coefficient in the optimisers, in multiples of the one at which its term alone is as
            large as the rate. Terms of a lattice cancel each other to a tenth or less, so that coefficients are large in
            units of 1 and would lag behind the weights.
        adam_steps, learning_rate: steps of Adam, and its first learning rate; it falls to 0 along half a cosine.
        lbfgs_steps, memory: evaluations of L-BFGS, and how many steps it remembers.
        record: steps between two records of the coefficients.
        device: cpu, or a device of torch's such as cuda; cpu:0 is torch on the processor.
        members: networks with different first weights; the one with the least loss is the fit, and `found` has the standard
            deviation of each coefficient over them. On a device they take one step together and L-BFGS is `lockstep`; eight
            of them cost 0.74 of eight single ones on torch with one thread of a processor. On NumPy arrays one trains after
            the other, as a batch of eight cost 1.26 there.

    Raises:
        InputError: a number is too small.
    """

    name: ClassVar[str] = "pinn"
    layers: int = 3
    width: int = 40
    mirror: bool = False
    collocation: int = 201
    data_weight: float = 100.0
    frequency: float = 3.0
    coefficient_scale: float = 10.0
    adam_steps: int = 1000
    learning_rate: float = 3e-3
    lbfgs_steps: int = 7000
    memory: int = 20
    record: int = 100
    device: str = "cpu"
    members: int = 1

    def __post_init__(self) -> None:
        """Check the settings."""
        for name, least in (
            ("layers", 1), ("width", 1), ("collocation", 2), ("adam_steps", 0), ("lbfgs_steps", 0), ("memory", 1), ("record", 1),
            ("members", 1),
        ):  # fmt: skip
            if getattr(self, name) < least:
                raise InputError(
                    f"method {self.name!r}: setting {name} = {getattr(self, name)!r}; it must be at least {least}"
                )
        for name in ("data_weight", "frequency", "coefficient_scale", "learning_rate"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"method {self.name!r}: setting {name} = {value!r}; it must be a number above 0")

    @property
    def lead(self) -> tuple[int, ...]:
        """The axes in front of a network's own: one of members on a device, none on NumPy arrays."""
        return () if self.device == "cpu" else (self.members,)

    @property
    def abilities(self) -> Abilities:
        """Everything but the truth."""
        return Abilities(missing=True, loads=() if self.device == "cpu" else ("torch",))

    def fit(self, data: Sequence[Samples], library: Library, order: int, seed: int) -> Fit:
        """Train weights and coefficients together; several trajectories have networks of their own and share coefficients.

        Raises:
            InputError: torch does not have the device.
        """
        size = scales(data, library, order)
        problems = [
            Problem([s, s.mirrored()] if self.mirror else [s], library, order, size, self, 1 / len(data)) for s in data
        ]
        units = problems[0].move(self.coefficient_scale * size.coefficients())
        draws = member_draws(seed, self.members)
        since = time.perf_counter()
        with one_thread(), np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            ends = [
                end
                for group in ([draws] if self.lead else [[draw] for draw in draws])
                for end in self._train(problems, group, units, since)
            ]
        best = ends[best_member(np.array([end.loss for end in ends]))]
        found = {"loss": best.loss, **spread(np.array([end.coefficients for end in ends]), library)}
        return Fit(self.name, library, order, best.coefficients, best.residual, history=best.history, found=found)

    def _train(
        self, problems: Sequence[Problem], draws: Sequence[np.random.Generator], units: Array, since: float
    ) -> list[End]:
        """Train one network, or the members of a batch; `units` are those of the coefficients in the optimisers."""
        xp, move = problems[0].xp, problems[0].move
        bounds = [0, *itertools.accumulate(problem.count for problem in problems)]
        first_weights = [
            np.concatenate([initial_weights(problem.form, self.frequency, draw) for problem in problems])
            for draw in draws
        ]
        start = np.pad(np.stack(first_weights), ((0, 0), (0, len(units))))
        theta = move(start.reshape(*self.lead, -1))
        diary = Diary(self.record, since)

        def coefficients(point: Array) -> Array:
            return point[..., bounds[-1] :] * units

        def value_and_gradient(point: Array) -> tuple[Array, Array]:
            gradient, xi = xp.zeros_like(point), coefficients(point)
            by_coefficients = xp.zeros_like(xi)
            total = 0.0
            for problem, first, last in zip(problems, bounds[:-1], bounds[1:], strict=True):
                total = total + problem.loss(point[..., first:last], xi, gradient[..., first:last], by_coefficients)
            gradient[..., bounds[-1] :] = by_coefficients * units
            return total, gradient

        def note(step: int, loss: Array, point: Array) -> None:
            if diary.due(step):
                diary.note(step, host(loss), host(coefficients(point)))

        def later(step: int, loss: Array, point: Array) -> None:
            note(self.adam_steps + step, loss, point)

        theta = adam(value_and_gradient, theta, self.adam_steps, self.learning_rate, note, xp)
        if self.lead:
            theta = lockstep(value_and_gradient, theta, self.lbfgs_steps, self.memory, later, xp)
        else:
            theta = lbfgs(value_and_gradient, theta, self.lbfgs_steps, self.memory, later)
        loss, xi = host(value_and_gradient(theta)[0]), coefficients(theta)
        diary.note(self.adam_steps + self.lbfgs_steps, loss, host(xi), always=True)
        parts = [
            problem.left(theta[..., first:last], xi)
            for problem, first, last in zip(problems, bounds[:-1], bounds[1:], strict=True)
        ]
        missed, whole = (host(sum(part[k] for part in parts)) for k in range(2))
        residual = np.sqrt(np.where(whole > 0, missed / whole, missed))
        return [
            End(float(loss[of]), host(xi)[of], float(residual[of]), diary.history(of[0] if of else None))
            for of in np.ndindex(*self.lead)
        ]


class End(NamedTuple):
    """Where a member ended: its loss, coefficients, residual and way there."""

    loss: float
    coefficients: ndarray
    residual: float
    history: History


def host(array: Array) -> ndarray:
    """Bring an array, or a number, from its device."""
    return np.asarray(array.cpu() if hasattr(array, "cpu") else array)


def member_draws(seed: int, members: int) -> list[np.random.Generator]:
    """Give each member's generator; the first is that of one network alone."""
    return [np.random.default_rng([seed, member] if member else seed) for member in range(members)]


def best_member(loss: Float[ndarray, " member"]) -> int:
    """Say which member has the least loss; one whose loss is not finite is not it, unless all are so."""
    return int(np.argmin(np.where(np.isfinite(loss), loss, np.inf)))


def spread(coefficients: Float[ndarray, "member terms"], library: Library) -> dict[str, float]:
    """Give the members' number and the standard deviation of each coefficient over them, in its units; nothing for one."""
    if len(coefficients) == 1:
        return {}
    deviations = np.std(coefficients, axis=0, ddof=1)
    names = (f"spread of {text}" for text in library.texts)
    return {"members": float(len(coefficients)), **dict(zip(names, deviations.tolist(), strict=True))}


METHODS = (PINN,)
