"""Instruments that are wrong: what is read follows from what there was."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.signal import lfilter

from latticebench import systems
from latticebench.bench.trials.faults import (
    NONE,
)
from latticebench.bench.trials.specimen import Conditions, make

# What is made of a real and of a complex field in the same way; the second is a long test.
BOTH = ["phi4", pytest.param("dnls", marks=pytest.mark.slow)]

SMALL = {"sites": 7, "samples": 20, "span": 4.0}


def made(name, effect, z, seed=2, **options):
    conditions = Conditions(**{**SMALL, "variation": True, **options})
    return make(systems.find(name), effect, z, np.random.default_rng(seed), conditions)


@functools.cache
def drawn(name, effect, z=15, **options):
    return made(name, effect, z, **options)


LIE_ABOUT_BOTH = (
    "sensor-gain-drift",
    "sensor-gain-jump",
    "other: neighbour-crosstalk",
    "other: flickering-lamp",
    "other: averaging-readout",
    "other: floating-ground",
    "other: tilted-camera",
    "other: converter-residue",
    "other: two-cards",
    "other: resampled-rows",
)


def lied(name, effect, **options):
    """What is read, what there was, and the specimen; velocities are read as they are but for `LIE_ABOUT_BOTH`."""
    one, plain = drawn(name, effect, z=40, **options), drawn(name, NONE, **options)
    if plain.clean.v is not None and effect not in LIE_ABOUT_BOTH:
        assert np.array_equal(one.clean.v, plain.clean.v)
    assert np.imag(one.amount) == 0
    return one.clean.u, plain.clean.u, one


@pytest.mark.parametrize("name", BOTH)
def test_the_zero_of_one_sensor_drifts_steadily(name):
    shown, true, one = lied(name, "sensor-drift")
    site, t = int(one.about["site"]), one.clean.t
    steady = np.real(one.amount) * (t - t[0]) / (t[-1] - t[0])
    np.testing.assert_allclose(shown - true, steady[:, None] * (np.arange(true.shape[1]) == site), atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_the_zero_of_one_sensor_wanders_in_steps_that_know_nothing_of_one_another(name):
    shown, true, one = lied(name, "sensor-wander")
    site = int(one.about["site"])
    walk = np.real(shown - true)
    assert np.max(np.abs(np.delete(walk, site, axis=1))) == 0
    steps = np.diff(walk[:, site])
    assert np.std(steps) > 0
    assert abs(np.corrcoef(steps[1:], steps[:-1])[0, 1]) < 4 / np.sqrt(len(steps))


@pytest.mark.parametrize("name", BOTH)
def test_the_gain_of_one_sensor_changes_steadily_or_at_one_time(name):
    for effect in ("sensor-gain-drift", "sensor-gain-jump"):
        shown, true, one = lied(name, effect)
        t, site = one.clean.t, int(one.about["site"])
        steady = (t - t[0]) / (t[-1] - t[0])
        grown = np.real(one.amount) * (steady if effect == "sensor-gain-drift" else t > one.about["at"])
        expected = true * (1 + np.outer(grown, np.arange(true.shape[1]) == site))
        np.testing.assert_allclose(shown, expected, atol=1e-12)
        assert np.ptp(grown) > 0


def test_one_sensor_is_read_by_a_slow_clock():
    shown, true, one = lied("phi4", "sensor-clock", samples=100)
    t, site, slow = one.clean.t, int(one.about["site"]), np.real(one.amount)
    field = CubicHermiteSpline(t, true, one.clean.v)
    expected = np.where(np.arange(true.shape[1]) == site, field(np.clip(t - slow * (t - t[0]), t[0], None)), true)
    np.testing.assert_allclose(shown, expected, atol=0.01 * np.max(np.abs(shown - true)))


@pytest.mark.parametrize("name", BOTH)
def test_one_sensor_hums_at_one_frequency(name):
    shown, true, one = lied(name, "sensor-hum")
    site, t = int(one.about["site"]), one.clean.t
    wave = np.real(one.amount) * np.cos(one.about["hum"] * t + one.about["hum_phase"])
    np.testing.assert_allclose(shown - true, wave[:, None] * (np.arange(true.shape[1]) == site), atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_a_drifting_sensor_warms_up(name):
    shown, true, one = lied(name, "other: drifting-sensor")
    site, t = int(one.about["site"]), one.clean.t
    drift = shown - true
    assert np.max(np.abs(np.delete(drift, site, axis=1))) == 0
    # What is still missing of the whole falls by the same factor in the same time.
    missing = 1 - drift[:, site].real / np.real(one.amount)
    np.testing.assert_allclose(np.log(missing), -(t - t[0]) / one.about["warming"], atol=1e-6)
    assert np.max(np.abs(drift.imag)) == 0


@pytest.mark.parametrize("name", BOTH)
def test_crosstalk_is_of_sensors_side_by_side(name):
    shown, true, one = lied(name, "other: neighbour-crosstalk")
    amount = np.real(one.amount)
    pairs = [(shown, true)] if name == "dnls" else [(shown, true), (one.clean.v, drawn(name, NONE).clean.v)]
    for mixed, own in pairs:
        np.testing.assert_allclose(mixed[:, 3] - own[:, 3], amount * (own[:, 2] + own[:, 4]), atol=1e-12)
        np.testing.assert_allclose(mixed[:, 0] - own[:, 0], amount * own[:, 1], atol=1e-12)
        np.testing.assert_allclose(mixed[:, 6] - own[:, 6], amount * own[:, 5], atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_a_slow_sensor_follows_the_field_as_an_rc_filter(name):
    shown, true, one = lied(name, "other: slow-sensor", samples=100)
    site, lag, t = int(one.about["site"]), np.real(one.amount), one.clean.t
    assert np.max(np.abs(np.delete(shown - true, site, axis=1))) < 1e-7
    # The convolution with exp(-t / lag) / lag, of the field between the samples as a spline has it.
    field = CubicSpline(t, true[:, site])
    for k in (25, 60, 99):
        back = np.linspace(0, t[k] - t[0], 20001)
        weight = np.exp(-back / lag) / lag
        filtered = np.trapezoid(weight * field(t[k] - back), back) + true[0, site] * np.exp(-back[-1] / lag)
        assert abs(shown[k, site] - filtered) < 0.01 * np.max(np.abs(shown - true))


@pytest.mark.parametrize("name", BOTH)
def test_a_clipped_reading_stays_within_its_range(name):
    shown, true, _ = lied(name, "other: clipped-reading")
    parts = [(shown.real, true.real)] if name == "phi4" else [(shown.real, true.real), (shown.imag, true.imag)]
    limit = max(np.max(np.abs(part)) for part, _ in parts)
    assert limit < 0.99 * max(np.max(np.abs(part)) for _, part in parts)
    for part, own in parts:
        inside = np.abs(own) <= limit
        assert np.array_equal(part[inside], own[inside])
        np.testing.assert_allclose(part[~inside], np.sign(own[~inside]) * limit, rtol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_channels_are_read_one_after_the_other(name):
    one, plain = drawn(name, "other: scanned-channels", z=40), drawn(name, NONE, samples=400)
    sweep, t = np.real(one.amount), one.clean.t
    assert sweep > 0
    pairs = [(one.clean.u, plain.clean.u)] if name == "dnls" else [
        (one.clean.u, plain.clean.u), (one.clean.v, plain.clean.v)
    ]  # fmt: skip
    for shown, true in pairs:
        whole = CubicSpline(plain.clean.t, true)
        for site in range(7):
            late = t + sweep * site / 6
            seen = late <= plain.clean.t[-1]
            np.testing.assert_allclose(shown[seen, site], whole(late[seen])[:, site], atol=1e-5)


@pytest.mark.parametrize("name", BOTH)
def test_the_mains_hum_in_step_in_all_wires(name):
    shown, true, one = lied(name, "other: mains-hum", samples=100)
    hum, t = shown - true, one.clean.t
    assert np.max(np.abs(hum.imag)) == 0
    wave = np.cos(one.about["hum"] * t + one.about["hum_phase"])
    strengths = np.real(hum[0]) / wave[0] / np.real(one.amount)
    assert np.all((strengths > 0.5) & (strengths < 1.5))
    assert np.ptp(strengths) > 0.1
    np.testing.assert_allclose(hum.real, np.real(one.amount) * np.outer(wave, strengths), atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_a_slack_needle_stays_until_it_is_dragged(name):
    shown, true, one = lied(name, "other: slack-needle", samples=400)
    slack = np.real(one.amount)
    pairs = [(shown, true)] if name == "phi4" else [(shown.real, true.real), (shown.imag, true.imag)]
    for needle, field in pairs:
        assert np.array_equal(needle[0], field[0])
        assert np.max(np.abs(needle - field)) == pytest.approx(slack, rel=1e-4)
        steps = np.diff(needle, axis=0)
        moves = np.where(np.abs(steps) > 1e-6, np.sign(steps), 0)
        assert 0.02 < np.mean(moves == 0) < 0.98
        # In the midst of being dragged it is the full slack away, from behind.
        dragged = (moves[1:] == moves[:-1]) & (moves[1:] != 0)
        np.testing.assert_allclose((field - needle)[1:-1][dragged], slack * moves[1:][dragged], atol=1e-6)


@pytest.mark.parametrize("name", BOTH)
def test_a_flickering_lamp_lights_all_sites_alike(name):
    shown, true, one = lied(name, "other: flickering-lamp")
    bright = np.sum(shown * np.conj(true), axis=1) / np.sum(np.abs(true) ** 2, axis=1)
    np.testing.assert_allclose(shown, bright[:, None] * true, atol=1e-12)
    assert np.max(np.abs(np.imag(bright))) < 1e-12
    assert np.std(np.real(bright)) == pytest.approx(np.real(one.amount), rel=0.5)
    if name == "phi4":
        np.testing.assert_allclose(one.clean.v, np.real(bright)[:, None] * drawn(name, NONE).clean.v, atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_an_averaging_readout_gives_means_over_the_time_after_each_sample(name):
    shown, _, one = lied(name, "other: averaging-readout")
    plain = drawn(name, NONE, samples=800)
    field, over = CubicSpline(plain.clean.t, plain.clean.u), np.sqrt(np.real(one.amount))
    for k in (0, 7, 14):
        t = one.clean.t[k]
        assert t + over < plain.clean.t[-1]
        mean = np.asarray(field.integrate(t, t + over)) / over
        np.testing.assert_allclose(shown[k], mean, atol=1e-5)


@pytest.mark.parametrize("name", BOTH)
def test_a_floating_ground_is_lifted_by_the_mean_of_all_sites(name):
    shown, true, one = lied(name, "other: floating-ground")
    lifted = np.repeat(np.sum(true, axis=1)[:, None] / 7, 7, axis=1)
    np.testing.assert_allclose(true - shown, np.real(one.amount) * lifted, atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_a_tilted_camera_shows_one_end_too_large_and_the_other_too_small(name):
    shown, true, one = lied(name, "other: tilted-camera")
    scale = 1 + np.real(one.amount) * np.linspace(-1, 1, 7)
    np.testing.assert_allclose(shown, scale * true, atol=1e-12)
    if name == "phi4":
        np.testing.assert_allclose(one.clean.v, scale * drawn(name, NONE).clean.v, atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_stray_spikes_are_few_and_leave_the_other_readings_alone(name):
    shown, true, one = lied(name, "other: stray-spikes", samples=100)
    size, off = np.real(one.amount), (shown - true)[shown != true]
    assert len(off) == 7
    assert np.max(np.abs(off.imag)) == 0
    assert np.all((np.abs(off) > 0.499 * size) & (np.abs(off) < 1.501 * size))
    # In the shortest record, too.
    few, sound, _ = lied(name, "other: stray-spikes")
    assert np.sum(few != sound) == 3


@pytest.mark.parametrize("name", BOTH)
def test_behind_a_capacitor_what_is_constant_fades(name):
    shown, true, one = lied(name, "other: ac-coupling", samples=200)
    leak, t = np.real(one.amount), one.clean.t
    assert leak > 0
    np.testing.assert_allclose(shown[0], true[0], atol=1e-12)
    # What is not shown is on the capacitor, which the shown voltage charges.
    charged = CubicSpline(t, shown).antiderivative()(t)
    np.testing.assert_allclose(true - shown, leak * charged, atol=1e-3 * np.max(np.abs(true - shown)))


def pairs_of(name, one, **options):
    """What is read and what there was, of u, and of v where there is one."""
    plain = drawn(name, NONE, **options)
    return [(one.clean.u, plain.clean.u), *([] if name == "dnls" else [(one.clean.v, plain.clean.v)])]


@pytest.mark.parametrize("name", BOTH)
def test_a_converter_keeps_a_share_of_what_it_read_before(name):
    _, _, one = lied(name, "other: converter-residue")
    share = np.real(one.amount)
    assert 0 < share < 1
    for shown, true in pairs_of(name, one):
        one_after_another = true.reshape(-1)
        read, _ = lfilter([1 - share], [1, -share], one_after_another, zi=share * one_after_another[:1])
        np.testing.assert_allclose(shown.reshape(-1), read, atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_an_error_of_fringes_is_that_of_a_phase_with_a_small_ghost(name):
    shown, true, one = lied(name, "other: cyclic-error")
    size, cycle = np.real(one.amount), one.about["cycle"]
    for read, field in [(shown.real, true.real), *([] if name == "phi4" else [(shown.imag, true.imag)])]:
        fringe = np.exp(1j * np.pi * field / cycle)
        np.testing.assert_allclose(read - field, size * 2 * fringe.real * fringe.imag, atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_a_camera_dims_what_was_bright_a_row_ago(name):
    shown, true, one = lied(name, "other: auto-exposure")
    seen = np.real(np.sum(shown * true.conj(), axis=1) / np.sum(np.abs(true) ** 2, axis=1))
    np.testing.assert_allclose(shown, seen[:, None] * true, atol=1e-12)
    assert np.array_equal(shown[0], true[0])
    assert seen[1] == pytest.approx(1, abs=1e-12)
    light = [sum(abs(number) for number in row) for row in true]
    for k in range(2, 20):
        assert (1 - seen[k]) / np.real(one.amount) == pytest.approx((light[k - 1] - light[0]) / light[0], abs=1e-9)


@pytest.mark.parametrize("name", BOTH)
def test_a_reference_wanders_by_small_steps_for_all_sensors_alike(name):
    shown, true, one = lied(name, "other: wandering-reference", samples=100)
    off = (shown - true) / np.real(one.amount)
    assert np.max(np.abs(off[0])) == 0
    np.testing.assert_allclose(off, np.repeat(off[:, :1], 7, axis=1), atol=1e-9)
    if name == "dnls":
        np.testing.assert_allclose(off.real, off.imag, atol=1e-9)
    # A random walk: steps that know nothing of each other, by which it gets about one away in the whole time.
    steps = np.diff(off[:, 0].real) * 10
    assert np.std(steps) == pytest.approx(1, abs=0.25)
    assert abs(np.corrcoef(steps[1:], steps[:-1])[0, 1]) < 0.3


@pytest.mark.parametrize("name", BOTH)
def test_a_second_card_falls_behind_the_first(name):
    _, _, one = lied(name, "other: two-cards")
    size, t = np.real(one.amount), one.clean.t
    dense = drawn(name, NONE, samples=400)
    assert size > 0
    late = t + size * (t - t[0])
    seen = late <= dense.clean.t[-1]
    assert np.sum(seen) > 10
    for k, (shown, true) in enumerate(pairs_of(name, one)):
        whole = CubicSpline(dense.clean.t, dense.clean.u if k == 0 else dense.clean.v)
        np.testing.assert_allclose(shown[:, :3], true[:, :3], atol=1e-7)
        np.testing.assert_allclose(shown[seen, 3:], whole(late[seen])[:, 3:], atol=1e-5)


def test_mixers_that_are_not_alike_show_one_part_larger_than_the_other():
    shown, true, one = lied("dnls", "other: mixer-imbalance")
    size = np.real(one.amount)
    np.testing.assert_allclose(shown.real, (1 + size) * true.real, atol=1e-12)
    np.testing.assert_allclose(shown.imag, (1 - size) * true.imag, atol=1e-12)


@pytest.mark.parametrize("name", BOTH)
def test_resampled_rows_lie_on_straight_lines_between_the_recorders_own(name):
    _, _, one = lied(name, "other: resampled-rows")
    dense, step, t = drawn(name, NONE, samples=400), np.sqrt(np.real(one.amount)), one.clean.t
    own = np.arange(t[0], dense.clean.t[-1], step)
    seen = t <= own[-1]
    assert np.sum(seen) > 10
    for k, (shown, true) in enumerate(pairs_of(name, one)):
        field = CubicSpline(dense.clean.t, dense.clean.u if k == 0 else dense.clean.v)(own)
        read = np.stack([np.interp(t[seen], own, column) for column in field.T], axis=1)
        np.testing.assert_allclose(shown[seen], read, atol=1e-5)
        assert np.max(np.abs(shown - true)) > 1e-3


def test_jitter_moves_rows_by_times_that_differ():
    one = drawn("phi4", "other: jittered-rows", z=40)
    plain = drawn("phi4", NONE)
    moved = one.clean.u - plain.clean.u
    late = np.sum(moved * plain.clean.v, axis=1) / np.sum(plain.clean.v**2, axis=1)
    assert np.std(late) > 3 * abs(np.mean(late)) / np.sqrt(len(late))
    assert np.array_equal(one.samples.t, plain.samples.t)


def test_a_slow_clock_is_late_in_proportion_to_the_time():
    one, plain = drawn("phi4", "clock"), drawn("phi4", NONE)
    late = np.real(one.amount) * plain.clean.t
    later = CubicHermiteSpline(plain.clean.t, plain.clean.u, plain.clean.v)(plain.clean.t + late)
    inside = plain.clean.t + late <= plain.clean.t[-1]
    np.testing.assert_allclose(one.clean.u[inside], later[inside], atol=2e-4)
    assert np.max(np.abs(one.clean.u - plain.clean.u)) > 1e-2
