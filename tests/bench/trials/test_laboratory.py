"""Recordings as laboratories make them: what is in them, how large it is, and what the instruments do."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
import scipy.linalg
import scipy.stats

from latticebench.bench.trials.laboratory import LabRecording, effects, make_recording, making
from latticebench.bench.trials.laboratory.chains import draw_chain
from latticebench.bench.trials.laboratory.instruments import DIGITS, HELD_OUT, KINDS, Instrument, Kind, draw_instrument
from latticebench.systems.effects import find
from latticebench.systems.errors import InputError
from latticebench.systems.motion import Motion
from latticebench.systems.simulate import noise_size
from latticebench.systems.terms import Term

LINEAR = ("u[n+1]+u[n-1]-2*u[n]", "u[n]")


def linear_chain_of_two(names: list[str], ends: str = "free") -> LabRecording:
    """Return a recording of two sites of which everything is linear."""
    found = (make_recording(seed, "white", names, sites=2) for seed in range(1, 50))
    return next(one for one in found if one.declared.texts == LINEAR and one.chain.ends == ends)


def test_the_same_seed_makes_the_same_recording_and_another_seed_another() -> None:
    one, again, other = (make_recording(seed, "spikes", ["damping"], sites=1) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.samples.t, again.samples.t)
    np.testing.assert_array_equal(one.samples.u, again.samples.u)
    assert one.effects == again.effects
    assert one.clean.shape != other.clean.shape or not np.allclose(one.clean, other.clean)


def test_sizes_are_those_of_the_exact_solution_of_a_linear_chain() -> None:
    one = linear_chain_of_two(["damping", "sensor-gain"])
    chain = one.chain
    gained = next(each.site for each in one.effects if each.name == "sensor-gain")
    near = chain.shifts[1] + chain.shifts[-1] - 2 * np.eye(2)
    damping, gain = (next(iter(each.parameters.values())) for each in one.effects)
    truth = np.array([*chain.start.ravel(), *one.coefficients, damping, gain])
    step = scipy.linalg.expm

    def readings(p: np.ndarray) -> np.ndarray:
        force = p[4] * near + p[5] * np.eye(2)
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [force, p[6] * np.eye(2)]])
        turn, state, rows = step(matrix * (one.samples.t[1] - one.samples.t[0])), p[:4], []
        for _ in one.samples.t:
            rows.append(state[:2])
            state = turn @ state
        return np.asarray(rows) * np.where(np.arange(2) == gained, p[7], 1.0)

    np.testing.assert_allclose(readings(truth), one.clean, rtol=0, atol=1e-7 * chain.size)
    widths = 1e-5 * np.array([chain.size] * 2 + [chain.size * chain.fast] * 2 + [*abs(one.coefficients), 1e-2, 1.0])
    columns = [
        (readings(truth + h * row) - readings(truth - h * row)).ravel() / (2 * h)
        for h, row in zip(widths, np.eye(8), strict=True)
    ]
    sigma = draw_level(one)
    scale = np.abs(widths)
    jacobian = np.stack(columns, axis=1) * scale / sigma
    errors = scale * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    expected = [abs(damping) / errors[6], abs(gain - 1) / errors[7]]
    np.testing.assert_allclose([each.z for each in one.effects], expected, rtol=1e-3)


def draw_level(one: LabRecording) -> float:
    """Return the noise that the z of a white recording was computed for: the drawn level times the RMS."""
    drawn = np.random.default_rng([one.seed, attempt_of(one)])
    making.draw_chain(drawn, 2)
    level = draw_instrument(drawn, 2, "white").level
    return level * float(np.sqrt(np.mean(np.var(one.clean, axis=0))))


def attempt_of(one: LabRecording) -> int:
    """Return the draw that a recording came from."""
    starts = (making.draw_chain(np.random.default_rng([one.seed, k]), 2).start for k in range(1, making.ATTEMPTS))
    return 1 + next(k for k, start in enumerate(starts) if np.array_equal(start, one.chain.start))


def test_what_a_recording_cannot_tell_from_an_effect_is_said_beside_it() -> None:
    # Either site may have the spring of its own: the common stiffness makes up for the other.
    defect = linear_chain_of_two(["defect"]).effects[0]
    assert defect.sites == (0, 1)
    assert "disorder" in defect.alike
    # Between walls, one sensor's scale is a coupling that differs between the two ways, however strong it is.
    gain = linear_chain_of_two(["sensor-gain"], "fixed").effects[0]
    assert gain.sites == (0, 1)
    assert gain.alike == ("asymmetric-coupling",)


def moved(
    one: LabRecording, more: Sequence[tuple[float, str]] = (), ago: float | np.ndarray = 0.0, rows: int = 60
) -> np.ndarray:
    """Return positions at the first times, or a while ago, by the declared terms and more: numbers and texts."""
    pieces = [*zip(one.coefficients.tolist(), one.declared.texts, strict=True), *more]
    term = Term(" + ".join(f"({size!r})*({text})" for size, text in pieces))
    motion = Motion(term, 2, is_complex=False, sites=one.chain.sites, ends=one.chain.ends)
    times, start = one.samples.t[:rows] - ago, motion.pack(*one.chain.start)
    states = np.empty((len(start), rows))
    for there, end in ((times < 0, -ago), (times >= 0, times[-1])):
        if np.any(there):
            states[:, there] = scipy.integrate.solve_ivp(
                motion.right_hand_side, (0.0, end), start, method="DOP853", rtol=1e-10, atol=1e-10 * one.chain.size,
                dense_output=True,
            ).sol(times[there])  # fmt: skip
    return np.asarray(motion.unpack(states)[0])


@pytest.mark.parametrize(
    "names",
    [
        ["damping", "next-neighbour", "nonlinear-coupling", "quadratic-drag"],
        ["quadratic-coupling", "nonlinear-damping"],
        pytest.param(["asymmetric-coupling", "constant-force", "onsite-quintic"], marks=pytest.mark.slow),
    ],
)
def test_a_recording_moves_by_the_formulas_of_its_effects_in_the_catalogue(names: list[str]) -> None:
    one = make_recording(2, "white", names, sites=4)
    more = [(float(each.parameters["coefficient"]), find(each.name).formula) for each in one.effects]
    np.testing.assert_allclose(moved(one, more), one.clean[:60], rtol=0, atol=1e-6 * one.chain.size)


@pytest.mark.parametrize("name", [effects.HUM, effects.MAINS])
def test_the_hum_of_a_sensor_is_in_its_readings_and_does_not_move_the_chain(name: str) -> None:
    one = make_recording(4, "white", [name], sites=3)
    (hum,) = one.effects
    assert hum.site is not None
    highest = (1 / effects.PER_HALF) * np.pi / np.median(np.diff(one.samples.t))
    assert hum.name == effects.HUM
    assert (hum.parameters["omega"] > 4 * one.chain.fast) == (name == effects.MAINS)
    assert hum.parameters["omega"] < 1.01 * highest
    expected = moved(one)
    phase = hum.parameters["omega"] * one.samples.t[:60]
    expected[:, hum.site] += hum.parameters["cos"] * np.cos(phase) + hum.parameters["sin"] * np.sin(phase)
    np.testing.assert_allclose(expected, one.clean[:60], rtol=0, atol=1e-6 * one.chain.size)


def test_a_curve_of_one_sensor_bends_its_readings_and_no_others() -> None:
    one = make_recording(3, "white", [effects.OWN_CURVE], sites=2)
    (bent,) = one.effects
    assert bent.name == "sensor-curve"
    assert bent.site is not None
    expected = moved(one)
    expected[:, bent.site] += bent.parameters[f"curve_{bent.site + 1}"] * expected[:, bent.site] ** 2
    np.testing.assert_allclose(expected, one.clean[:60], rtol=0, atol=1e-6 * one.chain.size)


def test_a_sensor_that_lags_reads_where_the_site_was_a_moment_ago() -> None:
    one = make_recording(3, "white", [effects.LAG], sites=2)
    (late,) = one.effects
    assert late.site is not None
    lag = late.parameters[f"lag_{late.site + 1}"]
    assert 0 < lag * one.chain.fast <= 0.3
    expected = moved(one)
    expected[:, late.site] = moved(one, ago=lag)[:, late.site]
    np.testing.assert_allclose(expected, one.clean[:60], rtol=0, atol=1e-6 * one.chain.size)


def test_sensors_that_hear_their_neighbours_fade_or_are_slow_read_what_their_words_say() -> None:
    for name in (effects.CROSSTALK, effects.FADING, effects.OWN_CLOCK):
        one = make_recording(3, "white", [name], sites=3)
        (wrong,) = one.effects
        expected, (value,) = moved(one), wrong.parameters.values()
        t, span = one.samples.t[:60], one.samples.t[-1]
        if name == effects.CROSSTALK:
            expected = expected + value * expected @ (np.eye(3, k=1) + np.eye(3, k=-1))
        elif name == effects.FADING:
            expected[:, wrong.site] *= 1 + value * t / span
        else:
            assert 0 < value * span * one.chain.fast <= 0.5
            expected[:, wrong.site] = moved(one, ago=value * t)[:, wrong.site]
        np.testing.assert_allclose(expected, one.clean[:60], rtol=0, atol=1e-6 * one.chain.size)


def test_a_range_that_changes_an_error_that_repeats_and_frames_that_are_lost_are_read_as_their_words_say() -> None:
    for name in (effects.RANGE, effects.CYCLIC, effects.DROPPED):
        one = make_recording(3, "white", [name], sites=3)
        (wrong,) = one.effects
        expected, t, of = moved(one), one.samples.t[:60], dict(wrong.parameters)
        later = one.samples.t > of.get("when", np.inf)
        if name == effects.DROPPED:
            # The motion goes on beside the clock: what is read after the loss is what came later.
            whole = moved(one, ago=-of["lost"], rows=len(later))
            np.testing.assert_allclose(whole[later], one.clean[later], rtol=0, atol=1e-6 * one.chain.size)
            assert 0 < of["lost"] * one.chain.fast <= 2
        elif name == effects.RANGE:
            whole, (change, _) = moved(one, rows=len(later)), of.values()
            whole[later, wrong.site] *= 1 + change
            np.testing.assert_allclose(whole, one.clean, rtol=0, atol=1e-6 * one.chain.size)
        else:
            sine, cosine, k = of.values()
            angle = k * expected[:, wrong.site]
            expected[:, wrong.site] += sine * np.sin(angle) + cosine * (np.cos(angle) - 1)
        before = t <= of.get("when", np.inf)
        np.testing.assert_allclose(expected[before], one.clean[:60][before], rtol=0, atol=1e-6 * one.chain.size)


@pytest.mark.parametrize("name", [effects.SIDE_MASS, effects.SWAYING])
def test_what_hangs_or_carries_and_is_not_read_moves_as_newton_says_for_an_observer_at_rest(name: str) -> None:
    """In the coordinates of a resting observer, in which Newton's third law can be read off the equations."""
    one = make_recording(8, "white", [name, "local-friction"], sites=3)
    assert (one.declared.texts, one.chain.ends) == (LINEAR, "free")
    (swings, rubs), (coupling, own) = one.effects, one.coefficients
    of, chain = swings.parameters, one.chain
    assert rubs.site is not None
    thin = chain.size * chain.fast * 0.01

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        x, w, speed = y[:3], y[3:6], y[7]
        carried = name == effects.SWAYING
        u, v = (x - y[6], w - speed) if carried else (x, w)
        force = coupling * np.diff(np.diff(u, prepend=u[0], append=u[-1])) + own * u
        force[rubs.site] += rubs.parameters["coefficient"] * np.tanh(v[rubs.site] / thin)
        if carried:
            # The support pushes each site by F of mass 1; its own mass is 1 / of["mass"].
            back = -of["mass"] * force.sum() - of["omega"] ** 2 * y[6] - of["gamma"] * speed
        else:
            pull = of["omega"] ** 2 * (y[6] - u[swings.site]) + of["gamma"] * (speed - v[swings.site])
            force[swings.site] += of["mass"] * pull
            back = -pull
        return np.concatenate([w, force, [speed, back]])

    (place, speed), times = (of["y"], of["rate"]), one.samples.t[:60]
    shift = np.array([place, speed]) if name == effects.SWAYING else np.zeros(2)
    start = np.concatenate([chain.start[0] + shift[0], chain.start[1] + shift[1], [place, speed]])
    exact = scipy.integrate.solve_ivp(
        rate, (0.0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-10, atol=1e-10 * chain.size
    ).y
    seen = exact[:3] - exact[6] if name == effects.SWAYING else exact[:3]
    np.testing.assert_allclose(seen.T, one.clean[:60], rtol=0, atol=1e-6 * chain.size)


@pytest.mark.parametrize("names", [["local-drive", "local-damping", "bond-defect"]])
def test_what_acts_at_one_site_or_bond_is_what_an_equation_written_by_hand_says(names: list[str]) -> None:
    one = next(
        found
        for seed in range(1, 50)
        if (found := make_recording(seed, "white", names, sites=4)).declared.texts == LINEAR
        and found.chain.ends == "free"
    )
    (drive, damper, bond), each, (coupling, own) = one.effects, np.eye(4), one.coefficients
    assert None not in (drive.site, damper.site, bond.site)
    wave, spring = drive.parameters, each[bond.site] - each[bond.site + 1]

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        u, v = y[:4], y[4:]
        force = coupling * np.diff(np.diff(u, prepend=u[0], append=u[-1])) + own * u
        angle = wave["omega"] * t
        force += each[drive.site] * (wave["cos"] * np.cos(angle) + wave["sin"] * np.sin(angle))
        force += each[damper.site] * damper.parameters["coefficient"] * v
        return np.concatenate([v, force - bond.parameters["coefficient"] * spring * (spring @ u)])

    times, start = one.samples.t[:60], one.chain.start.ravel()
    exact = scipy.integrate.solve_ivp(
        rate, (0.0, times[-1]), start, t_eval=times, method="DOP853", rtol=1e-10, atol=1e-10 * one.chain.size
    )
    np.testing.assert_allclose(exact.y[:4].T, one.clean[:60], rtol=0, atol=1e-6 * one.chain.size)


def test_what_is_drawn_is_within_its_bounds() -> None:
    for seed in (1, 2, 3):
        one = make_recording(seed, sites=2)
        assert 400 <= len(one.samples.t) <= 5000
        assert 9.9 <= one.chain.span * one.chain.fast / (2 * np.pi) <= 80.1
        assert len(one.effects) <= effects.MOST_EFFECTS
        assert all(each.z >= making.SMALLEST and each.apart >= making.APART for each in one.effects)
        assert one.samples.v is None
        assert one.samples.sigma is None


def test_kinds_of_instruments_that_are_held_out_are_never_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def attempt(draw: object, wanted: Any, seed: int) -> str:
        asked.append(wanted.instrument)
        return "made"

    monkeypatch.setattr(making, "_attempt", attempt)
    for seed in range(400):
        make_recording(seed)
    assert set(asked) == set(KINDS)
    assert not set(KINDS) & set(HELD_OUT)


@pytest.mark.parametrize("names", effects.HELD_OUT)
def test_combinations_that_are_held_out_are_never_drawn(monkeypatch: pytest.MonkeyPatch, names: set[str]) -> None:
    drawn: list[set[str]] = []

    def sized(experiment: object, chosen: Sequence[effects.Ingredient], draw: object) -> None:
        drawn.append({one.name for one in chosen})

    monkeypatch.setattr(making, "OFTEN", dict.fromkeys(names, 1e6))
    monkeypatch.setattr(making, "ATTEMPTS", 6)
    monkeypatch.setattr(making, "_sized", sized)
    with pytest.raises(InputError, match="6 draws gave no recording"):
        make_recording(11, "white", count=len(names), sites=2)
    # All but one of them, which would come next.
    assert any(len(one & names) == len(names) - 1 for one in drawn)
    assert not any(names <= one for one in drawn)


@pytest.mark.parametrize("names", effects.HELD_OUT)
def test_combinations_that_are_held_out_are_made_when_asked_for(names: set[str]) -> None:
    asked = make_recording(11, "white", sorted(names), sites=2)
    assert {each.name for each in asked.effects} == names


def waves(rows: int = 20000) -> tuple[np.ndarray, np.ndarray, float]:
    """Return times, clean readings of two sensors, and the root mean square of these about their means."""
    times = np.linspace(0, 200.0, rows)
    clean = np.stack([np.sin(times), np.cos(1.3 * times)], axis=1)
    return times, clean, float(np.sqrt(np.mean(np.var(clean, axis=0))))


def noise_of(kind: Kind) -> tuple[Instrument, np.ndarray]:
    """Return an instrument and its noise in units of what its scale is."""
    draw = np.random.default_rng(5)
    instrument = draw_instrument(draw, 2, kind)
    times, clean, rms = waves()
    noisy = instrument.read(clean, times, rms, draw)
    return instrument, (noisy - clean) / (instrument.level * rms * instrument.each)


def test_white_noise_is_normal_of_the_level_and_heavy_tails_are_those_of_students_t() -> None:
    _, white = noise_of("white")
    assert scipy.stats.kstest(white.ravel(), "norm").pvalue > 1e-3
    _, heavy = noise_of("heavy-tailed")
    assert scipy.stats.kstest(heavy.ravel(), scipy.stats.t(3).cdf).pvalue > 1e-3


def test_coloured_noise_is_correlated_from_reading_to_reading() -> None:
    instrument, noise = noise_of("coloured")
    together = np.mean(noise[1:] * noise[:-1]) / np.mean(noise**2)
    assert 0.5 <= instrument.memory <= 0.85
    assert together == pytest.approx(instrument.memory, abs=0.02)
    assert np.std(noise) == pytest.approx(1, abs=0.03)


def test_a_coarse_converter_reads_multiples_of_its_step() -> None:
    draw = np.random.default_rng(5)
    instrument = draw_instrument(draw, 2, "coarse")
    times, clean, rms = waves()
    noisy = instrument.read(clean, times, rms, draw)
    step = instrument.level * rms
    np.testing.assert_allclose(noisy / step, np.round(noisy / step), atol=1e-9)
    assert np.std(noisy - clean) == pytest.approx(step * np.sqrt(1 / 12 + 0.01), rel=0.05)


def test_proportional_noise_grows_with_the_reading_and_unequal_noise_differs_between_sensors() -> None:
    instrument, noise = noise_of("proportional")
    _, clean, rms = waves()
    far = np.abs(clean) > 0.95
    near = np.abs(clean) < 0.05
    expected = np.sqrt(1 + instrument.growth * np.mean(clean[far] ** 2) / rms**2)
    assert np.std(noise[far]) / np.std(noise[near]) == pytest.approx(expected, rel=0.08)
    unequal, _ = noise_of("unequal")
    assert 2 <= unequal.each.max() / unequal.each.min() <= 10


def test_spikes_are_a_few_readings_far_out() -> None:
    instrument, noise = noise_of("spikes")
    share = np.mean(np.abs(noise) > 8)
    assert share == pytest.approx(instrument.rate, rel=0.2)
    assert np.max(np.abs(noise)) <= 50


def test_a_zero_drifts_at_one_sensor_by_a_few_sizes_of_the_noise() -> None:
    instrument, noise = noise_of("drifting-zero")
    slow = noise.reshape(100, -1, 2).mean(axis=1)
    still = 1 - instrument.drifter
    assert np.ptp(slow[:, instrument.drifter]) > 2
    assert np.ptp(slow[:, still]) < 0.6


def test_gaps_are_uneven_times_stretches_or_cells() -> None:
    seen = set()
    for seed in range(12):
        draw = np.random.default_rng(seed)
        instrument = draw_instrument(draw, 2, "gaps")
        taken, recorded = instrument.times(10.0, 1000, draw)
        np.testing.assert_array_equal(taken, recorded)
        gone = instrument.missing(1000, 2, draw)
        rows = gone.all(axis=1)
        seen.add("uneven" if instrument.uneven else "cells" if instrument.cells else "stretches")
        if instrument.cells:
            assert gone.mean() == pytest.approx(instrument.gone, abs=0.02)
        elif not instrument.uneven:
            # The stretches may overlap.
            assert 0 < rows.mean() <= instrument.gone + 0.01
            assert np.count_nonzero(np.diff(rows.astype(int)) == 1) <= 4
    assert seen == {"uneven", "cells", "stretches"}


def test_jittered_times_are_recorded_as_they_were_or_rounded() -> None:
    for seed in range(8):
        draw = np.random.default_rng(seed)
        instrument = draw_instrument(draw, 2, "jittered-gaps")
        taken, recorded = instrument.times(10.0, 1000, draw)
        wrong = np.max(np.abs(taken - recorded)) * 999 / 10.0
        assert np.all(np.diff(recorded) > 0)
        assert np.std(np.diff(taken)) > 0.03 * 10.0 / 999
        assert wrong == 0 if not instrument.digits else 0 < wrong <= 0.51 / DIGITS
        assert instrument.missing(1000, 2, draw).any()


def test_whitened_columns_tell_as_much_as_the_noise_lets_through() -> None:
    """The mean of readings of a constant: its variance over many draws is that of the best estimate."""
    rows, rms = 400, 1.0
    column = np.ones((rows, 1, 1))
    for kind in ("white", "coloured"):
        draw = np.random.default_rng(2)
        instrument = dataclasses.replace(draw_instrument(draw, 1, kind), level=0.5)
        clean = np.zeros((rows, 1))
        information = float(np.sum(instrument.whitened(column, clean, rms) ** 2))
        means = [np.mean(instrument.read(clean, np.arange(rows), rms, draw)) for _ in range(800)]
        assert np.var(means) * information == pytest.approx(1, abs=0.2)


def test_the_noise_of_a_recording_is_what_was_added() -> None:
    one = make_recording(4, "white", [], sites=1)
    left = one.samples.u - one.clean
    assert np.sqrt(np.mean(left**2)) == pytest.approx(one.noise[0], rel=1e-9)
    assert 0.0015 < one.noise[0] / noise_size(one.clean, 1.0) < 0.06


def test_offsets_beside_unknown_ends_are_those_with_which_the_readings_follow_the_inner_equations() -> None:
    one = make_recording(3, "white", ["sensor-offset"], sites=5)
    chain, effect = one.chain, one.effects[0]
    assert (one.samples.ends, one.declared.texts) == ("unknown", LINEAR)
    curve = scipy.interpolate.make_interp_spline(one.samples.t, one.clean, k=7)
    near = chain.shifts[1] + chain.shifts[-1] - 2 * np.eye(5)
    inner = slice(len(one.samples.t) // 10, -len(one.samples.t) // 10)

    def misfit(offsets: dict[str, float]) -> float:
        """Return the largest acceleration of an inner site that the equation does not give, in units of all."""
        u = one.clean - np.array([offsets.get(f"offset_{k + 1}", 0.0) for k in range(5)])
        left = curve(one.samples.t, 2) - one.coefficients[0] * u @ near.T - one.coefficients[1] * u
        return float(np.max(np.abs(left[inner, 1:-1])) / (chain.fast**2 * chain.size))

    beside, true = dict(effect.beside), dict(effect.parameters)
    assert set(beside) == {"offset_2", "offset_3", "offset_4"}
    assert misfit(beside) < 1e-4
    assert misfit(true) < 1e-4
    assert misfit({name: true[name] for name in beside}) > 1e-3


def test_where_forces_are_not_linear_no_offsets_do_what_those_of_outer_sensors_do() -> None:
    chain = draw_chain(np.random.default_rng(1), 3)
    of = {LINEAR[0]: np.array([[2.0]]), "u[n]": np.array([[-1.0]])}
    found = chain.displaced({0: 1.0, 2: 3.0}, of)
    assert found is not None
    np.testing.assert_allclose(found, [1.0, 2 * (1 + 3) / (2 * 2 + 1), 3.0])
    assert chain.displaced({0: 1.0, 2: 3.0}, {**of, "u[n]**3": np.array([[-1.0]])}) is None
