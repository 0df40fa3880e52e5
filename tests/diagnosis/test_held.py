"""Recordings that begin before the lattice is let go, or go on when it is stuck."""

from __future__ import annotations

import numpy as np
import pytest

from latticebench.bench.inspection import inspect
from latticebench.bench.report.notes import notes
from latticebench.diagnosis.held import freed
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

NOISE, STEP, OMEGA = 0.002, 1 / 30, 4.0
PENDULUM = library("pendulum", "u[n]")
T = np.arange(0, 25, STEP)


def swing(t, decay=0.03):
    """A free swing that is let go at the time 0, at rest."""
    return np.exp(-decay * t) * np.cos(OMEGA * t) / 2


def read(*columns, t=None, seed=0):
    """Readings of some sites with noise."""
    u = np.stack(columns, axis=1)
    draw = np.random.default_rng(seed)
    return Samples(np.arange(len(u)) * STEP if t is None else t, u + NOISE * draw.normal(size=u.shape), source="swing")


def rubbed(t, friction=0.6):
    """A swing under dry friction, half a turn at a time about a place that friction moves, until it sticks."""
    u, at, dead = np.empty(len(t)), 0.5, friction / OMEGA**2
    for half in range(int(t[-1] * OMEGA / np.pi) + 1):
        here = (t * OMEGA >= half * np.pi) & (t * OMEGA < (half + 1) * np.pi)
        stuck = abs(at) <= dead
        about = at if stuck else np.sign(at) * dead
        u[here] = about + (0.0 if stuck else at - about) * np.cos(OMEGA * t[here] - half * np.pi)
        at = at if stuck else 2 * about - at
    return u


@pytest.mark.parametrize("rows", [20, 60, 200])
def test_what_comes_before_a_release_is_left_out_to_the_first_reading_that_moves(rows):
    moving, (held,) = freed(read(np.concatenate([np.full(rows, 0.5), swing(T)])))
    assert held.early
    assert held.rows == len(T) + rows - len(moving.t)
    # It has moved by ten times the noise after that many readings.
    slack = np.sqrt(2 * 10 * NOISE / (0.5 * OMEGA**2)) / STEP + 1
    assert rows <= held.rows <= rows + slack


def test_where_several_sites_are_held_all_of_them_rest():
    still = np.full((60, 2), [0.5, -0.1])
    u = np.concatenate([still, np.stack([swing(T), -0.2 * swing(T)], axis=1)])
    assert freed(read(*u.T))[1][0].rows >= 60
    # A neighbour that swings all the while is not held.
    u[:60, 1] = -0.1 * np.cos(OMEGA * np.arange(-60, 0) * STEP)
    assert freed(read(*u.T))[1] == ()


@pytest.mark.parametrize(
    "u",
    [
        swing(T), swing(T, decay=0.4), 0.3 + swing(T, decay=1.5), np.exp(-T), 1 - np.exp(-T), swing(T)[::-1],
        np.where(T < 5, 0.0, np.sin(OMEGA * (T - 5))), np.cos(OMEGA * T) * np.cos(0.2 * T), 0.001 * T, 0 * T,
        np.where(T < 12, 0.5, -0.5),
    ],
    ids=[
        "swing", "damped", "overdamped", "falls", "rises", "grows", "kicked from where it rests", "beats", "drifts",
        "at rest", "steps",
    ],
)  # fmt: skip
def test_nothing_is_left_out_of_a_motion_without_a_hand(u):
    samples = read(u)
    assert freed(samples) == (samples, ())


def test_a_chain_through_which_a_pulse_travels_is_not_held():
    times = np.arange(0, 30, STEP)
    u = [np.exp(-(((times - 3 - 2 * site) / 0.8) ** 2)) for site in range(10)]
    assert freed(read(*u))[1] == ()


def test_a_swing_that_is_stuck_is_left_out_from_where_it_stops():
    t = np.arange(0, 40, STEP)
    u = rubbed(t)
    moving, (held,) = freed(read(u))
    assert not held.early
    assert moving.t[-1] == held.begin
    # In between it has moved by a few times the noise at most.
    assert np.max(np.abs(u[-held.rows :] - u[-1])) < 10 * NOISE < np.max(np.abs(u[: -held.rows][-30:] - u[-1]))


def test_a_sensor_that_reads_nothing_does_not_hide_where_a_swing_is_stuck():
    u = rubbed(np.arange(0, 40, STEP))
    assert len(freed(read(np.nan * u, u))[1]) == 1


def test_missing_readings_outliers_and_steps_do_not_hide_a_hand():
    u = np.concatenate([np.full(90, 0.5), swing(T)])
    coarse = Samples(np.arange(len(u)) * STEP, np.round(u[:, None] / 0.01) * 0.01, source="coarse")
    assert freed(coarse)[1][0].rows == pytest.approx(91, abs=3)
    u[10:20], u[40] = np.nan, 3.0
    assert freed(read(u))[1][0].rows == pytest.approx(92, abs=4)


def test_a_diagnosis_leaves_out_what_a_hand_does_and_says_so():
    samples = read(np.concatenate([np.full(100, 0.5), swing(T)]))
    found = diagnose(PENDULUM, 2, [samples], [find("damping"), find("constant-force")])
    assert [one.name for one in found.findings] == ["damping"]
    value, error = found.findings[0].values["v[n]"]
    assert value == pytest.approx(-0.06, abs=4 * error)
    assert found.residual[1] == pytest.approx(1.0, abs=0.05)
    (held,) = found.held
    assert found.used == (len(samples.t) - held.rows,) * 2
    said = f"leaves the first {held.rows} readings out"
    assert any(said in one for one in notes(found))
    assert any(said in one for one in inspect(samples).suspicious)


def test_dry_friction_is_found_where_a_recording_goes_on_after_the_stop():
    found = diagnose(
        PENDULUM, 2, [read(rubbed(np.arange(0, 40, STEP)))], [find(n) for n in ("damping", "dry-friction")]
    )
    assert [one.name for one in found.findings] == ["dry-friction"]
    value, error = found.findings[0].values["sign(v[n])"]
    assert value == pytest.approx(-0.6, abs=4 * error + 0.003)
