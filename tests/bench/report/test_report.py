"""What a diagnosis looks like to a program, at a terminal and in a browser."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from latticebench import systems
from latticebench.bench.report import pictures, rows
from latticebench.bench.report.content import DiagnosisDocument, content, diagnosis_document
from latticebench.bench.report.curves import curves
from latticebench.bench.report.document import Provenance, to_dict, to_json
from latticebench.bench.report.equation import equation
from latticebench.bench.report.findings import added
from latticebench.bench.report.notes import notes, strays
from latticebench.bench.report.page import page, write_page
from latticebench.bench.report.separation import separation
from latticebench.bench.report.text import show
from latticebench.bench.report.whereabouts import scaled_residuals, spectrum, whereabouts
from latticebench.bench.trials.specimen import Conditions, make
from latticebench.diagnosis.repair import Diagnosis, diagnose
from latticebench.systems.effects import CATALOGUE, find
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)


def diagnosed(system: str, effect: str, z: float) -> Diagnosis:
    studied = systems.find(system)
    specimen = make(studied, effect, z, np.random.default_rng(3), Conditions(sites=9, samples=40))
    declared = studied.library("equation")
    data = [replace(specimen.samples, ends=studied.ends)]
    return diagnose(declared, studied.order, data, CATALOGUE).against(studied.truth(declared, {}))


@pytest.fixture(scope="module")
def damped() -> Diagnosis:
    return diagnosed("phi4", "damping", 30)


@pytest.fixture(scope="module")
def driven() -> Diagnosis:
    return diagnosed("dnls", "drive", 30)


@pytest.fixture(scope="module")
def pendulum() -> Diagnosis:
    """One site, no velocities, rounded readings."""
    from scipy.integrate import solve_ivp

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


@pytest.fixture(scope="module")
def about() -> Provenance:
    return Provenance(command="latticebench diagnose", commit="c", date="d", machine="m", versions={}, seeds=[1])


def page_of(diagnosis: Diagnosis, about: Provenance | None = None) -> str:
    return page(content(diagnosis), curves(diagnosis), about)


@pytest.mark.parametrize("which", ["damped", "driven", "pendulum", "rough"])
def test_the_json_has_the_published_form_and_no_numbers_that_json_lacks(
    which: str, request: pytest.FixtureRequest, about: Provenance, conforms: Callable[[str, str], object]
) -> None:
    diagnosis: Diagnosis = request.getfixturevalue(which)
    text = to_json(diagnosis_document(content(diagnosis), about))
    conforms("diagnosis", text)
    found = DiagnosisDocument.model_validate_json(text)
    assert list(found.declared) == list(diagnosis.course.after.model.declared.texts)
    for turn in found.rounds:
        evidence = [entry.evidence for entry in turn.ranking]
        assert evidence == sorted(evidence, reverse=True)
    assert (found.error.coefficients is None) == (which in ("pendulum", "rough"))


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


def test_the_noise_of_a_complex_field_is_that_of_both_parts_together(driven: Diagnosis) -> None:
    sigma = driven.course.after.data[0]
    assert sigma.is_complex
    studied = systems.find("dnls")
    specimen = make(studied, "drive", 30, np.random.default_rng(3), Conditions(sites=9, samples=40))
    assert content(driven).noise == pytest.approx(specimen.samples.sigma, rel=0.1)


def test_a_drive_has_its_frequency_among_the_parameters_with_an_error(driven: Diagnosis) -> None:
    (effect,) = added(driven)
    assert effect.effect == "drive"
    assert effect.parameters["omega"] > 0
    assert 0 < effect.stderr["omega"] < 0.2 * effect.parameters["omega"]
    assert len(effect.coefficients) == 4


def test_a_mass_is_said_as_site_scale_and_ratio() -> None:
    diagnosis = diagnosed("phi4", "unequal-masses", 30)
    (effect,) = added(diagnosis)
    assert effect.effect == "unequal-masses"
    assert effect.parameters["site"] == 3
    assert effect.parameters["mass_ratio"] == pytest.approx(1 / (1 + effect.parameters["scale"]))
    assert effect.stderr["mass_ratio"] > 0
    assert any(
        line.startswith("site 3: its whole right-hand side") for line in equation(diagnosis.course.after).elsewhere
    )


def test_a_sensor_is_named_by_the_column_of_the_file() -> None:
    diagnosis = diagnosed("phi4", "sensor-offset", 30)
    (effect,) = added(diagnosis)
    assert list(effect.coefficients) == ["offset of u3"]
    assert effect.parameters == {"site": 3}


def test_readings_on_a_grid_are_noted_with_what_rounding_does_to_the_noise(pendulum: Diagnosis) -> None:
    (note,) = [line for line in notes(pendulum) if "multiples" in line]
    share = float(re.search(r"makes ([\d.]+) %", note)[1])  # type: ignore[index]
    noise = float(pendulum.noise[0])
    assert "0.01" in note
    assert share == pytest.approx(100 * 0.01**2 / 12 / noise**2, rel=0.05)


@pytest.mark.parametrize(("order", "is_complex"), [(2, False), (1, True), (1, False)])
def test_every_pair_of_effects_has_a_measurement_that_would_separate_it(order: int, is_complex: bool) -> None:
    for one, other in itertools.combinations(CATALOGUE, 2):
        said = separation(one, other, order, is_complex)
        assert said
        assert said[0].islower()
        assert not said.endswith(".")


@pytest.mark.parametrize(
    ("one", "other", "words"),
    [
        ("damping", "quadratic-drag", "swings of another size"),
        ("damping", "clock", "second clock"),
        ("defect", "sensor-gain", "other sensors"),
        ("drive", "onsite-cubic", "begun at another time"),
        ("onsite-linear", "next-neighbour", "waves of other lengths"),
        ("damping", "onsite-linear", "another frequency"),
        ("onsite-linear", "trap", "middle of the chain"),
        ("defect", "onsite-linear", "elsewhere in the chain"),
    ],
)
def test_what_would_separate_two_effects_follows_from_how_they_act(one: str, other: str, words: str) -> None:
    for pair in ((one, other), (other, one)):
        assert words in separation(find(pair[0]), find(pair[1]), 2, False)


def test_a_residual_that_is_noise_lives_nowhere_and_one_at_a_site_lives_there(damped: Diagnosis) -> None:
    after = whereabouts(damped.course.after, damped)
    assert len(after.sites) + len(after.times) + len(after.frequencies) <= 1
    defect = diagnosed("phi4", "defect", 40)
    before = whereabouts(defect.course.before, defect)
    assert before.sites[0].site == added(defect)[0].parameters["site"]
    assert f"site {before.sites[0].site}" in before.words[0]


def test_the_terminal_shows_equation_ranking_errors_and_what_would_separate(
    damped: Diagnosis, capsys: pytest.CaptureFixture[str]
) -> None:
    alike = replace(damped, course=replace(damped.course, equal=(("quadratic-drag",),)))
    show(content(alike))
    out = capsys.readouterr().out
    for words in ("u'' = ", "*v[n]", "Round 1: added", "residual over the noise", "cannot be told from", "truth"):
        assert words in out


# The page -------------------------------------------------------------------------------------------------------------

EVIL = '<img src=x onerror="document.title=\'owned\'"><script>document.title="owned"</script>$\\frac{&.csv'


def renamed(diagnosis: Diagnosis, source: str) -> Diagnosis:
    """The same diagnosis of a file of another name."""
    course = diagnosis.course
    before, after = (
        replace(side, data=tuple(replace(one, source=source) for one in side.data))
        for side in (course.before, course.after)
    )
    return replace(diagnosis, course=replace(course, before=before, after=after))


def browsed(path: Path, *, extra: tuple[str, ...] = ()) -> str:
    """Open a page in a browser without a window and give its document back."""
    if BROWSER is None:
        pytest.skip("there is no Chromium; install Debian's package chromium")
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={path.parent / 'profile'}",
        "--virtual-time-budget=3000", *extra, "--dump-dom", path.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    if done.returncode != 0 and not done.stdout:
        pytest.skip(f"Chromium does not run here: {done.stderr[-200:]}")
    return done.stdout


MEASURE = """<script>addEventListener('load', () => {
  const box = (one) => { const b = one.getBoundingClientRect(); return [b.width, b.height]; };
  const every = (selector) => [...document.querySelectorAll(selector)];
  const handled = (one) => [...one.attributes].some((a) => a.name.startsWith('on'));
  const found = {
    figures: every('figure svg').map(box), math: every('math').map(box), images: every('svg image, img').map(box),
    text: document.body.innerText, title: document.title, scripts: document.scripts.length,
    wide: document.documentElement.scrollWidth, window: innerWidth, handlers: every('*').filter(handled).length,
  };
  const out = document.createElement('pre');
  out.id = 'measured';
  out.textContent = JSON.stringify(found);
  document.body.append(out);
});</script>"""


def measured(text: str, path: Path, **options: tuple[str, ...]) -> dict[str, object]:
    """Measure a page with a script of the test's own; the page's policy against scripts is taken off for it."""
    bare = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)
    assert bare != text
    path.write_text(bare.replace("</body>", MEASURE + "</body>"))
    document = browsed(path, **options)
    inner = re.search(r'<pre id="measured">(.*?)</pre>', document, re.DOTALL)
    assert inner is not None
    import html

    found: dict[str, object] = json.loads(html.unescape(inner[1]))
    return found


@pytest.mark.parametrize("which", ["damped", "driven", "pendulum", "rough"])
def test_the_page_shows_all_figures_and_equations_in_a_browser(
    which: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    diagnosis: Diagnosis = request.getfixturevalue(which)
    found = measured(page_of(diagnosis), tmp_path / "page.html", extra=("--window-size=1000,900",))
    cured = bool(diagnosis.course.after.model.effects)
    assert len(found["figures"]) == (5 if cured else 4)  # type: ignore[arg-type]
    for width, height in found["figures"]:  # type: ignore[attr-defined]
        assert width > 200
        assert height > 100
    for width, height in [*found["math"], *found["images"]]:  # type: ignore[misc]
        assert width > 5
        assert height > 5
    for words in (content(diagnosis).sentence, "Ranked causes", "Round 1", "residual over the noise"):
        assert words in found["text"]  # type: ignore[operator]
    assert found["scripts"] == 1


def test_the_page_fits_a_phone(damped: Diagnosis, tmp_path: Path) -> None:
    # A window of Chromium's is at least 500 wide; a frame is as narrow as it is told to be.
    inner = tmp_path / "inner.html"
    write_page(content(damped), curves(damped), None, inner)
    outer = tmp_path / "outer.html"
    outer.write_text(
        f"<iframe id=f src='{inner.as_uri()}' style='width:360px;height:800px;border:0'></iframe>"
        "<script>onload = () => { document.title = f.contentDocument?.documentElement.scrollWidth ?? 'none' }</script>"
    )
    document = browsed(outer, extra=("--allow-file-access-from-files", "--disable-web-security"))
    title = re.search(r"<title>(.*?)</title>", document)
    assert title is not None
    assert int(title[1]) <= 360


def test_no_script_from_a_name_survives_on_the_page(damped: Diagnosis, about: Provenance, tmp_path: Path) -> None:
    about = about.model_copy(update={"command": f"latticebench diagnose {EVIL}"})
    text = page_of(renamed(damped, EVIL), about)
    assert "<script" not in text
    assert "<img" not in text
    found = measured(text, tmp_path / "page.html")
    assert found["title"] == "Diagnosis: explained"
    assert found["handlers"] == 0
    assert found["scripts"] == 1
    assert EVIL in found["text"]  # type: ignore[operator]


def test_the_page_lets_nothing_run_or_load(damped: Diagnosis, tmp_path: Path) -> None:
    text = page_of(damped)
    # Even a script that got in would not run.
    (tmp_path / "page.html").write_text(text.replace("</body>", "<script>document.title='owned'</script></body>"))
    assert "<title>owned</title>" not in browsed(tmp_path / "page.html")
    assert "default-src 'none'" in text
    for attribute, value in re.findall(r'\b(src|href|xlink:href)="([^"]*)"', text):
        assert value.startswith(("#", "data:")), attribute
    assert "url(http" not in text


def test_pieces_of_a_trajectory_are_put_together_and_trajectories_are_not(
    rough: Diagnosis, pendulum: Diagnosis
) -> None:
    found = scaled_residuals(rough.course.before, rough)
    assert [len(t) for t, _ in found] == [40, 33]
    for side in (pendulum.course.before, pendulum.course.after):
        ((t, left),) = scaled_residuals(side, pendulum)
        assert len(t) == len(left) == sum(len(samples.t) for samples in side.data)
        assert np.all(np.diff(t) > 0)
    assert "in 2 trajectories" in page_of(rough)
    assert "trajectories" not in page_of(pendulum)


def test_the_page_says_what_cannot_be_told_apart_and_what_would_separate_it(damped: Diagnosis) -> None:
    alike = replace(damped, course=replace(damped.course, equal=(("quadratic-drag", "dry-friction"),)))
    text = page_of(alike)
    assert text.count("cannot be told from") == 2
    assert "damping (or quadratic-drag, dry-friction)" in text
    assert "cannot be told" not in page_of(replace(damped, course=replace(damped.course, equal=((),))))


def test_an_effect_that_was_taken_away_again_is_noted(damped: Diagnosis) -> None:
    first, *rest = damped.course.rounds
    course = replace(damped.course, rounds=(replace(first, added="kick"), first, *rest))
    assert any("taken away again" in note and "kick" in note for note in notes(replace(damped, course=course)))
    assert not any("taken away again" in note for note in notes(damped))


def test_a_forecast_that_runs_away_is_said_to_and_hides_no_readings(damped: Diagnosis) -> None:
    before = [replace(one, predicted=np.full_like(one.predicted, np.inf), error=np.inf) for one in damped.forecasts[0]]
    away = replace(damped, forecasts=(before, damped.forecasts[1]))
    assert rows.errors(content(away))[2][:2] == ["forecast error on held-out data", "diverges"]
    assert to_dict(content(away))["error"]["forecast"]["before"] == "inf"
    assert "<svg" in page_of(away)


def test_a_long_record_makes_no_larger_figures() -> None:
    sizes = []
    for count in (2_000, 100_000):
        t = np.linspace(0, 100, count)
        left = np.random.default_rng(1).normal(size=(count, 1, 1))
        wide = np.random.default_rng(1).normal(size=(count, 1, 6))
        omega, power, _ = spectrum(t, left[:, None])
        pieces = [pictures.traces(t, left, 3.0, pictures.BEFORE), pictures.site_map(t, wide, 3.0)]
        pieces.append(pictures.spectrum([(pictures.BEFORE, omega, power)], []))
        sizes.append([len(piece) for piece in pieces])
    for short, long in zip(*sizes, strict=True):
        assert long < 1.5 * short + 2000


def test_a_peak_of_a_long_record_is_not_thinned_away() -> None:
    t = np.linspace(0, 1, 50_000)
    values = np.zeros(50_000)
    values[31_234] = 7.0
    x, y = pictures.thinned(t, values)
    assert len(x) < 3_000
    assert np.max(y) == 7.0
    assert np.all(np.diff(x) > 0)


def test_pages_of_one_diagnosis_are_the_same(damped: Diagnosis, about: Provenance) -> None:
    assert page_of(damped, about) == page_of(damped, about)


def test_a_page_is_written_whole_or_not_at_all(damped: Diagnosis, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_page(content(damped), curves(damped), None, tmp_path / "file" / "page.html")
    write_page(content(damped), curves(damped), None, tmp_path / "new" / "page.html")
    assert (tmp_path / "new" / "page.html").read_text().endswith("</html>\n")


def test_a_reading_far_beyond_all_others_is_pointed_at():
    t = np.linspace(0, 4, 30)
    u = np.stack([np.cos(t), np.sin(3 * t)], axis=1)
    assert strays(Samples(t, u, source="swing.csv")) == []
    u[7, 1] = 1e6
    v = np.zeros_like(u)
    (text,) = strays(Samples(t, u, v, source="swing.csv"))
    assert text.startswith(f"swing.csv: u2 at t = {t[7]:g} is 1e+06")
    assert "empty" in text
