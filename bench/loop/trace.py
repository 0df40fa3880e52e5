"""Trace what a fitted model leaves to an effect that it lacks.

Every effect of the catalogue is put, to first order, beside the fitted model (`bench.loop.tangent`): at every site that it might sit
at, on a grid of frequencies, times and delays that it might have. With r the residual (in units of the noise) and U an orthonormal
basis of what the effect could add, s = |U^T r|^2 is what it would take off |r|^2: the score test (Rao, Proc. Camb. Phil. Soc. 44,
50 (1948)). An effect with a coefficient for every site or time counts as a random one, of unknown variance: the likelihood is then
that of a Gaussian residual with a covariance.

The null distribution is simulated: noise of the estimated size is put on the fitted trajectories and the model is fitted to
it again, by the Gauss-Newton step that the tangent gives; the same search over sites and frequencies is then done on what is left.
The largest value of a search has an exponential tail; the surrogates say how many independent tries the search amounts to, so
that p-values far below one over the number of surrogates make sense.

`unnamed` terms are tried beside the catalogue. They are no verdict, but where one of them does much better than every effect that has
a name, none of the names is right.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from scipy import special

from bench.loop.model import Change, Force, far_matrix
from bench.loop.tangent import Path, Tangent, force_along, forces, orthonormal
from systems.effects import Effect
from systems.lattice import Ends
from systems.terms import Term

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# Frequencies searched where the record is short; the strongest lines of the residual where it is long.
MOST_FREQUENCIES = 120
LONG = 400
PULSES, WIDTHS = 24, (0.02, 0.05, 0.12)
DELAYS = 10
POWERS = tuple(np.arange(0.5, 5.1, 0.25))
FARTHEST, FARTHEST_OPEN = 8, 24
# Rounding that makes this share of the noise's variance is named; that readings lie on a grid is no accident, whatever the residual.
ROUNDED = 1 / 3
SEARCHED = ("omega", "at", "width", "delay", "s")
CERTAIN = 60.0
# Numbers drawn at a time for surrogates.
CHUNK = 4_000_000


@dataclass(frozen=True, eq=False)
class Try:
    """One way in which an effect might be there.

    Attributes:
        change: the effect with its place and parameters.
        basis: orthonormal columns of what it could add (rows, q).
        spread: for a random effect, the variance of each column for a unit variance of its coefficients (q,); else None.
    """

    change: Change
    basis: Float[ndarray, "rows q"]
    spread: Float[ndarray, " q"] | None = None


@dataclass(frozen=True, eq=False)
class Finding:
    """What the screen says about one effect.

    Attributes:
        name: of the effect, or the text of an unnamed term.
        change: the best way for it to be there.
        gain: twice the log likelihood ratio of that way.
        columns: how many coefficients it has.
        tries: how many independent tries the search amounts to.
        cost: what the search costs the evidence: the log of the tries, or half the log of the count of numbers for each
            parameter searched (as in the Bayesian information criterion) where that is more.
        named: whether it is of the catalogue.
        random: whether it is a random effect, of a coefficient for every site or time.
    """

    name: str
    change: Change
    gain: float
    columns: int
    tries: float
    cost: float
    named: bool = True
    random: bool = False

    @property
    def rarity(self) -> float:
        """-ln of the chance p that noise alone does as well somewhere in the search."""
        return rarity(self._tail, self.tries)

    @property
    def p(self) -> float:
        """That chance."""
        return float(np.exp(-self.rarity))

    @property
    def evidence(self) -> float:
        """What the ranking goes by: -ln p of one try, less what the search costs."""
        return self._tail - self.cost

    @property
    def _tail(self) -> float:
        return float(tail(self.gain, self.columns)) + (np.log(2) if self.random and self.gain > 0 else 0.0)


def tail(gain: float | ndarray, columns: int) -> Any:
    """-ln of the chance that chi squared of this many degrees of freedom is larger; exact enough far out, too."""
    half, x = columns / 2, np.maximum(np.asarray(gain, dtype=float), 0.0) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        near = -np.log(special.gammaincc(half, x))
        # The first terms of the asymptotic series of the incomplete gamma function.
        far = (
            x
            - (half - 1) * np.log(np.maximum(x, 1e-300))
            + special.gammaln(half)
            - np.log1p((half - 1) / np.maximum(x, 1.0))
        )
    return np.where(x > 300 + 4 * half, far, near)


def rarity(largest: float, tries: float) -> float:
    """-ln of the chance that the largest of so many independent tries is larger."""
    if largest > np.log(tries) + 30:
        return float(largest - np.log(tries))
    return float(-np.log(max(-np.expm1(tries * np.log1p(-min(np.exp(-largest), 1 - 1e-15))), 1e-300)))


# The search ---------------------------------------------------------------------------------------------------------------------


def screen(
    tangent: Tangent, catalogue: Sequence[Effect], draw: np.random.Generator, surrogates: int = 200
) -> list[Finding]:
    """Try every effect and the unnamed terms; the best first."""
    model = tangent.fitted.model
    groups: list[tuple[str, bool, list[Try]]] = []
    for effect in catalogue:
        if not _addable(effect, model.changes):
            continue
        found = _tries(tangent, effect)
        if found:
            groups.append((effect.name, True, found))
    groups += [(name, False, [one]) for name, one in _unnamed(tangent)]
    bonds = _bonds(tangent)
    if bonds:
        groups.append(("another bond", False, bonds))
    groups += _probes(tangent)
    return rank(tangent, groups, draw, surrogates)


def rank(
    tangent: Tangent, groups: Sequence[tuple[str, bool, list[Try]]], draw: np.random.Generator, surrogates: int
) -> list[Finding]:
    """Score groups of tries on the residual and on surrogates."""
    spare = tangent.spare
    rows = len(tangent.residual)
    own = _scores(groups, tangent.residual[:, None], float(np.sum(tangent.residual**2)), spare)
    values = [[] for _ in groups]  # type: list[list[ndarray]]
    chunk = max(1, min(surrogates, CHUNK // max(rows, 1)))
    done = 0
    while done < surrogates:
        noise = _surrogates(tangent, draw, min(chunk, surrogates - done))
        done += noise.shape[1]
        for kept, (_, best, _) in zip(values, _scores(groups, noise, np.sum(noise**2, axis=0), spare), strict=True):
            kept.append(np.max(best, axis=0))
    findings = []
    for (name, named, tries), (gains, best, columns), null in zip(groups, own, values, strict=True):
        chosen = int(np.argmax(best[:, 0]))
        # The largest of m exponential variables has the mean ln m + 0.577 (Euler's constant) for large m.
        mean = float(np.mean(np.concatenate(null)))
        count = float(np.clip(np.exp(mean - 0.5772) if mean > 1.3 else mean, 1.0, 10.0 * len(tries) + 1))
        change = _with_spread(tangent, tries[chosen])
        searched = len(set(change.psi) & set(SEARCHED))
        cost = max(np.log(count), searched * np.log(tangent.fitted.count) / 2)
        gain = float(gains[chosen, 0])
        if "step" in change.psi and change.psi["step"] ** 2 / 12 > ROUNDED * float(tangent.fitted.sigma[0]) ** 2:
            gain = max(gain, CERTAIN)
        findings.append(
            Finding(
                name, change, gain, columns[chosen], count, float(cost), named,
                tries[chosen].spread is not None,
            )
        )  # fmt: skip
    return sorted(findings, key=lambda one: -one.evidence)


def _surrogates(tangent: Tangent, draw: np.random.Generator, count: int) -> ndarray:
    """Draw what refits leave of pure noise: (rows, count)."""
    noise = draw.normal(size=(len(tangent.residual), count))
    pieces, begin = [], 0
    for path in tangent.paths:
        end = begin + int(np.sum(path.weight > 0))
        pieces.append(path.free(noise[begin:end]))
        begin = end
    left = np.concatenate(pieces)
    return np.asarray(left - tangent.known @ (tangent.known.T @ left))


def _scores(
    groups: Sequence[tuple[str, bool, list[Try]]], residual: ndarray, total: Any, spare: float
) -> list[tuple[ndarray, ndarray, list[int]]]:
    """For each group: likelihood gains (tries, draws), their tails, and the number of coefficients of each try."""
    if not groups:
        return []
    every = np.concatenate([one.basis for _, _, tries in groups for one in tries], axis=1)
    scores = every.T @ residual
    found, begin = [], 0
    for _, _, tries in groups:
        gains, tails, columns = [], [], []
        for one in tries:
            end = begin + one.basis.shape[1]
            gain = _gain(scores[begin:end], one.spread, total, spare)
            count = 1 if one.spread is not None else one.basis.shape[1]
            gains.append(gain)
            # A variance cannot be negative: half of the chance is at 0.
            tails.append(tail(gain, count) + (np.log(2) * (gain > 0) if one.spread is not None else 0.0))
            columns.append(count)
            begin = end
        found.append((np.stack(gains), np.stack(tails), columns))
    return found


def _gain(
    scores: Float[ndarray, "q draws"], spread: ndarray | None, total: Any, spare: float
) -> Float[ndarray, " draws"]:
    """Twice the log likelihood ratio, the noise's size being fitted too."""
    if spread is None:
        share = np.minimum(np.sum(scores**2, axis=0) / total, 1 - 1e-12)
        return np.asarray(-spare * np.log1p(-share))
    gains = [_random_gain(variance, scores, spread, total, spare) for variance in variances(spread)]
    return np.asarray(np.max(gains, axis=0, initial=0.0))


def variances(spread: Float[ndarray, " q"]) -> Float[ndarray, " variances"]:
    """Give the variances that a random effect is tried with."""
    return np.asarray(np.geomspace(0.03, 3e4, 25) / np.mean(spread))


def _random_gain(variance: float, scores: ndarray, spread: ndarray, total: Any, spare: float) -> ndarray:
    ratio = variance * spread
    share = np.minimum(np.sum(scores**2 * (ratio / (1 + ratio))[:, None], axis=0) / total, 1 - 1e-12)
    return np.asarray(-spare * np.log1p(-share) - np.sum(np.log1p(ratio)))


def _with_spread(tangent: Tangent, one: Try) -> Change:
    """Say how widely a random effect's coefficients scatter."""
    if one.spread is None:
        return one.change
    scores, total = (one.basis.T @ tangent.residual)[:, None], float(np.sum(tangent.residual**2))
    tried = variances(one.spread)
    best = tried[int(np.argmax([_random_gain(v, scores, one.spread, total, tangent.spare)[0] for v in tried]))]
    ratio = best * one.spread
    return replace(one.change, spread=float(np.sqrt(best)), effective=float(np.sum(ratio / (1 + ratio))))


def _try(tangent: Tangent, change: Change, columns: ndarray, random: bool = False) -> Try | None:
    """Make a try of columns that may be within what the model can do; None where they could explain nearly any residual."""
    left = tangent.new(columns)
    if random:
        basis, values, _ = np.linalg.svd(left, full_matrices=False)
        kept = values > 1e-6 * max(values[0], 1e-300) if len(values) else np.zeros(0, dtype=bool)
        return (
            Try(change, basis[:, kept], values[kept] ** 2)
            if 1 < np.sum(kept) <= tangent.spare / 2 and values[0] > 0
            else None
        )
    basis = orthonormal(left)
    return Try(change, basis) if 0 < basis.shape[1] <= tangent.spare / 4 else None


def _addable(effect: Effect, present: Sequence[Change]) -> bool:
    """Say whether an effect may be added once more."""
    again = ("one site", "one equation", "harmonic", "pulse", "offset", "gain")
    return effect.acts in again or all(change.effect.name != effect.name for change in present)


def _tries(tangent: Tangent, effect: Effect) -> list[Try]:
    """List the ways in which an effect might be there."""
    make: dict[str, Callable[[Tangent, Effect], list[Try | None]]] = {
        "harmonic": _harmonic, "pulse": _pulse, "delayed": _late, "long range": _far, "one site": _sited, "every site": _disordered,
        "one equation": _scaled, "ends": _ended, "offset": _misread, "gain": _misread, "curve": _misread, "clock": _clock,
        "rounding": _rounded,
    }  # fmt: skip
    return [one for one in make.get(effect.acts, _everywhere)(tangent, effect) if one is not None]


def _texts(tangent: Tangent, effect: Effect) -> tuple[str, ...]:
    """Give the effect's terms on this lattice, as far as they can be evaluated."""
    samples = tangent.fitted.data[0]
    dynamics = tangent.paths[0].record.stretches.dynamics
    texts = effect.texts(dynamics.order, samples.is_complex)
    for text in texts:
        term = Term(text)
        if "f" in term.names and any(path.force is None for path in tangent.paths):
            return ()
        if _too_wide(term, dynamics):
            return ()
    return texts


def _too_wide(term: Term, dynamics: Any) -> bool:
    left, right = term.reach
    if dynamics.ends == "unknown":
        return bool(left > dynamics.reach[0] or right > dynamics.reach[1])
    return bool(max(left, right) >= dynamics.sites) and dynamics.ends != "fixed"


def _forced(tangent: Tangent, change: Change) -> ndarray:
    """Give the columns of a change's forces."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    return tangent.columns(
        lambda k, path: path.answer(force_along(path, change.forces(dynamics.sites, dynamics.is_complex, k)))
    )


def _everywhere(tangent: Tangent, effect: Effect) -> list[Try | None]:
    texts = _texts(tangent, effect)
    change = Change(effect, texts)
    return [_try(tangent, change, _forced(tangent, change))] if texts else []


def frequencies(tangent: Tangent) -> ndarray:
    """Give the angular frequencies that a drive is searched at."""
    times = max((path.record.times for path in tangent.paths), key=len)
    span = float(times[-1] - times[0])
    highest = np.pi / float(np.median(np.diff(times)))
    if len(times) <= LONG:
        # Less than a whole wave is no wave.
        count = int(min(MOST_FREQUENCIES, 2 * span * highest / np.pi))
        return np.linspace(2 * np.pi / span, highest, max(count, 2))
    found = []
    for path, left in zip(tangent.paths, tangent.fitted.residuals(), strict=True):
        t = path.record.times
        even = np.linspace(t[0], t[-1], len(t))
        series = np.mean(left, axis=(2, 3))[:, 0]
        power = np.abs(np.fft.rfft(np.interp(even, t, series) * np.hanning(len(t)))) ** 2
        omega = 2 * np.pi * np.fft.rfftfreq(len(t), even[1] - even[0])
        peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] > power[2:])) + 1
        found.append(omega[peaks[np.argsort(-power[peaks])[:12]]])
    return np.unique(np.concatenate(found))


def _harmonic(tangent: Tangent, effect: Effect) -> list[Try | None]:
    texts = _texts(tangent, effect)
    if not texts:
        return []
    omegas = frequencies(tangent)
    changes = [Change(effect, texts, {"omega": float(omega)}) for omega in omegas]
    return _together(tangent, changes)


def _pulse(tangent: Tangent, effect: Effect) -> list[Try | None]:
    texts = _texts(tangent, effect)
    if not texts:
        return []
    changes = []
    for path in tangent.paths:
        times = path.record.times
        span = float(times[-1] - times[0])
        for width in WIDTHS:
            size = max(width * span, float(np.median(np.diff(times))))
            changes += [
                Change(effect, texts, {"at": float(at), "width": size})
                for at in np.linspace(times[0] + span / PULSES / 2, times[-1] - span / PULSES / 2, PULSES)
            ]
    return _together(tangent, changes)


def _together(tangent: Tangent, changes: Sequence[Change]) -> list[Try | None]:
    """Try changes of equally many forces; their columns are computed in one go."""
    dynamics = tangent.paths[0].record.stretches.dynamics

    def columns(number: int, path: Path) -> ndarray:
        every = [force for change in changes for force in change.forces(dynamics.sites, dynamics.is_complex, number)]
        return path.answer(force_along(path, every))

    found = tangent.columns(columns)
    each = found.shape[1] // len(changes)
    return [_try(tangent, change, found[:, k * each : (k + 1) * each]) for k, change in enumerate(changes)]


def _late(tangent: Tangent, effect: Effect) -> list[Try | None]:
    texts = _texts(tangent, effect)
    if not texts:
        return []
    past = _histories(tangent)
    times = tangent.paths[0].record.times
    span, step = float(times[-1] - times[0]), float(np.median(np.diff(times)))
    delays = np.geomspace(1.5 * step, span / 3, DELAYS)
    return _together(tangent, [Change(effect, texts, {"delay": float(delay)}, past=past) for delay in delays])


def _histories(tangent: Tangent) -> tuple[Callable[[ndarray], ndarray], ...]:
    """Give the fitted field of each trajectory at any time; before the record it is what it was at its beginning."""
    paths = tangent.paths
    if len(paths) > 1 and all(a.times[-1] < b.times[0] for a, b in itertools.pairwise(paths)):
        # Pieces of one record know each other's past.
        return (_history(paths),) * len(paths)
    return tuple(_history([path]) for path in paths)


def _history(paths: Sequence[Path]) -> Callable[[ndarray], ndarray]:
    from scipy.interpolate import CubicSpline

    times = np.concatenate([path.times for path in paths])
    curve = CubicSpline(times, np.concatenate([path.fields()[0] for path in paths]))
    return lambda t: np.asarray(curve(np.clip(t, times[0], times[-1])))


def _far(tangent: Tangent, effect: Effect) -> list[Try | None]:
    texts = _texts(tangent, effect)
    dynamics = tangent.paths[0].record.stretches.dynamics
    sites = dynamics.sites
    if not texts or dynamics.ends == "unknown" or sites < 4:
        return []
    # With the couplings that the ends repeat, and between the sites that there are; on a ring both are the same.
    repeated = [
        Change(effect, texts, {"s": float(s), "reach": float(min(FARTHEST, sites - 1)), "open": 0.0}) for s in POWERS
    ]
    between = [
        Change(effect, texts, {"s": float(s), "reach": float(min(FARTHEST_OPEN, sites - 1)), "open": 1.0})
        for s in POWERS
    ]
    found: list[Try | None] = []
    for kind in (repeated, between) if dynamics.ends in ("free", "fixed") else (repeated,):
        farthest = int(kind[0].psi["reach"])
        pulls = [Term(f"u[n+{r}]+u[n-{r}]-2*u[n]") for r in range(2, farthest + 1)]

        def columns(_number: int, path: Path, kind: list[Change] = kind, pulls: list[Term] = pulls) -> ndarray:
            if kind[0].psi["open"]:
                fields = path.field[:, 0]
                sources = [fields @ far_matrix(change.psi, sites).T for change in kind]
            else:
                each = path.sources(pulls)
                far = np.arange(2, len(pulls) + 2)
                sources = [np.tensordot(far ** -change.psi["s"], each, (0, 0)) for change in kind]
            if len(texts) > 1:
                sources = [part for one in sources for part in (one, np.stack([-one[:, 1], one[:, 0]], axis=1))]
            return path.answer(np.stack(sources))

        every = tangent.columns(columns)
        each = len(texts)
        found += [_try(tangent, change, every[:, k * each : (k + 1) * each]) for k, change in enumerate(kind)]
    return found


def _places(tangent: Tangent) -> list[int]:
    """List the sites that have an equation."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    return list(range(*dynamics.moving.indices(dynamics.sites)))


def _sited(tangent: Tangent, effect: Effect) -> list[Try | None]:
    texts = _texts(tangent, effect)
    places = _places(tangent)
    if not texts or len(places) < 2:
        return []
    return _together(tangent, [Change(effect, texts, site=site) for site in places])


def _disordered(tangent: Tangent, effect: Effect) -> list[Try | None]:
    texts = _texts(tangent, effect)
    if not texts or len(_places(tangent)) < 3:
        return []
    change = Change(effect, texts)
    columns = _forced(tangent, change)
    return [_try(tangent, change, columns[:, np.linalg.norm(columns, axis=0) > 0], random=True)]


def _scaled(tangent: Tangent, effect: Effect) -> list[Try | None]:
    places = _places(tangent)
    if len(places) < 2:
        return []
    coefficients = tangent.fitted.solution.state.coefficients

    def columns(_number: int, path: Path) -> ndarray:
        dynamics = path.record.stretches.dynamics
        total = np.tensordot(coefficients, forces(path), (0, 0))
        masks = np.eye(dynamics.sites)[places][:, dynamics.moving]
        return path.answer(total[None] * masks[:, None, None])

    found = tangent.columns(columns)
    return [
        _try(tangent, Change(effect, (), {"scale": 0.0}, site=site), found[:, [k]]) for k, site in enumerate(places)
    ]


def _ended(tangent: Tangent, effect: Effect) -> list[Try | None]:
    fitted = tangent.fitted
    declared = tangent.paths[0].record.stretches.dynamics.ends
    if declared == "unknown":
        return []
    coefficients = fitted.solution.state.coefficients
    found: list[Try | None] = []
    for ends in get_args(Ends):
        if ends in ("unknown", declared):
            continue

        def column(_number: int, path: Path, ends: Ends = ends) -> ndarray:
            dynamics = path.record.stretches.dynamics
            other = path.sources(dynamics.terms, ends) - path.sources(dynamics.terms)
            if dynamics.weights is not None:
                other = other * dynamics.weights[:, None, None, dynamics.moving]
            return path.answer(np.tensordot(coefficients, other, (0, 0))[None])

        found.append(_try(tangent, Change(effect, ends=ends), tangent.columns(column)))
    return found


def _misread(tangent: Tangent, effect: Effect) -> list[Try | None]:
    fitted = tangent.fitted
    dynamics = tangent.paths[0].record.stretches.dynamics
    sites, seen = dynamics.sites, tangent.paths[0].weight.shape[1]
    if not effect.texts(dynamics.order, dynamics.is_complex):
        return []
    present = {name for change in fitted.model.changes if change.effect.name == effect.name for name in change.psi}
    kinds = ["real", "imaginary"] if effect.acts == "offset" and dynamics.is_complex else ["real"]
    every = [f"{kind}_{k + 1}" for kind in kinds for k in range(sites)]
    changes, random = [], []
    for both in (False, True) if seen > 1 and effect.acts != "offset" else (False,):
        if effect.acts == "curve":
            changes.append(Change(effect, psi={"real": 0.0}, both=both))
            continue
        for k in range(sites):
            names = [f"{kind}_{k + 1}" for kind in kinds]
            if not present & set(names):
                changes.append(Change(effect, psi=dict.fromkeys(names, 0.0), both=both, site=k))
        if sites > 1 and not present:
            random.append(Change(effect, psi=dict.fromkeys(every, 0.0), both=both))
    found = [_try(tangent, change, _readings(tangent, change)) for change in changes]
    if effect.acts == "offset" and dynamics.order == 2 and not present and not dynamics.is_complex:
        forced = Change(effect, psi=dict.fromkeys(every, 0.0), as_force=True)
        columns = _forced(tangent, forced)
        found.append(_try(tangent, forced, columns[:, np.linalg.norm(columns, axis=0) > 0], random=sites > 2))
    return found + [_try(tangent, change, _readings(tangent, change), random=True) for change in random]


def _readings(tangent: Tangent, change: Change) -> ndarray:
    """Give the columns of an instrument's effect."""
    from bench.loop.model import rates

    state = tangent.fitted.solution.state

    def columns(number: int, path: Path) -> ndarray:
        levels = path.weight.shape[1]
        field = path.field[:: path.steps][:, :levels]
        rate = rates(path.record, state, number)[:, :levels]
        return path.rows(np.stack([change.misreading_by(name, path.record.times, field, rate) for name in change.psi]))

    return tangent.columns(columns)


def _clock(tangent: Tangent, effect: Effect) -> list[Try | None]:
    change = Change(effect, psi={"rate": 0.0})
    found = [_try(tangent, change, _readings(tangent, change))]
    rows = len(tangent.paths[0].record.times)
    numbers = np.sum(tangent.paths[0].weight > 0) / rows
    if len(tangent.paths) == 1 and rows <= LONG and numbers >= 3:
        jitter = Change(effect, psi={f"row_{k + 1}": 0.0 for k in range(rows)})
        found.append(_try(tangent, jitter, _readings(tangent, jitter), random=True))
    return found


def step_of(values: Float[ndarray, " values"]) -> float:
    """Find the step that all readings are multiples of, up to a common offset; 0 where there is none."""
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


def _rounded(tangent: Tangent, effect: Effect) -> list[Try | None]:
    """Try rounding: a rounded reading tells where in its step the field is, by what rounding leaves on average."""
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
    change = Change(effect, psi={"step": step, "inner": float(inner), "origin": origin})

    def column(_number: int, path: Path) -> ndarray:
        field = path.field[:: path.steps][:, : path.weight.shape[1]]
        return path.rows(change.misreading(path.record.times, field, field)[None])

    return [_try(tangent, change, tangent.columns(column))]


# What has no name -----------------------------------------------------------------------------------------------------------------

REAL_TERMS = (
    "u[n]*v[n]", "u[n]**4", "u[n]**6", "u[n]**7", "sin(u[n])", "sin(2*u[n])", "cos(u[n])", "cos(2*u[n])",
    "abs(u[n])*u[n]", "t*u[n]", "t", "n*u[n]",
    "u[n+3]+u[n-3]-2*u[n]", "(u[n+1]-u[n])**2-(u[n-1]-u[n])**2", "u[n]**2*(u[n+1]+u[n-1])", "n*(u[n+1]+u[n-1]-2*u[n])",
    "t*(u[n+1]+u[n-1]-2*u[n])", "u[n]*(u[n+1]+u[n-1])",
)  # fmt: skip
SECOND_ORDER_TERMS = (
    "v[n]**3", "u[n]**2*v[n]", "u[n]*v[n]**2", "n*v[n]", "t*v[n]", "v[n+1]+v[n-1]-2*v[n]", "(v[n+1]-v[n-1])/2",
    "sqrt(abs(v[n]))*sign(v[n])",
)  # fmt: skip
COMPLEX_TERMS = (
    "u[n+1]+u[n-1]-2*u[n]", "abs(u[n])**6*u[n]", "conj(u[n])", "u[n]**2", "abs(u[n])**2", "u[n]**3", "u[n]*(abs(u[n+1])**2+abs(u[n-1])**2)",
    "abs(u[n+1])**2*u[n+1]+abs(u[n-1])**2*u[n-1]", "u[n]**2*conj(u[n+1]+u[n-1])", "t*u[n]", "n*(u[n+1]+u[n-1]-2*u[n])",
    "t*(u[n+1]+u[n-1]-2*u[n])", "u[n]/(1+abs(u[n])**2)", "u[n+3]+u[n-3]-2*u[n]", "t*abs(u[n])**2*u[n]",
)  # fmt: skip


def _unnamed(tangent: Tangent) -> list[tuple[str, Try]]:
    """Terms that no effect of the catalogue has."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    real = REAL_TERMS + (SECOND_ORDER_TERMS if dynamics.order == 2 else ())
    texts: tuple[str, ...] = COMPLEX_TERMS if dynamics.is_complex else real
    found = []
    kept = [text for text in texts if not _too_wide(Term(text), dynamics)]

    def columns(_number: int, path: Path) -> ndarray:
        terms = [
            Force(Term(part)) for text in kept for part in ((text, f"i*({text})") if dynamics.is_complex else (text,))
        ]
        return path.answer(force_along(path, terms))

    every = tangent.columns(columns)
    each = 1 + dynamics.is_complex
    for k, text in enumerate(kept):
        change = Change(Effect("unnamed", text), (text, f"i*({text})") if dynamics.is_complex else (text,))
        one = _try(tangent, change, every[:, k * each : (k + 1) * each])
        if one is not None:
            found.append((text, one))
    return found


def _bonds(tangent: Tangent) -> list[Try]:
    """One bond of another strength."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    places = [k for k in _places(tangent) if k + 1 in _places(tangent)]
    if len(places) < 2:
        return []
    parts = ("", "i*") if dynamics.is_complex else ("",)

    def columns(_number: int, path: Path) -> ndarray:
        terms = [Term(f"{part}(u[n+1]-u[n])") for part in parts] + [Term(f"{part}(u[n-1]-u[n])") for part in parts]
        right, left = np.split(path.sources(terms), 2)
        sources = []
        for k in places:
            on, next_ = np.eye(dynamics.sites)[k][dynamics.moving], np.eye(dynamics.sites)[k + 1][dynamics.moving]
            sources.append(right * on + left * next_)
        return path.answer(np.concatenate(sources))

    every = tangent.columns(columns)
    each = len(parts)
    change = Change(Effect("unnamed", "u[n+1]-u[n]"))
    tries = [
        _try(tangent, Change(change.effect, site=k), every[:, j * each : (j + 1) * each]) for j, k in enumerate(places)
    ]
    return [one for one in tries if one is not None]


def _probes(tangent: Tangent) -> list[tuple[str, bool, list[Try]]]:
    """Nets for whatever else there is: smooth forces in space and time, and patterns of the residual itself."""
    dynamics = tangent.paths[0].record.stretches.dynamics
    change = Change(Effect("unnamed", "0"))
    groups: list[tuple[str, bool, list[Try]]] = []
    sites = dynamics.sites
    place = (np.arange(sites) + 0.5) / sites
    modes = [np.cos(np.pi * k * place) for k in range(min(6, sites))]

    def smooth(_number: int, path: Path, low: int, high: int) -> ndarray:
        x = (path.times - path.times[0]) / (path.times[-1] - path.times[0])
        sources = []
        for k in range(low, high):
            for mode in modes:
                for part in range(dynamics.parts):
                    source = np.zeros((len(x), dynamics.parts, sites))
                    source[:, part] = np.cos(np.pi * k * x)[:, None] * mode
                    sources.append(source[..., dynamics.moving])
        return path.answer(np.stack(sources))

    for low, high in ((0, 3), (3, 9), (9, 18)):
        columns = tangent.columns(lambda k, path, a=low, b=high: smooth(k, path, a, b))  # type: ignore[misc]
        one = _try(tangent, change, columns, random=True)
        if one is not None:
            groups.append((f"a smooth force, {low}-{high - 1} half waves in time", False, [one]))

    def pattern(_number: int, path: Path, level: int, low: int, high: int) -> ndarray:
        rows = len(path.record.times)
        x = (np.arange(rows) + 0.5) / rows
        columns = []
        for k in range(low, high):
            for mode in modes:
                for part in range(dynamics.parts):
                    wrong = np.zeros(path.weight.shape)
                    wrong[:, level, part] = np.cos(np.pi * k * x)[:, None] * mode
                    columns.append(wrong)
        return path.rows(np.stack(columns))

    for level in range(tangent.paths[0].weight.shape[1]):
        for low, high in ((0, 4), (4, 12)):
            columns = tangent.columns(lambda k, path, c=level, a=low, b=high: pattern(k, path, c, a, b))  # type: ignore[misc]
            one = _try(tangent, change, columns)
            if one is not None:
                groups.append((f"a pattern in {'uv'[level]}, {low}-{high - 1} half waves in time", False, [one]))
    return groups
