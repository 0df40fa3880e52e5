"""Columns that are in another order than the sites."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench.bench.calls import judged
from latticebench.bench.report.notes import mixed_up, notes
from latticebench.diagnosis.exchanged import exchanged, of_recordings
from latticebench.diagnosis.problem import Problem
from latticebench.diagnosis.repair import diagnose
from latticebench.methods.method import solve
from latticebench.methods.trajectory import Trajectory
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

T, SITES, NOISE = np.linspace(0, 12, 361), 5, 0.003
PENDULA = library("pendula", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")


def pendula(ends="free"):
    """Five pendula with springs between them, with different zeros of their sensors and some friction."""

    def rate(t, y):
        u, v = np.split(y, 2)
        beyond = np.concatenate([u[:1], u, u[-1:]])
        return np.concatenate([v, 3 * np.diff(beyond, 2) - 20 * np.sin(u) - 0.1 * v])

    start = np.concatenate([[0.4, 0.0, 0.0, 0.1, -0.2], np.zeros(SITES)])
    u = solve_ivp(rate, T[[0, -1]], start, t_eval=T, rtol=1e-9, atol=1e-10).y[:SITES].T
    draw = np.random.default_rng(5)
    u = u + 0.02 * draw.normal(size=SITES) + NOISE * draw.normal(size=u.shape)
    return Samples(T, u, source="five", ends=ends)


def in_order(samples, order):
    return replace(samples, u=samples.u[:, list(order)])


@pytest.mark.parametrize(
    ("order", "ends"),
    [
        ((0, 2, 1, 3, 4), "free"), ((3, 1, 2, 0, 4), "free"), ((1, 2, 0, 3, 4), "free"), ((0, 1, 4, 2, 3), "free"),
        ((0, 2, 1, 3, 4), "unknown"), ((0, 3, 2, 1, 4), "unknown"),
    ],
)  # fmt: skip
def test_the_order_is_found_that_puts_columns_back(order, ends):
    found = of_recordings(PENDULA, 2, [in_order(pendula(ends), order)])
    put_back = [order[k] for k in found]
    assert put_back in ([0, 1, 2, 3, 4], [4, 3, 2, 1, 0])


@pytest.mark.parametrize("ends", ["free", "unknown"])
def test_nothing_is_said_of_columns_in_order_nor_from_the_other_end(ends):
    for order in (range(SITES), reversed(range(SITES))):
        assert exchanged(Problem.of(PENDULA, 2, [in_order(pendula(ends), order)], ())) == ()


@pytest.mark.parametrize("ends", ["free", "unknown"])
@pytest.mark.parametrize("site", range(SITES))
@pytest.mark.parametrize("fault", ["turned", "noise", "gain", "copy"])
def test_a_bad_sensor_is_no_other_order(fault, site, ends):
    found = pendula(ends)
    column = found.u[:, site]
    other = {
        "turned": -column, "gain": 2.5 * column, "copy": found.u[:, (site + 1) % SITES],
        "noise": 0.3 * np.random.default_rng(site).normal(size=column.shape),
    }  # fmt: skip
    u = found.u.copy()
    u[:, site] = other[fault]
    assert of_recordings(PENDULA, 2, [replace(found, u=u)]) == ()


def test_where_more_than_u_was_read_no_option_is_said_to_put_all_in_order():
    data = pendula()
    assert "--columns" not in mixed_up(replace(data, v=data.u), (0, 2, 1, 3, 4))


def test_a_diagnosis_and_a_fit_say_which_columns_look_exchanged(caplog):
    data = [in_order(pendula(), (0, 2, 1, 3, 4))]
    with caplog.at_level(logging.WARNING):
        found = diagnose(PENDULA, 2, data, ())
    assert "with columns in the order u1, u3, u2, u4, u5 the equation leaves much less" in caplog.text
    line = (
        "five: the declared equation leaves much less with the columns in the order u1, u3, u2, u4, u5; if they are "
        "mixed up, --columns u1,u3,u2,u4,u5 reads them so"
    )
    assert f"{line}." in notes(found)
    assert line in judged(data, solve(Trajectory(), data, PENDULA, 2, seed=0)).warnings
