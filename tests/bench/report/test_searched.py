"""What reports of diagnoses by the search look like: of a real and a complex field, of one sensor, of two records."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from latticebench import systems
from latticebench.bench.report.content import DiagnosisDocument, content, diagnosis_document
from latticebench.bench.report.curves import curves
from latticebench.bench.report.document import Provenance, to_json
from latticebench.bench.report.findings import added
from latticebench.bench.report.notes import notes
from latticebench.bench.report.page import page
from latticebench.bench.report.whereabouts import scaled_residuals, whereabouts
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis.repair import Diagnosis, diagnose
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

Diagnosed = Callable[[str, str, float], Diagnosis]


@pytest.fixture(scope="module")
def diagnosed() -> Diagnosed:
    """Diagnose a specimen of a system that lacks an effect of a given size."""

    def run(system: str, effect: str, z: float) -> Diagnosis:
        studied = systems.find(system)
        specimen = make(studied, effect, z, np.random.default_rng(3), Conditions(sites=9, samples=40))
        declared = studied.library("equation")
        data = [replace(specimen.samples, ends=studied.ends)]
        return diagnose(declared, studied.order, data, CATALOGUE).against(studied.truth(declared, {}))

    return run


@pytest.fixture(scope="module")
def damped(diagnosed: Diagnosed) -> Diagnosis:
    return diagnosed("phi4", "damping", 30)


@pytest.fixture(scope="module")
def driven(diagnosed: Diagnosed) -> Diagnosis:
    return diagnosed("dnls", "drive", 30)


@pytest.fixture(scope="module")
def swing() -> Diagnosis:
    """One pendulum, no velocities, rounded readings."""
    t = np.arange(0, 12, 0.15)
    u = solve_ivp(lambda _, y: [y[1], -np.sin(y[0])], (0, 12), [1.4, 0.0], t_eval=t, rtol=1e-9).y[0]
    u = np.round(u + np.random.default_rng(2).normal(scale=0.01, size=len(t)), 2)
    return diagnose(library("own", "sin(u[n])"), 2, [Samples(t, u[:, None], source="pendulum.csv")], CATALOGUE)


@pytest.fixture(scope="module")
def rough() -> Diagnosis:
    """Two recordings, one of uneven times, both with gaps; a sensor that never answered."""
    specimen = make(systems.find("phi4"), "damping", 40, np.random.default_rng(3), Conditions(sites=9, samples=40))
    draw = np.random.default_rng(1)
    data = []
    for kept in (np.arange(40), np.sort(draw.choice(40, 33, replace=False))):
        u, v = specimen.samples.u[kept].copy(), specimen.samples.v[kept].copy()  # type: ignore[index]
        u[draw.random(u.shape) < 0.1] = v[draw.random(v.shape) < 0.1] = np.nan
        u[:, 3] = np.nan
        data.append(Samples(specimen.samples.t[kept], u, v, source=f"part {len(data) + 1}.csv", ends="free"))
    return diagnose(systems.find("phi4").library("equation"), 2, data, CATALOGUE)


@pytest.mark.parametrize("which", ["damped", "driven", "swing", "rough"])
def test_the_json_has_the_published_form_and_no_numbers_that_json_lacks(
    which: str, request: pytest.FixtureRequest, about: Provenance, conforms: Callable[[str, str], object]
) -> None:
    diagnosis: Diagnosis = request.getfixturevalue(which)
    text = to_json(diagnosis_document(content(diagnosis), about))
    conforms("diagnosis", text)
    found = DiagnosisDocument.model_validate_json(text)
    assert list(found.declared) == list(diagnosis.after.model.declared.texts)
    for horizon in found.horizons:
        assert horizon.models[0].behind == 0
        net = [one.gain - one.price for one in horizon.tried]
        assert net == sorted(net, reverse=True)
    assert (found.error.coefficients is None) == (which in ("swing", "rough"))


@pytest.mark.parametrize("which", ["damped", "driven", "swing", "rough"])
def test_the_page_shows_all_figures_and_equations_in_a_browser(
    which: str, request: pytest.FixtureRequest, check_figures: Callable[[Any, Path], None], tmp_path: Path
) -> None:
    check_figures(request.getfixturevalue(which), tmp_path / "page.html")


def test_what_was_added_is_given_with_its_size_error_and_doubles(damped: Diagnosis) -> None:
    found = content(damped)
    (effect,) = found.effects
    assert found.verdict == "explained"
    assert {effect.effect, *effect.indistinguishable} >= {"damping"}
    (value,), (error,) = effect.coefficients.values(), effect.stderr.values()
    assert value < 0
    assert 5 < -value / error < 100
    assert found.error.residual.after == pytest.approx(1, abs=0.1)
    assert found.error.criterion.after < 0


def test_a_drive_has_its_frequency_among_the_parameters_with_an_error(driven: Diagnosis) -> None:
    (effect,) = added(driven)
    assert effect.effect == "drive"
    assert isinstance(effect.parameters["omega"], float)
    assert 0 < effect.stderr["omega"] < 0.2 * effect.parameters["omega"]
    assert len(effect.coefficients) == 4


def test_a_mass_is_said_as_site_and_ratio(diagnosed: Diagnosed) -> None:
    found = content(diagnosed("phi4", "unequal-masses", 30))
    (effect,) = found.effects
    assert effect.effect == "unequal-masses"
    assert effect.parameters["site"] == 3
    assert effect.natural["mass_ratio"].value == pytest.approx(1 / (1 + effect.coefficients["scale"]))
    assert effect.natural["mass_ratio"].stderr > 0
    assert any(line.startswith("site 3: its whole right-hand side") for line in found.equation.after.elsewhere)


def test_the_noise_of_a_complex_field_is_that_of_each_part(driven: Diagnosis) -> None:
    studied = systems.find("dnls")
    specimen = make(studied, "drive", 30, np.random.default_rng(3), Conditions(sites=9, samples=40))
    found = np.array(list(content(driven).noise.values()))
    assert np.sqrt(2 * np.mean(found**2)) == pytest.approx(specimen.samples.sigma, rel=0.1)


def test_readings_on_a_grid_are_noted_with_what_rounding_does_to_the_noise(swing: Diagnosis) -> None:
    (note,) = [line for line in notes(swing) if "multiples" in line]
    share = float(re.search(r"makes ([\d.]+) %", note)[1])  # type: ignore[index]
    noise = float(swing.noise[0])
    assert "0.01" in note
    assert share == pytest.approx(100 * 0.01**2 / 12 / noise**2, rel=0.05)


def test_a_residual_that_is_noise_lives_nowhere_and_one_at_a_site_lives_there(
    damped: Diagnosis, diagnosed: Diagnosed
) -> None:
    after = whereabouts(damped.after, damped)
    assert len(after.sites) + len(after.times) + len(after.frequencies) <= 1
    defect = diagnosed("phi4", "defect", 40)
    before = whereabouts(defect.before, defect)
    assert before.sites[0].site == added(defect)[0].parameters["site"]
    assert f"site {before.sites[0].site}" in before.words[0]


def test_each_recording_has_one_residual_however_many_pieces_it_was_followed_in(
    rough: Diagnosis, pendula: Callable[..., Any]
) -> None:
    assert [len(t) for t, _ in scaled_residuals(rough.before, rough)] == [40, 33]
    assert "in 2 trajectories" in page(content(rough), curves(rough), None)
    ((t, left),) = scaled_residuals(pendula().before, pendula())
    assert len(t) == len(left) == 800
    assert "trajectories" not in page(content(pendula()), curves(pendula()), None)
