"""What is known of recordings before a model is fitted: the lattice, smoothed states, frequencies, all candidates."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from latticebench.diagnosis import rules
from latticebench.diagnosis.acting import Chain, Placed, Scene, way_of
from latticebench.diagnosis.acting.scene import Course
from latticebench.diagnosis.held import Held, freed
from latticebench.diagnosis.instrument import of_readings, quietest, step_of
from latticebench.diagnosis.spectrum import Spectrum, hidden, lines, mean_step
from latticebench.methods.engine.bsplines import BSplines
from latticebench.methods.engine.derivatives import DEGREE, differentiate
from latticebench.methods.engine.dynamics import Dynamics, split_parts
from latticebench.methods.engine.record import Record
from latticebench.methods.engine.sensitivity import Stretches
from latticebench.methods.engine.starts import smooth
from latticebench.systems.effects import Effect
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import Library
from latticebench.systems.samples import Samples

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

# With unknown ends all equations leave the same sites without one, as far as the chain is long enough.
WIDE, LONG_CHAIN = 2, 9
# A dense recording is thinned to so many samples in the shortest period, a long one cut to windows of so many samples.
DENSE, LONG, WINDOWS = 24, 4000, 2
# Samples of an input before and after a part of a recording: a spline forgets what is so far away.
MARGIN = 40
# Degrees of the splines that an input may follow between its samples: held, as a converter does, in straight lines, or
# smoothly. At three samples a period, a tenth of a wave is lost by the cubic spline, a hundredth by the last.
DEGREES = (0, 1, 3, 7)
# Outside influences are looked for up to so many times the highest frequency, at so many frequencies at most.
FARTHER, MOST_FREQUENCIES = 6.0, 900
# Noise is at least this share of the swing: no instrument shows less, and motions are not computed more accurately.
FINEST = 1e-6
# A stretch that lasts so many times as long as its samples ask for holds a gap.
GAP = 2.0
# In typical times between readings; each is some steps of the integrator.
LONGEST_GAP = 1000.0
# Dry friction is viscous at first below this share of the usual speed: a fit that is far from the motion needs forces
# without jumps.
AT_REST = 0.1
# Of more recordings it is not asked whether each has zeros and units of its own.
SEVERAL = 20
# So many sensors are looked at for steps before it is taken that there are none.
FEW_SENSORS = 4


@dataclass(frozen=True, eq=False)
class Problem:
    """What a search works on.

    Attributes:
        declared, order: the equation.
        data: recordings as they are used.
        chain: their lattice.
        plain: the declared terms on it.
        records: readings as real numbers.
        nodes: smoothed states of each recording (T, S).
        splines: of the sites without an equation, of each recording; None where every site has one.
        spectrum: of the longest recording.
        step: typical time between readings.
        forced: the inputs of each recording at their own times; None where nothing was measured.
        degree: of the splines between them, of `DEGREES`.
        fineness: of the curves of the sites without an equation, of `latticebench.diagnosis.border.FINENESS`.
        scene: where effects are placed.
        candidates: all effects in all places.
        held: what was left out of recordings as they begin and end.
        exchanged: the order of the columns, from 0, that suits the declared equation much better; () where none does.
        unrounded: where the mean error of rounded readings has been taken away, the smallest noise with it; else 0.
    """

    declared: Library
    order: int
    data: tuple[Samples, ...]
    chain: Chain
    plain: Dynamics
    records: tuple[Record, ...]
    nodes: tuple[Float[ndarray, "time state"], ...]
    splines: tuple[ndarray | None, ...]
    spectrum: Spectrum
    step: float
    scene: Scene
    candidates: tuple[Placed, ...]
    forced: tuple[Samples | None, ...] = ()
    degree: int = 3
    fineness: float = 1.0
    unrounded: float = 0.0
    held: tuple[Held, ...] = ()
    exchanged: tuple[int, ...] = ()

    @classmethod
    def of(cls, declared: Library, order: int, data: Sequence[Samples], catalogue: Sequence[Effect]) -> Problem:
        """Return the problem of finding what an equation lacks of recordings.

        Raises:
            InputError: the chain is shorter than the stencil, or there is a gap that nothing can be followed through.
        """
        _check_gaps(data)
        free = [freed(one) for one in data]
        data, held = [one for one, _ in free], tuple(one for _, some in free for one in some)
        longest = max(data, key=lambda one: len(one.t))
        spectrum = Spectrum.of(longest)
        top = _top(spectrum, longest)
        fast = np.unique(np.concatenate([lines(one, FARTHER * top) for one in data]))
        parts = [(part, one) for one in data for part in windows(thinned(one, top, fast))]
        data, forced = tuple(part for part, _ in parts), tuple(around(*pair) for pair in parts)
        longest = max(data, key=lambda one: len(one.t))
        first = data[0]
        reach = (WIDE, WIDE) if first.ends == "unknown" and first.sites >= LONG_CHAIN else (0, 0)
        plain = Dynamics(declared.terms, order, first.is_complex, first.sites, first.ends, least_reach=reach)
        if first.ends == "unknown":
            # Effects look as far to both sides as declared terms to one, where the chain is long enough.
            far = max(plain.reach)
            plain = replace(plain, least_reach=(far, far) if first.sites > 2 * far else plain.reach)
        states = [_states(one, order) for one in data]
        plain = replace(plain, rest=AT_REST * _speed(states))
        records, splines = zip(*(_record(*each, plain) for each in zip(data, forced, states, strict=True)), strict=True)
        widest = min(plain.reach) if first.ends == "unknown" else first.sites - 1
        levels = records[0].value.shape[1]
        moving = tuple(range(first.sites)[plain.moving])
        chain = Chain(first.sites, order, first.is_complex, levels, first.ends, moving, widest)
        step = float(np.median(np.diff(longest.t)))
        span = float(longest.t[-1] - longest.t[0])
        nodes = tuple(plain.pack(*both) for both in states)
        own = plain.parts * plain.count
        if _relaxes(spectrum, span, chain):
            top = max([top, *(_rate(one[:, :own], samples.t) for one, samples in zip(nodes, data, strict=True))])
        past = tuple(
            Course.of(one.t, split_parts(field[0], first.is_complex)) for one, field in zip(data, states, strict=True)
        )
        seen = float(min(one.t[0] for one in data)), float(max(one.t[-1] for one in data))
        scene = Scene(
            chain, float(longest.t[0]), span, seen, top, _frequencies(top, span, step),
            _beside(fast, FARTHER * top, span), past, declared.texts, first.f is not None,
            # Of windows of one recording, none has a zero of its own.
            tuple(map(_read, data)) if len(parts) == len(free) and 1 < len(free) <= SEVERAL else (),
            step, float(spectrum.peaks[0]) if len(spectrum.peaks) else 0.0,
            max(float(np.nanmax(np.abs(one.u))) for one in data),
        )  # fmt: skip
        candidates = tuple(one for effect in catalogue for one in way_of(effect).places(effect, scene))
        return cls(
            declared, order, data, chain, plain, records, nodes, splines, spectrum, step, scene, candidates,
            forced, held=held,
        )  # fmt: skip

    def interpolated(self, degree: int) -> Problem:
        """Return the same problem with inputs that follow splines of another degree between their samples."""
        records = tuple(
            replace(record, stretches=replace(record.stretches, inputs=None if one is None else one.forcing(degree)))
            for record, one in zip(self.records, self.forced, strict=True)
        )
        return replace(self, records=records, degree=degree)

    def first(self, share: float) -> Problem:
        """Return the problem of the first share of each recording."""
        cuts = [max(DEGREE + 1, round(len(one.t) * share)) for one in self.data]
        data, records, nodes = [], [], []
        for cut, one, record, states in zip(cuts, self.data, self.records, self.nodes, strict=True):
            data.append(one.of_rows(slice(cut)))
            records.append(replace(record, value=record.value[:cut], seen=record.seen[:cut], times=record.times[:cut]))
            nodes.append(states[:cut])
        return replace(self, data=tuple(data), records=tuple(records), nodes=tuple(nodes))

    @property
    def top(self) -> float:
        """The highest angular frequency that the readings plainly show."""
        return _top(self.spectrum, max(self.data, key=lambda one: len(one.t)))

    @property
    def relaxes(self) -> bool:
        """Whether the lattice relaxes instead of swinging: no period tells what acts at a time of its own."""
        return _relaxes(self.spectrum, self.scene.span, self.chain)

    @functools.cached_property
    def fastest(self) -> float:
        """The highest angular frequency, or a faster rate of change: what relaxes has no peak in the spectrum.

        The rate is that of the sensor that changes fastest (`_rate`).
        """
        own = self.plain.parts * self.plain.count
        pairs = zip(self.records, self.nodes, strict=True)
        return max([self.top, *(_rate(nodes[:, :own], record.times) for record, nodes in pairs)])

    @property
    def main(self) -> float:
        """The angular frequency of the strongest peak, at least that of one wave in the recording."""
        longest = max(self.data, key=lambda one: len(one.t))
        lowest = 2 * np.pi / float(longest.t[-1] - longest.t[0])
        return max(float(self.spectrum.peaks[0]), lowest) if len(self.spectrum.peaks) else lowest

    @functools.cached_property
    def height(self) -> float:
        """Root mean square of the readings of u."""
        values = np.concatenate([np.abs(one.u).ravel() for one in self.data])
        return float(np.sqrt(np.nanmean(values**2)))

    @functools.cached_property
    def finest(self) -> float:
        """The smallest size of noise: a share of the root mean square of the readings about each sensor's mean."""
        columns = [column for one in self.data for field in self._fields(one) for column in field.T]
        seen = [column[np.isfinite(column)] for column in columns]
        return FINEST * float(np.sqrt(np.mean([np.var(one) for one in seen if len(one)])))

    @functools.cached_property
    def noise(self) -> Float[ndarray, " sensors"]:
        """The noise of each sensor by the readings alone: u of each site, then v; NaN where they do not tell."""
        found = self._shown
        return np.where(found > 0, np.maximum(found, self.finest), found)

    @property
    def _shown(self) -> Float[ndarray, " sensors"]:
        longest = max(self.data, key=lambda one: len(one.t))
        found = []
        for field in self._fields(longest):
            parts = [of_readings(longest.t, part) for part in [field.real, field.imag][: self.chain.parts]]
            found.append(np.sqrt(np.mean(np.stack(parts) ** 2, axis=0)))
        noise = np.concatenate(found)
        if longest.f is None or np.all(np.isfinite(noise)):
            return noise
        # An input moves the sites as fast as readings may follow one another; some frequencies it leaves alone.
        own = np.concatenate(
            [quietest(longest.t, split_parts(one, self.chain.is_complex)) for one in self._fields(longest)]
        )
        return np.where(np.isfinite(noise), noise, own)

    @functools.cached_property
    def steps(self) -> tuple[float, ...]:
        """The step of each sensor's converter, 0 for none; where the first few have none, the rest have none."""
        fields = [split_parts(field, self.chain.is_complex) for field in self._fields(self.data[0])]
        sensors = [field[:, :, site].ravel() for field in fields for site in range(self.chain.sites)]
        first = [step_of(one) for one in sensors[:FEW_SENSORS]]
        rest = [step_of(one) for one in sensors[FEW_SENSORS:]] if any(first) else [0.0] * len(sensors[FEW_SENSORS:])
        return (*first, *rest)

    def _fields(self, samples: Samples) -> list[ndarray]:
        return [samples.u] if self.chain.levels == 1 or samples.v is None else [samples.u, samples.v]

    @functools.cached_property
    def _places(self) -> Counter[str]:
        return Counter(one.effect.name for one in self.candidates)

    def price(self, name: str, numbers: int) -> float:
        """Return the nats that an effect must bring: noise brings as many in its share of `rules.FALSE_ALARM`."""
        share = rules.FALSE_ALARM / max(len(self._places), 1) / max(self._places[name], 1)
        return self.chance(share, numbers) + (rules.STAND_IN if name in rules.STAND_INS else 0.0)

    def chance(self, share: float, numbers: int) -> float:
        """Return the nats that noise alone reaches with a chance of `share`."""
        return _isf(share, max(numbers, 1))

    def price_of(self, placed: Placed) -> float:
        """Return the price of an effect in its place."""
        return self.price(placed.effect.name, placed.count)


@functools.lru_cache(maxsize=4096)
def _isf(share: float, numbers: int) -> float:
    from scipy.special import gammainccinv

    # Twice the nats follow chi-squared.
    return float(gammainccinv(numbers / 2, share))


def _top(spectrum: Spectrum, samples: Samples) -> float:
    lowest = 2 * np.pi / float(samples.t[-1] - samples.t[0])
    return max(float(np.max(spectrum.peaks, initial=0.0)), lowest)


def _check_gaps(data: Sequence[Samples]) -> None:
    """Refuse gaps that no motion is followed through, and recordings whose times have different units."""
    longest = max(data, key=lambda one: len(one.t))
    usual = float(np.median(np.diff(longest.t)))
    for one in data:
        row = int(np.argmax(np.diff(one.t)))
        gap = float(one.t[row + 1] - one.t[row])
        if gap > LONGEST_GAP * usual:
            raise InputError(
                f"{one.source}: rows {row + 1} and {row + 2}: {gap:g} between two readings, where {usual:g} is usual; "
                "cut the recording there into trajectories, or give all times in one unit"
            )


def _relaxes(spectrum: Spectrum, span: float, chain: Chain) -> bool:
    """Return whether a real field of first order has no peak in its spectrum but for less than a wave in all.

    A complex one has a phase, which turns, and positions with velocities swing, however short the recording is.
    """
    return chain.order == 1 and not chain.is_complex and not np.any(spectrum.peaks * span > 2 * np.pi)


def _rate(u: Float[ndarray, "time sensors"], t: Float[ndarray, " time"]) -> float:
    """Return the rate of change of the sensor that changes fastest; 0 where none moves.

    It is the root mean square of its slope over its standard deviation, about the angular frequency of a sine; sensors
    that move little are left out.
    """
    size, slope = np.nanstd(u, axis=0), np.sqrt(np.nanmean(np.gradient(u, t, axis=0) ** 2, axis=0))
    moving = size > rules.MOVES * np.nanmax(size)
    return float(np.max(slope[moving] / size[moving], initial=0.0))


def thinned(samples: Samples, top: float, fast: Float[ndarray, " lines"]) -> Samples:
    """Return every k-th sample of one that is read far more often than it moves, and at least `LONG` / 2 of them.

    Beside an input k is a power of two, so that steps of an integrator, which are halved, end where its samples are.
    It is the largest with which the fewest fast lines look like slow ones or like one another.
    """
    usual = float(np.median(np.diff(samples.t)))
    stride = min(int(2 * np.pi / top / usual / DENSE), len(samples.t) // (LONG // 2))
    if stride < 2:
        return samples
    strides = range(stride, 0, -1) if samples.f is None else [1 << k for k in range(stride.bit_length() - 1, -1, -1)]
    step, near = mean_step(samples.t), rules.AROUND * np.pi / float(samples.t[-1] - samples.t[0])
    stride = min(strides, key=lambda k: hidden(fast, k * step, FARTHER * top, near)) if len(fast) else strides[0]
    return samples.of_rows(slice(None, None, stride))


def _read(samples: Samples) -> tuple[int, ...]:
    """Return the sites that were read."""
    return tuple(site for site in range(samples.sites) if site not in samples.unread)


def around(part: Samples, whole: Samples) -> Samples | None:
    """Return the samples of a recording's input from a little before to a little after a part of it."""
    if whole.f is None:
        return None
    begin, end = np.searchsorted(whole.t, part.t[[0, -1]])
    near = whole.of_rows(slice(max(begin - MARGIN, 0), end + 1 + MARGIN))
    return replace(near, u=np.zeros_like(near.u))


def windows(samples: Samples) -> list[Samples]:
    """Return windows of a recording that is too long to be used as a whole, where its signal is.

    Each is the middle of an equal share of the readings' sum of squares: little is learned where little moves.
    """
    count = len(samples.t)
    if count <= LONG:
        return [samples]
    size = LONG // WINDOWS
    squares = np.nansum(np.abs(samples.u - np.nanmean(samples.u, axis=0)) ** 2, axis=1)
    middles = np.searchsorted(np.cumsum(squares), (np.arange(WINDOWS) + 0.5) / WINDOWS * np.sum(squares))
    # None overlap.
    least = np.arange(WINDOWS) * size
    begins = least + np.maximum.accumulate(np.maximum(middles - size // 2 - least, 0))
    begins = np.minimum(begins, count - size * np.arange(WINDOWS, 0, -1))
    return [samples.of_rows(slice(begin, begin + size)) for begin in begins]


def _states(samples: Samples, order: int) -> tuple[ndarray, ndarray | None]:
    """Return smoothed u and, for order 2, v."""
    if len(samples.t) <= DEGREE:
        raise InputError(
            f"{samples.source}: {len(samples.t)} rows are too few for a diagnosis; give at least {DEGREE + 1}"
        )
    return smooth(samples, order)


def _speed(states: Sequence[tuple[ndarray, ndarray | None]]) -> float:
    """Return the root mean square of smoothed velocities; 0 on a lattice of first order."""
    squares = [np.mean(np.abs(v) ** 2) for _, v in states if v is not None]
    return float(np.sqrt(np.nanmean(squares))) if squares else 0.0


def _record(
    samples: Samples, forced: Samples | None, states: tuple[ndarray, ndarray | None], plain: Dynamics
) -> tuple[Record, ndarray | None]:
    """Return the readings, and the splines of the sites that have no equation."""
    fields = [samples.u] if plain.order == 1 or samples.v is None else [samples.u, samples.v]
    value = np.stack([split_parts(one, samples.is_complex) for one in fields], axis=1)
    seen = np.isfinite(value)
    drive, splines = None, None
    if len(plain.border):
        from scipy.interpolate import make_interp_spline

        curve = make_interp_spline(samples.t, split_parts(states[0][:, plain.border], samples.is_complex), k=3)
        drive, splines = BSplines(curve.t, 3), curve.c
    inputs = None if forced is None else forced.forcing()
    stretches = Stretches(plain, samples.t[:-1], samples.t[1:], inputs, drive, held=True)
    return Record(stretches, np.where(np.isfinite(value), value, 0.0), seen, samples.t), splines


def _frequencies(top: float, span: float, step: float) -> Float[ndarray, " frequencies"]:
    """Return half a resolution apart, up to a few times the motion's own."""
    highest = min(0.9 * np.pi / step, FARTHER * top)
    every = np.arange(1.0, highest * span / np.pi) * np.pi / span
    return every[:: len(every) // MOST_FREQUENCIES + 1]


def _beside(fast: Float[ndarray, " lines"], above: float, span: float) -> Float[ndarray, " frequencies"]:
    """Return frequencies half a resolution apart about fast lines, as far as a line is compared with others."""
    steps = np.round(fast * span / np.pi)[:, None] + np.arange(-rules.AROUND, rules.AROUND + 1)
    every = np.unique(steps) * np.pi / span
    return np.asarray(every[every > above])


def turned(problem: Problem, site: int) -> Problem:
    """Return the problem as it is where the sensor of one site looks from the other side."""
    sign = np.ones(problem.chain.sites)
    sign[site] = -1.0
    own = np.tile(sign[problem.plain.moving], problem.chain.order * problem.chain.parts)
    return replace(problem, nodes=tuple(nodes * own for nodes in problem.nodes))


def derivative_share(problem: Problem, motion: Sequence[ndarray], right: Sequence[ndarray]) -> float:
    """Return the share of the highest time derivative, along smoothed readings, that right-hand sides leave.

    Args:
        problem: the recordings.
        motion: readings of u, or of v where they are to be differentiated once, as a motion (T, parts, M).
        right: the right-hand side at the smoothed states of each recording (T, parts, M).
    """
    left, size = 0.0, 0.0
    twice = problem.order == 2 and problem.chain.levels == 1
    for samples, field, value in zip(problem.data, motion, right, strict=True):
        found = [differentiate(samples.t, field[:, part], "smoothing-spline") for part in range(field.shape[1])]
        rate = np.stack([one.second if twice else one.first for one in found], axis=1)
        left, size = left + float(np.nansum((rate - value) ** 2)), size + float(np.nansum(rate**2))
    return float(np.sqrt(left / size)) if size > 0 else float("nan")
