"""Fits as cases: what a seed decides, and where a forecast begins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydantic
import pytest

from latticebench.bench import fitting
from latticebench.bench.case import Folders
from latticebench.bench.fitting import FitCase, samples
from latticebench.bench.score import Forecast


def case(**given: object) -> FitCase:
    usual = {
        "system": "phi4",
        "library": "lib2",
        "label": "x",
        "method": "zero",
        "sites": 9,
        "samples": 40,
        "span": 4.0,
    }
    return FitCase.model_validate({**usual, **given})


@pytest.mark.parametrize("system", ["phi4", "dnls"])
def test_every_seed_has_a_noise_of_its_own_and_every_method_the_same(system: str) -> None:
    library = {"phi4": "lib2", "dnls": "four"}[system]
    drawn = []
    for seed in (1, 2, 3):
        (one,) = samples(case(system=system, library=library, noise=0.1, seed=seed), Path())
        (again,) = samples(case(system=system, library=library, noise=0.1, seed=seed, method="stlsq"), Path())
        assert one.exact is not None
        assert np.array_equal(one.u, again.u)
        noise = (one.u - one.exact.u).ravel()
        drawn.append(np.concatenate([noise.real, noise.imag]) if one.is_complex else noise)
    # 360 independent draws: a correlation beyond five standard errors does not happen.
    correlation = np.corrcoef(drawn) - np.eye(3)
    assert np.max(np.abs(correlation)) < 5 / np.sqrt(360)


def test_a_forecast_begins_at_a_state_that_no_sample_has(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def spy(found, library, true, start, exact):  # type: ignore[no-untyped-def]
        seen.append((true.unpack(np.asarray(start)[:, None]), exact))
        return Forecast(0.0, 0.0)

    monkeypatch.setattr(fitting, "forecast", spy)
    one = case()
    one.run(Folders(), one.blank())
    ((u, v), exact) = seen[0]
    (trained,) = samples(one, Path())
    assert trained.exact is not None
    # It is the start of the motion that the forecast is compared with,
    np.testing.assert_allclose(u[0], exact.u[0])
    np.testing.assert_allclose(v[0], exact.v[0])
    # and not one that the samples went through.
    apart = [
        np.sqrt(np.mean((u[0] - at) ** 2 + (v[0] - rate) ** 2))
        for at, rate in zip(trained.exact.u, trained.exact.v, strict=True)
    ]
    assert min(apart) > 0.01 * np.std(trained.exact.u)


def test_the_cutoff_of_the_support_follows_from_the_equation() -> None:
    from latticebench.bench.score import score

    truth, shares = np.array([1.0, 0.02, 0.0]), np.ones(3)
    # A true term of 2 % counts as found, and one that is not there when it is as large.
    assert score(np.array([1.0, 0.019, 0.0]), truth, shares).exact
    assert score(np.array([1.0, 0.009, 0.0]), truth, shares).tpr == 0.5
    assert score(np.array([1.0, 0.02, 0.02]), truth, shares).tpr == pytest.approx(2 / 3)


def test_a_case_is_known_by_its_settings_in_whatever_order_and_has_two_minutes_and_four_gibibytes() -> None:
    given = {"method": "stlsq", "settings": {"threshold": 0.1, "alpha": 0.5}, "parameters": {"C": 1.0, "v": 0.5}}
    other = {name: dict(reversed(one.items())) if isinstance(one, dict) else one for name, one in given.items()}
    assert case(**given).identity == case(**other).identity != case(method="stlsq").identity
    assert (case().time_limit, case().memory_limit) == (120.0, 4096)
    for wrong in ({"time_limit": 0.0}, {"memory_limit": 0}, {"memory_limit": 2**40}):
        with pytest.raises(pydantic.ValidationError):
            case(**wrong)
