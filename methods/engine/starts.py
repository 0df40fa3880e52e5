"""Where a fit of whole trajectories starts: smoothed states, and coefficients that roughly carry them along.

`guess` needs nothing but the samples. `from_weak_form` takes the coefficients of the weak form instead, and `approach`
improves the guess by fits to pieces of the trajectories. `following` then lets the states follow the motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.methods.engine.border import fit_border
from latticebench.methods.engine.derivatives import DEGREE, differentiate
from latticebench.methods.engine.errors_in_variables import sparse_estimate
from latticebench.methods.engine.record import Record
from latticebench.methods.engine.scaled import lstsq
from latticebench.methods.engine.shooting import State, maximise
from latticebench.methods.engine.weak_form import WeakForm
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Steps in which the states are to come to follow a motion.
FOLLOW = 20
# Lengths of the pieces that are fitted before the whole, as shares of a trajectory, and their least number of samples
# where u and v are observed.
PIECES = (0.1, 0.3)
GRADUAL_PIECES = (0.1, 0.2, 0.3, 0.5)
MIN_PIECE = 3


def smooth(samples: Samples, order: int) -> tuple[Float[ndarray, "time sites"], Float[ndarray, "time sites"] | None]:
    """Estimate u and, for order 2, v at all sample times by smoothing splines, with gaps bridged by cubics.

    Raises:
        InputError: the times are too uneven for a spline.
    """
    t = samples.t
    try:
        u, slope = _filled(t, samples.u)
        if order == 1:
            return u, None
        return u, (slope if samples.v is None else _filled(t, samples.v)[0])
    except InputError as error:
        raise InputError(f"{samples.source}: {error}") from None


def _filled(t: ndarray, field: ndarray) -> tuple[ndarray, ndarray]:
    """Return a smoothed field and its slope, without gaps."""
    if np.iscomplexobj(field):
        pairs = [_filled(t, part) for part in (field.real, field.imag)]
        return pairs[0][0] + 1j * pairs[1][0], pairs[0][1] + 1j * pairs[1][1]
    if len(t) > DEGREE:
        found = differentiate(t, field, "smoothing-spline")
        value, slope = found.value.copy(), found.first.copy()
    else:
        value, slope = field.copy(), np.full(field.shape, np.nan)
    for site in range(field.shape[1]):
        known = np.isfinite(value[:, site]) & np.isfinite(slope[:, site])
        if np.all(known):
            continue
        if np.sum(known) > 1:
            value[:, site], slope[:, site] = _bridged(t, value[:, site], slope[:, site], np.flatnonzero(known))
            continue
        seen = np.flatnonzero(np.isfinite(field[:, site]))
        value[:, site] = np.interp(t, t[seen], field[seen, site]) if len(seen) else np.nan
        slope[:, site] = np.gradient(value[:, site], t)
    # A site that was never observed moves as its nearest neighbours do.
    unseen = np.all(np.isnan(value), axis=0)
    for lost in np.flatnonzero(unseen):
        others = np.flatnonzero(~unseen)
        nearest = others[np.argsort(np.abs(others - lost))[:2]]
        value[:, lost] = np.mean(value[:, nearest], axis=1)
        slope[:, lost] = np.mean(slope[:, nearest], axis=1)
    return value, slope


def _bridged(t: ndarray, value: ndarray, slope: ndarray, known: ndarray) -> tuple[ndarray, ndarray]:
    """Fill the gaps of a series by cubics through its known values and slopes, and hold it constant beyond them."""
    from scipy.interpolate import CubicHermiteSpline

    curve = CubicHermiteSpline(t[known], value[known], slope[known])
    filled, slopes = curve(t), curve(t, 1)
    # A cubic runs away beyond its data.
    for outside, edge in ((t < t[known[0]], known[0]), (t > t[known[-1]], known[-1])):
        filled[outside], slopes[outside] = filled[edge], 0.0
    return filled, slopes


def guess(data: Sequence[Samples], records: Sequence[Record]) -> State:
    """Return smoothed states, with the coefficients that best carry each of them to the next.

    Raises:
        InputError: a term is not finite along the smoothed states.
    """
    nodes: list[ndarray] = []
    splines: list[ndarray | None] = []
    for samples, record in zip(data, records, strict=True):
        dynamics, drive = record.stretches.dynamics, record.stretches.drive
        nodes.append(dynamics.pack(*smooth(samples, dynamics.order)))
        splines.append(None if drive is None else fit_border(drive, samples, dynamics))
    state = State(np.zeros(len(records[0].stretches.dynamics.terms)), tuple(nodes), tuple(splines))
    return replace(state, coefficients=_carrying(data, records, state))


def _carrying(data: Sequence[Samples], records: Sequence[Record], state: State) -> Float[ndarray, " terms"]:
    """Return the coefficients by least squares on the integrals of the terms along the states.

    v(t_l) - v(t_k) = sum_j xi_j * (integral of T_j from t_k to t_l), likewise for u at order 1; integrals suffer less
    from noise than derivatives do.
    """
    from scipy.interpolate import make_interp_spline

    designs, targets = [], []
    for samples, record, nodes, splines in zip(data, records, state.nodes, state.splines, strict=True):
        stretches = record.stretches
        dynamics = stretches.dynamics
        f = None if stretches.inputs is None else stretches.inputs(record.times)
        driven = stretches.driven(record.times, splines)
        values = dynamics.linear(state.coefficients, record.times, nodes, f, driven, derivatives=False)[1]
        for j in np.flatnonzero(~np.isfinite(values).all(axis=(0, 2, 3))):
            raise InputError(f"{samples.source}: the term {dynamics.terms[j]} is not finite there; leave it out")
        curve = make_interp_spline(record.times, np.moveaxis(values, 2, 0), k=min(3, len(record.times) - 1))
        total = curve.antiderivative()(record.times)
        rate = nodes.reshape(len(nodes), dynamics.order, dynamics.parts, dynamics.count)[:, -1]
        window = max(1, len(record.times) // 10)
        designs.append(np.moveaxis(total[window:] - total[:-window], 2, -1).reshape(-1, values.shape[1]))
        targets.append((rate[window:] - rate[:-window]).ravel())
    design, target = np.concatenate(designs), np.concatenate(targets)
    # Directions that the smoothed states barely show start at 0; the fit finds them.
    return lstsq(design, target, rcond=1e-4)


def from_weak_form(
    data: Sequence[Samples], records: Sequence[Record], library: Library, order: int, seed: int
) -> State | None:
    """Return smoothed states with the coefficients of the sparse weak form; None where it finds none."""
    try:
        forms = [WeakForm(samples, library, order) for samples in data]
        coefficients = sparse_estimate(forms, seed=seed)[0].coefficients
    except (InputError, np.linalg.LinAlgError):
        return None
    return replace(guess(data, records), coefficients=coefficients) if np.any(coefficients) else None


def following(records: Sequence[Record], state: State) -> State:
    """Let the states follow the motion with the coefficients held; the same state where no such motion is found.

    The first step from noisy states would take their noise for motion, and draw the coefficients towards zero.
    """
    found = maximise(records, state, steps=FOLLOW, tolerance=0.1, held=True)
    return found.state if found.converged else state


def approach(
    data: Sequence[Samples], records: Sequence[Record], steps: int, lengths: Sequence[float] = PIECES
) -> State:
    """Improve the guess by fits to pieces of the trajectories, from short to long ones.

    A short piece has a start of its own, so that poor coefficients cannot lead its states far astray; longer pieces
    determine the coefficients better. The last fit, to whole trajectories, is left to the caller.

    Args:
        data: the samples.
        records: the same with the equation set up.
        steps: largest number of Gauss-Newton steps per fit.
        lengths: of the pieces, as shares of a trajectory.
    """
    state = guess(data, records)
    for length in lengths:
        pieces, nodes, splines = [], [], []
        for record, along, drive in zip(records, state.nodes, state.splines, strict=True):
            count = len(record.times)
            least = MIN_PIECE if record.value.shape[1] == record.stretches.dynamics.order else 2 * MIN_PIECE
            cuts = np.linspace(0, count, max(1, count // max(least, round(count * length))) + 1).round().astype(int)
            for begin, end in itertools.pairwise(cuts.tolist()):
                pieces.append(record.piece(begin, end))
                nodes.append(along[begin:end])
                splines.append(drive)
        if len(pieces) == len(records):
            break
        start = replace(state, nodes=tuple(nodes), splines=tuple(splines))
        found = maximise(pieces, start, steps=steps, tolerance=0.3).state
        if not np.all(np.isfinite(found.coefficients)):
            break
        joined = np.split(np.concatenate(found.nodes), np.cumsum([len(one) for one in state.nodes])[:-1])
        state = replace(state, coefficients=found.coefficients, nodes=tuple(joined))
    return state
