"""A clock that jumps: a camera that drops frames."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import latticebench as lb
from latticebench.diagnosis.acting import WAYS
from latticebench.diagnosis.cure import corrected
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.reading import read_by
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

PENDULA = "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"
DECLARED, TRUTH = library("pendula", PENDULA), (1.5, -16.0)
FRAME, NOISE = 1 / 30, 3e-3


@functools.cache
def exact():
    """Three pendula whose swings fall, as a function of time."""

    def rate(_t, y):
        u, v = np.split(y, 2)
        beside = np.concatenate([u[:1], u[:-1]]) + np.concatenate([u[1:], u[-1:]]) - 2 * u
        return np.concatenate([v, TRUTH[0] * beside + TRUTH[1] * np.sin(u) - 0.06 * v])

    return solve_ivp(rate, (0, 40), [0.4, -0.1, 0.2, 0, 0, 0], rtol=1e-10, atol=1e-11, dense_output=True).sol


def filmed(frames: int, *lost: tuple[int, int]) -> tuple[np.ndarray, Samples]:
    """True times, and a film without some frames: after which, and how many."""
    kept = np.ones(frames, dtype=bool)
    for after, count in lost:
        kept[after + 1 : after + 1 + count] = False
    true = FRAME * np.flatnonzero(kept)
    u = exact()(true)[:3].T
    u = u + NOISE * np.random.default_rng(8).normal(size=u.shape)
    return true, Samples(FRAME * np.arange(len(true)), u, source="film", ends="free")


@pytest.mark.slow
def test_frames_that_a_camera_dropped_are_named_with_how_many_and_when_and_times_are_put_right():
    true, samples = filmed(900, (400, 2))
    found = diagnose(DECLARED, 2, [samples], CATALOGUE)
    effects = {one.name: one for one in found.findings}
    assert (found.verdict, set(effects)) == ("explained", {"damping", "clock-jump"})
    value, error = effects["clock-jump"].values["time that the clock loses"]
    assert value == pytest.approx(2 * FRAME, abs=4 * error)
    assert error < 0.1 * FRAME
    assert 400 * FRAME < effects["clock-jump"].placed.at < 401 * FRAME
    again = corrected(found.after.model, samples, 0)
    np.testing.assert_allclose(again.t, true, atol=4 * error)
    np.testing.assert_allclose(again.u, samples.u, atol=1e-12)


def test_a_dropped_frame_and_no_kick_is_named_where_both_are_tried():
    _, samples = filmed(400, (200, 1))
    effects = [find(name) for name in ("clock-jump", "kick", "local-kick", "damping")]
    found = diagnose(DECLARED, 2, [samples], effects)
    assert {one.name for one in found.findings} == {"damping", "clock-jump"}


def jump(lost: float, at: float, omega: float = 4.2) -> object:
    return WAYS["clock jump"](
        effect=find("clock-jump"), strength=(lost,), at=at, width=0.0, least=0.2 * FRAME, seen=(0, 40), omega=omega
    )


def moving(t: np.ndarray) -> np.ndarray:
    """U, v and the rate of v of three sites that swing at two frequencies: (rows, 3, 1, 3)."""
    sizes, phases = np.array([[1.0, 0.3, -0.5], [0.2, 0.4, 0.1]]), np.array([[0.3], [1.1]])
    found = np.zeros((len(t), 3, 1, 3))
    for size, phase, omega in zip(sizes, phases, (4.0, 4.5), strict=True):
        turned = omega * t[:, None] + phase
        waves = np.cos(turned), -omega * np.sin(turned), -(omega**2) * np.cos(turned)
        found[:, :, 0] += np.stack([size * one for one in waves], axis=1)
    return found


def test_jumps_add_up_to_one_that_loses_as_much_and_a_gain_acts_on_what_is_late():
    t = FRAME * np.arange(300)
    gain = WAYS["gain"](effect=find("sensor-gain"), sites=(1,), strength=(0.3,), both=False)
    read = read_by([jump(0.03, 3.0167), gain, jump(0.07, 6.0167)], t, moving(t))
    later = moving(t + 0.03 * (t > 3.0167) + 0.07 * (t > 6.0167)) * np.array([1.0, 1.3, 1.0])
    away = np.min(np.abs(t[:, None] - [3.0167, 6.0167]), axis=1) > 2 * FRAME
    # The jump takes a little of the time between two frames.
    np.testing.assert_allclose((moving(t) + read.added)[away, 0], later[away, 0], atol=2e-3)
    plain = moving(t + 0.1 * (t > 6.0167)) - moving(t)
    assert np.max(np.abs(plain[away & (t > 7), 0])) > 0.3


def test_where_no_rate_of_v_is_known_a_swing_about_another_middle_is_late_as_one_about_zero_is():
    t = FRAME * np.arange(380)
    u, v = np.cos(4.2 * t)[:, None, None], -4.2 * np.sin(4.2 * t)[:, None, None]
    # Over whole periods the mean is the middle.
    for middle in (0.0, 2.0):
        read = read_by([jump(0.1, 6.0167)], t, np.stack([middle + u, v], axis=1))
        late = t > 6.1
        np.testing.assert_allclose(
            (u[:, 0, 0] + read.added[:, 0, 0, 0])[late], np.cos(4.2 * (t[late] + 0.1)), atol=2e-3
        )


def test_of_several_films_the_one_that_lost_frames_is_named():
    films = [filmed(240, *lost)[1] for lost in ((), ((120, 3),))]
    found = diagnose(DECLARED, 2, films, [find(name) for name in ("clock-jump", "kick", "damping")])
    (jumped,) = (one for one in found.findings if one.name == "clock-jump")
    assert jumped.placed.settings()["recording"] == 2
    value, error = jumped.values["time that the clock loses in recording 2"]
    assert value == pytest.approx(3 * FRAME, abs=4 * error)


def test_near_unknown_ends_no_clock_is_said_to_jump():
    _, samples = filmed(300)
    effects = [find("clock-jump")]
    assert Problem.of(DECLARED, 2, [samples], effects).candidates
    assert not Problem.of(DECLARED, 2, [replace(samples, ends="unknown")], effects).candidates


def test_times_are_left_alone_where_jumps_together_would_put_them_out_of_order():
    samples = Samples(FRAME * np.arange(200), np.zeros((200, 3)), source="film", ends="free")
    back = tuple(jump(-0.9 * FRAME, 100.5 * FRAME + k * 1e-3) for k in range(2))
    assert all(one.possible for one in back)
    np.testing.assert_array_equal(corrected(Model(DECLARED, 2, TRUTH, back), samples, 0).t, samples.t)
    np.testing.assert_allclose(corrected(Model(DECLARED, 2, TRUTH, back[:1]), samples, 0).t, back[0].told(samples.t))


def test_no_clock_goes_back_by_more_than_the_time_between_two_readings():
    assert jump(0.1, 3.0).possible
    assert jump(-0.9 * FRAME, 3.0).possible
    assert not jump(-1.1 * FRAME, 3.0).possible
    assert not jump(0.1, 41.0).possible


def test_a_diagnosis_in_python_gives_the_right_times_and_leaves_nothing_out():
    true, samples = filmed(300, (150, 3))
    cause = lb.diagnose(lb.read(samples.u, time=samples.t), lb.Model(PENDULA, order=2, ends="free"))
    assert "clock-jump" in {one["effect"] for one in cause.effects.reset_index().to_dict("records")}
    assert cause.left_out == ()
    np.testing.assert_allclose(cause.corrected.samples[0].t, true, atol=0.01)
