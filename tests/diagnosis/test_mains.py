"""Mains in the cables of slow pendula: lines far too fast for the motion are hum of the sensors, not forces."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.diagnosis.fitting import fit
from latticebench.diagnosis.horizon import Layout
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Structure
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.diagnosis.worth import pushed
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

# Pendula of about one cycle per second, readings of 120 and mains of 50 of them.
GRAVITY, COUPLING, DAMPING, NOISE = 40.0, 10.0, 0.08, 0.003
MAINS, TIMES = 100.04 * np.pi, np.arange(960) / 120
DECLARED = library("declared", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")


def swings(damping: float = DAMPING) -> np.ndarray:
    """The angles of two pendula between free ends, without noise (T, 2)."""

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        pull = COUPLING * (y[1] - y[0])
        return np.concatenate([y[2:], np.array([pull, -pull]) - GRAVITY * np.sin(y[:2]) - damping * y[2:]])

    span = (0.0, float(TIMES[-1]))
    found = solve_ivp(slope, span, [0.5, -0.2, 0.0, 0.0], t_eval=TIMES, rtol=1e-10, atol=1e-12)
    return np.asarray(found.y[:2].T)


# Beside a swing of half a radian: less than counts as motion, and more.
@pytest.mark.slow
@pytest.mark.parametrize("sizes", [(0.0, 0.005), (0.006, 0.03)])
def test_mains_are_hum_of_the_sensors_that_have_them(sizes):
    hum = np.array(sizes) * np.cos(MAINS * TIMES + 0.3)[:, None]
    read = swings() + hum + NOISE * np.random.default_rng(5).normal(size=hum.shape)
    found = diagnose(DECLARED, 2, [Samples(TIMES, read, ends="free")], CATALOGUE)
    assert {one.name for one in found.findings} == {"damping", "sensor-hum"}
    hums = [one.placed for one in found.findings if one.name == "sensor-hum"]
    assert all(one.frequency == pytest.approx(MAINS, rel=1e-3) for one in hums)
    seen = sum(one.misread(TIMES, np.zeros((len(TIMES), 1, 1, 2))).added[:, 0, 0] for one in hums)
    np.testing.assert_allclose(seen, hum, atol=NOISE)
    assert found.noise == pytest.approx([NOISE, NOISE], rel=0.1)


@pytest.mark.parametrize("strength", [0.01, 8.0, 30.0])
def test_a_force_that_pushes_harder_than_all_else_costs_nats_as_cauchys_prior_has_it(strength):
    u = swings(damping=0.0)
    problem = Problem.of(DECLARED, 2, [Samples(TIMES, u, ends="free")], CATALOGUE)
    force = next(one for one in problem.candidates if one.effect.name == "local-drive" and one.place[-1] == 1)
    layout = Layout.of(problem, 2, None, 1e-6)
    near = [nodes[rows].copy() for nodes, rows in zip(problem.nodes, layout.rows, strict=True)]
    model = Model(DECLARED, 2, (COUPLING, -GRAVITY), (force.moved([strength, 0.0, 20.0]),))
    found = fit(model, layout, near, structure=Structure(), steps=0)
    assert found is not None
    wave = strength * np.cos(20.0 * (TIMES - force.middle))
    # Along the motion that is fitted, which a force that is not there draws away from the true one.
    first, second = found.curves()[0].field[:, 0, 0].T
    rest = COUPLING * (first - second) - GRAVITY * np.sin(second)
    assert pushed(found) == pytest.approx(np.log1p(np.mean(wave**2) / np.mean(rest**2)), rel=1e-3)
