"""Where a search begins: numbers of a model by regression over smoothed readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting import Placed
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import GAP, Problem
from latticebench.systems.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float
    from numpy import ndarray

# The strongest lines of the spectrum that a force from outside may sustain, and how many of them at once.
LINES, AT_ONCE = 4, 3


def regressed(problem: Problem) -> tuple[tuple[float, ...], float]:
    """Return the declared coefficients that carry the smoothed states over a quarter of the shortest period.

    Each site has a constant force besides, so that a sensor's offset does no harm. With the coefficients comes the
    share of the forces' work that they leave (root mean square).

    Raises:
        InputError: a declared term is not finite along them.
    """
    design, target = _carrying(problem)
    found, left = _solved(design, target)
    return tuple(found.tolist()), left


def sustained(problem: Problem) -> list[Model]:
    """Return the declared equation with forces from outside at lines of the spectrum.

    There are models with the best line, the best two and the best three, and one with each other line alone. A steady
    swing may be the chain's own or a force's: of two lines of a single site either may be the one or the other, and
    only what is not linear, or decays, tells them apart. Where forces make the strongest lines, coefficients that take
    these for the chain's own are far from right, and no short way leads from them to those that are.

    Raises:
        InputError: a declared term is not finite along the smoothed states.
    """
    waves: dict[tuple[object, ...], Placed] = {}
    for one in problem.candidates:
        if one.frequency is not None and not (one.instrument or one.general):
            waves.setdefault(one.place, one)
    lines = [problem.spectrum.between(peak) for peak in problem.spectrum.peaks[:LINES]]
    offered = [one.tuned(line) for line in lines for one in waves.values()]
    plain = Model(problem.declared, problem.order, (0.0,) * len(problem.declared.terms), tuple(offered))
    design, target = _carrying(problem, offered)
    declared = np.arange(len(plain.coefficients))
    columns = [
        np.arange(block.start, block.start + len(one.strength))
        for one, block in zip(offered, plain.blocks, strict=True)
    ]

    def with_lines(chosen: Sequence[int]) -> Model:
        kept, numbers = np.concatenate([declared, *(columns[k] for k in chosen)]), plain.numbers
        numbers[kept] = _solved(design[:, kept], target)[0]
        model = plain.moved(numbers)
        return replace(model, effects=tuple(model.effects[k] for k in chosen))

    def shares(chosen: Sequence[int]) -> dict[int, float]:
        """Return what each further line would leave of what the chosen ones leave, the least of each frequency."""
        done = np.linalg.qr(design[:, np.concatenate([declared, *(columns[k] for k in chosen)])])[0]
        left, more = (one - done @ (done.T @ one) for one in (target, design))
        best: dict[float | None, tuple[float, int]] = {offered[k].frequency: (0.0, -1) for k in chosen}
        for k, one in enumerate(offered):
            share = _solved(more[:, columns[k]], left)[1]
            best[one.frequency] = min(best.get(one.frequency, (np.inf, -1)), (share, k))
        return {k: share for share, k in sorted(best.values()) if k >= 0 and share <= 1 - rules.SHARE}

    alone = list(shares([]))
    chosen, found = alone[:1], [with_lines(alone[:1])] if alone else []
    while chosen and len(chosen) < AT_ONCE and (more := shares(chosen)):
        chosen.append(next(iter(more)))
        found.append(with_lines(chosen))
    return [*found, *(with_lines([k]) for k in alone[1:])]


def _whole(times: Float[ndarray, " time"], window: int, step: float) -> Bool[ndarray, " windows"]:
    """Return which stretches of so many steps hold no gap."""
    return np.asarray(times[window:] - times[:-window] < GAP * window * step)


def _solved(design: Float[ndarray, "rows numbers"], target: Float[ndarray, " rows"]) -> tuple[ndarray, float]:
    """Return the solution of least squares, and the share of the target that it leaves (root mean square)."""
    size = np.sqrt(np.mean(design**2, axis=0))
    size[size == 0] = 1.0
    found = np.linalg.lstsq(design / size, target, rcond=1e-6)[0] / size
    left = float(np.linalg.norm(target - design @ found) / max(float(np.linalg.norm(target)), 1e-300))
    return found, left


def _carrying(problem: Problem, effects: Sequence[Placed] = ()) -> tuple[ndarray, ndarray]:
    """Return what each number of a model would carry the smoothed states by, and by what they are carried.

    That is over a quarter of the shortest period, at each site less its mean: (rows, numbers) and (rows,).

    Raises:
        InputError: a declared term is not finite along the smoothed states.
    """
    from scipy.interpolate import make_interp_spline

    model = Model(problem.declared, problem.order, (0.0,) * len(problem.declared.terms), tuple(effects))
    designs, targets = [], []
    window = max(1, round(np.pi / 2 / problem.top / problem.step))
    for number, (record, nodes, splines) in enumerate(
        zip(problem.records, problem.nodes, problem.splines, strict=True)
    ):
        assembled = model.assembled(problem.plain, problem.chain, number)
        stretches, dynamics = record.stretches, assembled.dynamics
        f = None if stretches.inputs is None else stretches.inputs(record.times)
        driven = stretches.driven(record.times, splines)
        with np.errstate(all="ignore"):
            values = dynamics.linear(assembled.coefficients, record.times, nodes, f, driven, derivatives=False)[1]
        finite = np.isfinite(values).all(axis=(0, 2, 3))
        for term, sound in zip(problem.plain.terms, finite, strict=False):
            if not sound:
                raise InputError(f"the declared term {term.text} is infinite along the readings; check their unit")
        # An effect's term that is infinite somewhere carries nothing, and so is not chosen.
        values[:, ~finite] = 0.0
        values = np.einsum("tk,ptbm->kbpm", assembled.slope, values, optimize=True)
        rate = nodes.reshape(len(nodes), dynamics.order, dynamics.parts, dynamics.count)[:, -1]
        # No window holds a gap; where there are only bursts, windows are shorter.
        while not np.any(whole := _whole(record.times, window, problem.step)) and window > 1:
            window //= 2
        designs.append(np.empty((int(np.sum(whole)) * rate[0].size, len(values))))
        for column, value in enumerate(values):
            curve = make_interp_spline(record.times, value, k=min(3, len(record.times) - 1))
            total = curve.antiderivative()(record.times)
            flow = (total[window:] - total[:-window])[whole]
            designs[-1][:, column] = (flow - np.mean(flow, axis=0)).ravel()
        gone = (rate[window:] - rate[:-window])[whole]
        targets.append((gone - np.mean(gone, axis=0)).ravel())
    return np.concatenate(designs), np.concatenate(targets)
