"""What can be seen of an effect: as much as nothing else can do, by direct calculations beside."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from latticebench import systems
from latticebench.bench.trials.faults import FAULTS
from latticebench.bench.trials.faults.setting import Fields, Setting, draw_circumstances
from latticebench.bench.trials.information import beside, explained
from latticebench.bench.trials.sight import Sight
from latticebench.systems.motion import motion

SITES, SIGMA = 7, 0.005


@functools.cache
def scene(name: str) -> tuple[Setting, Fields, Sight]:
    """Return a chain, its clean readings, and the sight of its own equation."""
    system, times = systems.find(name), np.linspace(0, 4, 20)
    chain, draw = motion(system, {}, SITES), np.random.default_rng(2)
    start = chain.pack(*system.initial_state({}, SITES, None, draw))
    setting = Setting(chain, start, times, draw_circumstances("none", SITES, times, draw))
    plain = setting.run()
    return setting, plain, Sight.of(system, plain, times, [SIGMA] * chain.order, chain)


def test_what_others_leave_of_a_change_is_its_distance_from_their_span() -> None:
    rows = np.random.default_rng(1).normal(size=(5, 30))
    change = np.array([0.0, 0.0, 0.0, 2.0, -1.0])
    left, does = explained(rows @ rows.T, change, np.arange(3))
    best, squares = np.linalg.lstsq(rows[:3].T, rows.T @ change, rcond=None)[:2]
    assert left == pytest.approx(np.sqrt(squares[0]))
    np.testing.assert_allclose(does, best)
    rest = beside(rows @ rows.T, np.arange(3))
    assert np.sqrt(change[3:] @ rest @ change[3:]) == pytest.approx(left)


def test_the_size_of_a_large_effect_is_what_the_best_fit_of_the_declared_equation_leaves() -> None:
    setting, _, sight = scene("phi4")
    u, v = FAULTS["bond-defect"].fields(setting, 0.2)
    assert v is not None
    seen = np.concatenate([u, v], axis=1)

    def wrong(x: np.ndarray) -> np.ndarray:
        def rate(_: float, y: np.ndarray) -> np.ndarray:
            wide = np.concatenate([y[:1], y[:SITES], y[SITES - 1 : SITES]])
            values = wide[2:] + wide[:-2] - 2 * y[:SITES], y[:SITES], y[:SITES] ** 3
            return np.concatenate([y[SITES:], sum(c * one for c, one in zip(x, values, strict=False))])

        found = solve_ivp(rate, (0, 4), x[3:], t_eval=setting.times, method="DOP853", rtol=1e-8, atol=1e-9)
        return ((found.y.T - seen) / SIGMA).ravel()

    assert setting.chain.ends == "free"
    best = least_squares(wrong, np.concatenate([sight.coefficients, setting.start]), x_scale="jac")
    assert sight.fitted((u, v)).size == pytest.approx(np.sqrt(2 * best.cost), rel=1e-3)


@pytest.mark.parametrize("name", ["phi4", "dnls"])
def test_to_first_order_a_small_effect_has_the_size_of_a_fit(name: str) -> None:
    setting, _, sight = scene(name)
    fields = FAULTS["bond-defect"].fields(setting, 1e-3)
    assert sight.size(fields) == pytest.approx(sight.fitted(fields).size, rel=0.02)
    assert sight.size(fields) > 0


@pytest.mark.parametrize(
    ("name", "effect", "amount"),
    [
        ("phi4", "damping", 3e-3), ("phi4", "dry-friction", 2e-3), ("phi4", "defect", 1e-2),
        ("phi4", "unequal-masses", 1e-2), ("phi4", "sensor-offset", 1e-2), ("phi4", "sensor-gain", 1e-2),
        ("phi4", "sensor-curve", 3e-3), ("phi4", "clock", 2e-3), ("phi4", "ends", 1.0), ("dnls", "defect", 1e-2),
        ("dnls", "asymmetric-coupling", 1e-2),
    ],
)  # fmt: skip
def test_an_effect_of_the_catalogue_leaves_nothing_of_itself(name: str, effect: str, amount: float) -> None:
    setting, _, sight = scene(name)
    line = sight.fitted(FAULTS[effect].fields(setting, amount))
    assert line.size > 1
    assert sight.apart(line) < (0.6 if effect == "ends" else 0.1) * line.size


def test_what_no_effect_of_the_catalogue_does_is_apart_from_it() -> None:
    setting, _, sight = scene("phi4")
    line = sight.fitted(FAULTS["other: wavy-bonds"].fields(setting, 0.1))
    assert sight.apart(line) > 0.5 * line.size


def test_what_the_declared_equation_can_do_has_no_size() -> None:
    setting, plain, sight = scene("phi4")
    assert sight.size(plain) == 0
    assert sight.size(FAULTS["onsite-linear"].fields(setting, 1e-4)) < 0.01
