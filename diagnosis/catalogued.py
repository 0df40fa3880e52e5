"""The candidates of each effect of the catalogue: where, at which frequency, time or delay it may act."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, get_args

import numpy as np

from latticebench.diagnosis.candidate import Candidate, as_candidate, places, too_wide
from latticebench.diagnosis.model import pace
from latticebench.diagnosis.placed import PlacedEffect, far_matrix
from latticebench.diagnosis.residual import of_dynamics
from latticebench.diagnosis.tangent import Path, Tangent, force_along, own_forces
from latticebench.systems.effects import Effect
from latticebench.systems.errors import InputError
from latticebench.systems.stencil import Ends
from latticebench.systems.terms import Term, express

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Frequencies searched where the record is short; the strongest lines of the residual where it is long.
MOST_FREQUENCIES = 120
# Lines of a long record's residual that are looked at.
LINES = 12
LONG = 400
PULSES, WIDTHS = 24, (0.02, 0.05, 0.12)
DELAYS = 10
# In radians of the motion's own frequency: by less, the past is the present and its derivatives.
SHORTEST_DELAY = 0.5
POWERS = tuple(np.arange(0.5, 5.1, 0.25))
FARTHEST, FARTHEST_OPEN = 8, 24
# Rounding that makes this share of the noise's variance is named: that readings lie on a grid is no accident, whatever
# the residual.
ROUNDED = 1 / 3


def candidates_of(tangent: Tangent, effect: Effect) -> list[Candidate]:
    """Return the candidates of an effect."""
    make: dict[str, Callable[[Tangent, Effect], list[Candidate | None]]] = {
        "harmonic": _harmonic, "pulse": _pulse, "delayed": _remembered, "long range": _far, "one site": _sited,
        "every site": _disordered, "one equation": _unequal, "ends": _ended, "offset": _instrumental,
        "gain": _instrumental, "curve": _instrumental, "clock": _clock, "rounding": _quantised,
    }  # fmt: skip
    return [one for one in make.get(effect.acts, _everywhere)(tangent, effect) if one is not None]


def _terms_of(tangent: Tangent, effect: Effect) -> tuple[str, ...]:
    """Return the effect's terms on this lattice, as far as they can be evaluated."""
    samples = tangent.fitted.data[0]
    dynamics = tangent.paths[0].record.stretches.dynamics
    texts = effect.texts(dynamics.order, samples.is_complex)
    for text in texts:
        term = Term(text)
        if "f" in term.names and any(path.force is None for path in tangent.paths):
            return ()
        if too_wide(term, dynamics):
            return ()
    return texts


def _force_columns(tangent: Tangent, placed: PlacedEffect) -> ndarray:
    """Return the columns of an effect's forces."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    return tangent.columns(
        lambda k, path: path.answer(force_along(path, placed.forces(dynamics.sites, dynamics.is_complex, k)))
    )


def _everywhere(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    texts = _terms_of(tangent, effect)
    placed = PlacedEffect(effect, texts)
    return [as_candidate(tangent, placed, _force_columns(tangent, placed))] if texts else []


def frequencies(tangent: Tangent) -> ndarray:
    """Return the angular frequencies that a drive is searched at.

    For pieces of a record these are the frequencies that the whole record tells apart.
    """
    times = np.unique(np.concatenate([path.record.times for path in tangent.paths]))
    span = float(times[-1] - times[0])
    highest = np.pi / float(np.median([step for path in tangent.paths for step in np.diff(path.record.times)]))
    if len(times) <= LONG:
        # Less than a whole wave is no wave.
        count = int(min(MOST_FREQUENCIES, 2 * span * highest / np.pi))
        return np.linspace(2 * np.pi / span, highest, max(count, 2))
    found = []
    for t, series in _records(tangent):
        even = np.linspace(t[0], t[-1], len(t))
        # Twice as long as it is: a line between two frequencies is seen as well.
        omega = 2 * np.pi * np.fft.rfftfreq(2 * len(t), even[1] - even[0])
        for parts in series:
            evenly = np.stack([np.interp(even, t, part) for part in parts.T])
            power = np.sum(np.abs(np.fft.rfft(evenly * np.hanning(len(t)), 2 * len(t))) ** 2, axis=0)
            peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:])) + 1
            peaks = peaks[omega[peaks] >= 2 * np.pi / span]
            found.append(omega[peaks[np.argsort(-power[peaks])[:LINES]]])
    return np.unique(np.concatenate(found))


def _records(tangent: Tangent) -> list[tuple[Float[ndarray, " time"], list[Float[ndarray, "time parts"]]]]:
    """Return the times of each record, and the series that may show the line of a drive there, averaged over the sites.

    These are what is left of the readings and, since that of pieces has the lines of how they were cut, too, what the
    model's terms with any coefficients leave of the highest derivative: by itself (a drive) and times the field (a
    parametric one). Pieces that follow each other in time are of one record.
    """
    records: list[list[int]] = []
    paths = tangent.paths
    for number, path in enumerate(paths):
        if not records or path.record.times[0] < paths[number - 1].record.times[-1]:
            records.append([])
        records[-1].append(number)
    left = tangent.fitted.residuals()
    try:
        smoothed = of_dynamics(tangent.fitted)
    except InputError:
        # Pieces of so few readings cannot be smoothed.
        smoothed = []
    found = []
    for numbers in records:
        times = np.concatenate([paths[k].record.times for k in numbers])
        readings = np.mean(np.concatenate([left[k][:, 0] for k in numbers]), axis=-1)
        if not smoothed:
            found.append((times, [readings]))
            continue
        whole = np.concatenate([np.nan_to_num(smoothed[k].left) for k in numbers])
        terms = np.concatenate([own_forces(paths[k])[:, :: paths[k].steps] for k in numbers], axis=1).reshape(
            -1, whole.size
        )
        missing = (whole.ravel() - terms.T @ np.linalg.lstsq(terms.T, whole.ravel(), rcond=None)[0]).reshape(
            whole.shape
        )
        moving = paths[numbers[0]].record.stretches.dynamics.moving
        field = np.concatenate([paths[k].field[:: paths[k].steps, 0][..., moving] for k in numbers])
        if paths[0].is_complex:
            product = (field[:, 0] - 1j * field[:, 1]) * (missing[:, 0] + 1j * missing[:, 1])
            times_field = np.stack([product.real, product.imag], axis=1)
        else:
            times_field = field * missing
        found.append((times, [readings, np.mean(missing, axis=-1), np.mean(times_field, axis=-1)]))
    return found


def _harmonic(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    texts = _terms_of(tangent, effect)
    if not texts:
        return []
    omegas = frequencies(tangent)
    effects = [PlacedEffect(effect, texts, {"omega": float(omega)}) for omega in omegas]
    return _in_one_go(tangent, effects)


def _pulse(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    texts = _terms_of(tangent, effect)
    if not texts:
        return []
    effects = []
    for path in tangent.paths:
        times = path.record.times
        span = float(times[-1] - times[0])
        for width in WIDTHS:
            size = max(width * span, float(np.median(np.diff(times))))
            effects += [
                PlacedEffect(effect, texts, {"at": float(at), "width": size})
                for at in np.linspace(times[0] + span / PULSES / 2, times[-1] - span / PULSES / 2, PULSES)
            ]
    return _in_one_go(tangent, effects)


def _in_one_go(tangent: Tangent, effects: Sequence[PlacedEffect]) -> list[Candidate | None]:
    """Return candidates of equally many forces each; their columns are computed in one go."""
    if not effects:
        return []
    dynamics = tangent.paths[0].record.stretches.dynamics

    def columns(number: int, path: Path) -> ndarray:
        every = [force for placed in effects for force in placed.forces(dynamics.sites, dynamics.is_complex, number)]
        return path.answer(force_along(path, every))

    found = tangent.columns(columns)
    each = found.shape[1] // len(effects)
    return [as_candidate(tangent, placed, found[:, k * each : (k + 1) * each]) for k, placed in enumerate(effects)]


def _remembered(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    texts = _terms_of(tangent, effect)
    if not texts:
        return []
    past = _past_fields(tangent)
    return _in_one_go(
        tangent, [PlacedEffect(effect, texts, {"delay": float(delay)}, past=past) for delay in lags(tangent)]
    )


def lags(tangent: Tangent) -> list[float]:
    """Return the delays that a memory is searched at; none where the record is too short for any."""
    times = tangent.paths[0].record.times
    span, step = float(times[-1] - times[0]), float(np.median(np.diff(times)))
    shortest = max(1.5 * step, SHORTEST_DELAY / max(pace((path.times, path.field) for path in tangent.paths), 1e-300))
    return [] if shortest >= span / 3 else [float(delay) for delay in np.geomspace(shortest, span / 3, DELAYS)]


def _past_fields(tangent: Tangent) -> tuple[Callable[[ndarray], ndarray], ...]:
    """Return the fitted field of each trajectory at any time; before the record it is what it was at its beginning."""
    paths = tangent.paths
    if len(paths) > 1 and all(a.times[-1] < b.times[0] for a, b in itertools.pairwise(paths)):
        # Pieces of one record know each other's past.
        return (_past_field(paths),) * len(paths)
    return tuple(_past_field([path]) for path in paths)


def _past_field(paths: Sequence[Path]) -> Callable[[ndarray], ndarray]:
    from scipy.interpolate import CubicSpline

    times = np.concatenate([path.times for path in paths])
    curve = CubicSpline(times, np.concatenate([path.fields()[0] for path in paths]))
    return lambda t: np.asarray(curve(np.clip(t, times[0], times[-1])))


def _far(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    texts = _terms_of(tangent, effect)
    dynamics = tangent.paths[0].record.stretches.dynamics
    sites = dynamics.sites
    if not texts or dynamics.ends == "unknown" or sites < 4:
        return []
    # With the couplings that the ends repeat, and between the sites that there are; on a ring both are the same.
    repeated = [
        PlacedEffect(effect, texts, {"s": float(s), "reach": float(min(FARTHEST, sites - 1)), "open": 0.0})
        for s in POWERS
    ]
    between = [
        PlacedEffect(effect, texts, {"s": float(s), "reach": float(min(FARTHEST_OPEN, sites - 1)), "open": 1.0})
        for s in POWERS
    ]
    found: list[Candidate | None] = []
    for kind in (repeated, between) if dynamics.ends in ("free", "fixed") else (repeated,):
        farthest = int(kind[0].psi["reach"])
        pulls = [Term(f"u[n+{r}]+u[n-{r}]-2*u[n]") for r in range(2, farthest + 1)]

        def columns(_number: int, path: Path, kind: list[PlacedEffect] = kind, pulls: list[Term] = pulls) -> ndarray:
            if kind[0].psi["open"]:
                fields = path.field[:, 0]
                sources = [fields @ far_matrix(placed.psi, sites).T for placed in kind]
            else:
                each = path.sources(pulls)
                far = np.arange(2, len(pulls) + 2)
                sources = [np.tensordot(far ** -placed.psi["s"], each, (0, 0)) for placed in kind]
            if len(texts) > 1:
                sources = [part for one in sources for part in (one, np.stack([-one[:, 1], one[:, 0]], axis=1))]
            return path.answer(np.stack(sources))

        every = tangent.columns(columns)
        each = len(texts)
        found += [as_candidate(tangent, placed, every[:, k * each : (k + 1) * each]) for k, placed in enumerate(kind)]
    return found


def _sited(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    texts = _terms_of(tangent, effect)
    sites = places(tangent)
    if not texts or len(sites) < 2:
        return []
    return _in_one_go(tangent, [PlacedEffect(effect, texts, site=site) for site in sites])


def _disordered(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    texts = _terms_of(tangent, effect)
    if not texts or len(places(tangent)) < 3:
        return []
    model, is_complex = tangent.fitted.model, tangent.paths[0].is_complex
    present = [
        *model.declared.terms,
        *(Term(text) for one in model.effects if one.effect.acts == "everywhere" for text in one.texts),
    ]
    # Where the model has the term, or a part of it, its mean is known by another name.
    whole = all(express(Term(text), present, is_complex) is None for text in texts)
    placed = PlacedEffect(effect, texts, {"whole": True} if whole else {})
    columns = _force_columns(tangent, placed)
    return [as_candidate(tangent, placed, columns[:, np.linalg.norm(columns, axis=0) > 0], random=True)]


def _unequal(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    sites = places(tangent)
    if len(sites) < 2:
        return []
    coefficients = tangent.fitted.solution.state.coefficients

    def columns(_number: int, path: Path) -> ndarray:
        dynamics = path.record.stretches.dynamics
        total = np.tensordot(coefficients, own_forces(path), (0, 0))
        masks = np.eye(dynamics.sites)[sites][:, dynamics.moving]
        return path.answer(total[None] * masks[:, None, None])

    found = tangent.columns(columns)
    return [
        as_candidate(tangent, PlacedEffect(effect, (), {"scale": 0.0}, site=site), found[:, [k]])
        for k, site in enumerate(sites)
    ]


def _ended(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    fitted = tangent.fitted
    declared = tangent.paths[0].record.stretches.dynamics.ends
    if declared == "unknown":
        return []
    coefficients = fitted.solution.state.coefficients
    found: list[Candidate | None] = []
    for ends in get_args(Ends):
        if ends in ("unknown", declared):
            continue

        def column(_number: int, path: Path, ends: Ends = ends) -> ndarray:
            dynamics = path.record.stretches.dynamics
            other = path.sources(dynamics.terms, ends) - path.sources(dynamics.terms)
            if dynamics.weights is not None:
                other = other * dynamics.weights[:, None, None, dynamics.moving]
            return path.answer(np.tensordot(coefficients, other, (0, 0))[None])

        found.append(as_candidate(tangent, PlacedEffect(effect, ends=ends), tangent.columns(column)))
    return found


def _instrumental(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    fitted = tangent.fitted
    dynamics = tangent.paths[0].record.stretches.dynamics
    sites, seen = dynamics.sites, tangent.paths[0].weight.shape[1]
    if not effect.texts(dynamics.order, dynamics.is_complex):
        return []
    present = {name for placed in fitted.model.effects if placed.effect.name == effect.name for name in placed.psi}
    kinds = ["real", "imaginary"] if effect.acts == "offset" and dynamics.is_complex else ["real"]
    every = [f"{kind}_{k + 1}" for kind in kinds for k in range(sites)]
    effects, random = [], []
    for both in (False, True) if seen > 1 and effect.acts != "offset" else (False,):
        if effect.acts == "curve":
            effects.append(PlacedEffect(effect, psi={"real": 0.0}, both=both))
            continue
        for k in range(sites):
            names = [f"{kind}_{k + 1}" for kind in kinds]
            if not present & set(names):
                effects.append(PlacedEffect(effect, psi=dict.fromkeys(names, 0.0), both=both, site=k))
        if sites > 1 and not present:
            random.append(PlacedEffect(effect, psi=dict.fromkeys(every, 0.0), both=both))
    found = [as_candidate(tangent, placed, _readings(tangent, placed)) for placed in effects]
    if effect.acts == "offset" and dynamics.order == 2 and not present and not dynamics.is_complex:
        forced = PlacedEffect(effect, psi=dict.fromkeys(every, 0.0), as_force=True)
        columns = _force_columns(tangent, forced)
        found.append(as_candidate(tangent, forced, columns[:, np.linalg.norm(columns, axis=0) > 0], random=sites > 2))
    return found + [as_candidate(tangent, placed, _readings(tangent, placed), random=True) for placed in random]


def _readings(tangent: Tangent, placed: PlacedEffect) -> ndarray:
    """Return the columns of an instrument's effect."""
    from latticebench.diagnosis.model import rates

    state = tangent.fitted.solution.state

    def columns(number: int, path: Path) -> ndarray:
        levels = path.weight.shape[1]
        field = path.field[:: path.steps][:, :levels]
        rate = rates(path.record, state, number)[:, :levels]
        return path.rows(np.stack([placed.misreading_by(name, path.record.times, field, rate) for name in placed.psi]))

    return tangent.columns(columns)


def _clock(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    placed = PlacedEffect(effect, psi={"rate": 0.0})
    found = [as_candidate(tangent, placed, _readings(tangent, placed))]
    rows = len(tangent.paths[0].record.times)
    numbers = np.sum(tangent.paths[0].weight > 0) / rows
    if len(tangent.paths) == 1 and rows <= LONG and numbers >= 3:
        jitter = PlacedEffect(effect, psi={f"row_{k + 1}": 0.0 for k in range(rows)})
        found.append(as_candidate(tangent, jitter, _readings(tangent, jitter), random=True))
    return found


def step_of(values: Float[ndarray, " values"]) -> float:
    """Return the step that all readings are multiples of, up to a common offset; 0 where there is none."""
    seen = np.unique(values[np.isfinite(values)])
    if len(seen) < 3:
        return 0.0
    gaps = np.diff(seen)
    scale = float(np.max(np.abs(seen)))
    gaps = gaps[gaps > 1e-9 * scale]
    if not len(gaps):
        return 0.0
    step = float(np.min(gaps))
    multiples = gaps / step
    step = float(np.sum(gaps) / np.sum(np.round(multiples)))
    return step if np.max(np.abs(gaps / step - np.round(gaps / step))) < 1e-3 else 0.0


def _quantised(tangent: Tangent, effect: Effect) -> list[Candidate | None]:
    """Return the candidate of rounding: what rounding leaves on average tells where in its step the field is."""
    steps = []
    for path in tangent.paths:
        value = path.record.value[:, 0][path.record.seen[:, 0]]
        steps.append(step_of(value))
    step = steps[0]
    sigma = float(tangent.fitted.sigma[0])
    if not step or any(abs(one / step - 1) > 1e-3 for one in steps) or step**2 / 12 < sigma**2 * ROUNDED / 3:
        return []
    # What is left of the noise when the rounding's own part is taken off.
    inner = np.sqrt(max(sigma**2 - step**2 / 12, (0.05 * step) ** 2))

    first = tangent.paths[0].record
    origin = float(first.value[:, 0][first.seen[:, 0]][0])
    placed = PlacedEffect(effect, psi={"step": step, "inner": float(inner), "origin": origin})

    def column(_number: int, path: Path) -> ndarray:
        field = path.field[:: path.steps][:, : path.weight.shape[1]]
        return path.rows(placed.misreading(path.record.times, field, field)[None])

    return [as_candidate(tangent, placed, tangent.columns(column))]
