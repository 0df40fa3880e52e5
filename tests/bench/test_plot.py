"""Pictures of recordings, fits and diagnoses."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from commandline import latticebench
from latticebench import methods, systems
from latticebench.bench import animation
from latticebench.bench.adequacy import adequacy
from latticebench.bench.overlay import Overlay, of_fit, of_recording
from latticebench.bench.plots import panels, plot
from latticebench.bench.report.fit_page import fit_page
from latticebench.bench.report.shown import Shown
from latticebench.methods.method import History, make, solve
from latticebench.systems.errors import InputError
from latticebench.systems.lattice import library
from latticebench.systems.samples import Origin, Samples
from latticebench.systems.simulate import observe, simulate
from latticebench.systems.writers import write

Run = Callable[..., tuple[int, str]]
FIRST = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}
TERMS = "u[n+1]+u[n-1]-2*u[n]; u[n]; u[n]**3"


@pytest.fixture(scope="module")
def swings() -> Samples:
    """A wave along six sites, with 1 % noise."""
    phi4 = systems.find("phi4")
    clean = simulate(phi4, sites=6, times=np.arange(60) * 0.2, initial="wave")
    return replace(observe(clean, np.random.default_rng(3), noise=0.01).observed(), ends=phi4.ends)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Run a command in the folder, and return its exit code and what it complains of."""

    def command(*words: str) -> tuple[int, str]:
        code, _, err = latticebench(*words, cwd=tmp_path)
        return code, err

    return command


def fitted(swings: Samples, terms: str, method: str) -> Overlay:
    own = library("terms", terms)
    return of_fit([swings], solve(make(methods.find(method), {}), [swings], own, 2, 1))


def test_a_method_without_a_motion_is_shown_with_the_nearest_motion_of_its_equation(swings: Samples) -> None:
    """The right equation leaves the noise, whoever found it, although the start is fitted to noisy readings."""
    sigma = np.std(swings.u) * 0.01
    for method in ("least-squares", "trajectory"):
        shown = fitted(swings, TERMS, method)
        left = shown.seen - shown.curves[method]
        assert 0.5 * sigma < np.sqrt(np.mean(left**2)) < 4 * sigma


def test_what_a_wrong_equation_leaves_is_not_taken_for_noise(swings: Samples) -> None:
    shown = fitted(swings, "u[n]", "trajectory")
    assert np.sqrt(np.nanmean(shown.residual("trajectory") ** 2)) > 5


def test_an_equation_that_runs_away_is_drawn_as_far_as_it_goes(swings: Samples) -> None:
    alone = of_recording(swings)
    away = np.where(alone.t[:, None, None] < 3, np.exp(10 * alone.t)[:, None, None] * alone.seen, np.nan)
    figure = plot(replace(alone, curves={"wild": away}), ["sites"])
    low, high = figure.get_axes()[0].get_ylim()
    assert high - low < 4 * np.ptp(swings.u)
    # Of an equation that blows up before the second reading nothing is known there.
    blown = fitted(swings, "exp(u[n]*50)", "least-squares").curves["least-squares"]
    assert np.all(np.isfinite(blown[0]))


def test_a_document_is_drawn_as_what_was_written(swings: Samples) -> None:
    shown = fitted(swings, TERMS, "least-squares")
    again = Shown.model_validate_json(Shown.of(shown).model_dump_json()).overlay()
    np.testing.assert_allclose(again.seen, shown.seen, rtol=1e-5)
    np.testing.assert_allclose(again.curves["least-squares"], shown.curves["least-squares"], rtol=1e-5)


def test_how_coefficients_were_learnt_is_drawn_of_methods_that_iterate(swings: Samples) -> None:
    assert "learning" not in panels(fitted(swings, TERMS, "least-squares"))
    shown = fitted(swings, TERMS, "pinn-gn")
    again = Shown.model_validate_json(Shown.of(shown).model_dump_json()).overlay()
    assert shown.learning is not None
    assert again.learning is not None
    assert again.learning.terms == shown.learning.terms
    np.testing.assert_allclose(again.learning.history.coefficients, shown.learning.history.coefficients, rtol=1e-5)
    objective, coefficients = plot(again, ["learning"]).get_axes()
    lines = {str(line.get_label()): np.asarray(line.get_ydata()) for line in coefficients.get_lines()}
    assert sorted(lines) == sorted(shown.learning.terms)
    for term, last in zip(shown.learning.terms, shown.learning.history.coefficients[-1], strict=True):
        assert lines[term][-1] == pytest.approx(last, rel=1e-5)
    assert len(np.asarray(objective.get_lines()[0].get_ydata())) == len(shown.learning.history.step)


def test_a_history_is_thinned_evenly_and_keeps_its_ends() -> None:
    way = History(np.arange(100.0), np.arange(100.0), np.ones(100), np.arange(200.0).reshape(100, 2))
    few = way.thinned(10)
    assert few.step.tolist() == [0, 11, 22, 33, 44, 55, 66, 77, 88, 99]
    np.testing.assert_array_equal(few.coefficients, way.coefficients[few.step.astype(int)])
    assert len(way.thinned(1000).step) == 100


@pytest.mark.parametrize(("sites", "kind"), [(1, float), (3, complex), (8, float)])
def test_every_panel_is_drawn_of_any_chain_with_gaps_and_uneven_times(sites: int, kind: type) -> None:
    draws = np.random.default_rng(1)
    u = draws.normal(size=(30, sites)).astype(kind)
    u[4:9, 0] = np.nan
    alone = of_recording(Samples(np.cumsum(draws.uniform(0.1, 1, 30)), u))
    for overlay in (alone, Overlay("x", 30, alone.t, alone.seen, curves={"a": 0.9 * alone.seen, "b": alone.seen})):
        figure = plot(overlay, list(panels(overlay)))
        figure.draw_without_rendering()
        assert sum(part.get_visible() for part in figure.get_axes()) >= len(panels(overlay))


@pytest.mark.parametrize("panel", ["sites", "phase"])
def test_where_not_all_sites_are_drawn_the_picture_says_how_many(panel: str) -> None:
    t = np.arange(30) * 0.2
    for sites in (8, 9):
        shown = words_of(plot(of_recording(Samples(t, np.cos(t)[:, None] * np.arange(1.0, sites + 1))), [panel]))
        assert any("(8 of 9 sites)" in text for text in shown) == (sites == 9)


@pytest.mark.parametrize("size", [0.0, 1e-200, 1e49])
def test_readings_of_any_size_are_drawn_without_a_warning(size: float, run: Run, tmp_path: Path) -> None:
    t = np.arange(30) * 0.2
    write([Samples(t, size * np.cos(t)[:, None] * np.ones(3))], tmp_path / "t.csv")
    for words in (["inspect", "t.csv", "--out", "i.png"], ["plot", "t.csv", "--out", "p.png"]):
        assert run(*words) == (0, "")


def degrees(swings: Samples) -> Samples:
    """The same wave, as it is read of a file in degrees and milliseconds."""
    origin = Origin(time="ms", unit="deg", scale=np.pi / 180, becomes="rad")
    return replace(swings, origin=origin)


def words_of(figure: Figure) -> set[str]:
    """What stands at the axes of a figure."""
    figure.draw_without_rendering()
    return {text.get_text() for text in figure.findobj(Text) if text.get_visible()}


def test_axes_carry_the_units_of_the_file_and_readings_are_drawn_in_them(swings: Samples) -> None:
    fit = solve(make(methods.find("weak"), {}), [swings], library("terms", TERMS), 2, 1)
    alone, beside = of_recording(degrees(swings)), of_fit([degrees(swings)], fit)
    for overlay in (alone, beside):
        np.testing.assert_allclose(overlay.seen[:, 0], np.degrees(swings.u))
        again = Shown.model_validate_json(Shown.of(overlay).model_dump_json()).overlay()
        said = words_of(plot(again, list(panels(again))))
        assert {"t / ms", "u / deg", "angular frequency / (rad/ms)", "slope of u / (deg/ms)"} <= said
        assert not said & {"t", "u", "angular frequency"}
    # The noise is that of the readings, and what is left is in its units as before.
    plain = of_fit([swings], fit)
    np.testing.assert_allclose(beside.residual("weak"), plain.residual("weak"), rtol=1e-9)
    assert {"t", "u", "angular frequency"} <= words_of(plot(of_recording(swings)))


def test_a_scale_without_a_unit_leaves_the_picture_in_that_of_the_equation(swings: Samples) -> None:
    origin = Origin(scale=1e-3)
    np.testing.assert_array_equal(of_recording(replace(swings, origin=origin)).seen[:, 0], swings.u)


def test_the_page_of_a_fit_says_first_whether_the_equation_fits(swings: Samples) -> None:
    data = [degrees(swings)]
    for terms, fits in ((TERMS, True), ("u[n]", False)):
        found = solve(make(methods.find("weak"), {}), data, library("terms", terms), 2, 1)
        quality = adequacy(data, found)
        text = fit_page(found, of_fit(data, found), quality)
        assert ("the equation does not fit" in text) is not fits
        assert quality.in_words.split(";")[0] in text
        assert "t in ms, readings in deg" in text
        assert ">t / ms<" in text
        assert "R<sup>2</sup> = 0." in text or "R<sup>2</sup> = 1" in text or "R<sup>2</sup> &lt; -1" in text
        assert ("<code>latticebench diagnose</code>" in text) is not fits
        assert "`" not in text.split("<h2>")[0].split("</style>")[1]


def test_pictures_are_what_their_ending_says_and_films_move(run: Run, swings: Samples, tmp_path: Path) -> None:
    write([replace(swings, t=swings.t[:9], u=swings.u[:9], v=None)], tmp_path / "swings.csv")
    for ending, begin in FIRST.items():
        film = ("--animate", "a.gif") if ending == ".svg" else ()
        assert run("plot", "swings.csv", "--only", "map", "--out", f"a{ending}", *film) == (0, "")
        assert (tmp_path / f"a{ending}").read_bytes().startswith(begin)
    with Image.open(tmp_path / "a.png") as picture:
        assert "latticebench plot swings.csv" in picture.info["Description"]
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 9  # type: ignore[attr-defined]
        assert b"commit" in film.info["comment"]


def test_a_fit_is_drawn_from_its_document_alone(run: Run, swings: Samples, tmp_path: Path) -> None:
    write([swings], tmp_path / "swings.csv")
    terms = ("--terms", TERMS, "--order", "2", "--method", "least-squares")
    assert run("fit", "swings.csv", *terms, "--json", "fit.json") == (0, "")
    (tmp_path / "swings.csv").unlink()
    assert run("plot", "fit.json", "--out", "fit.png", "--only", "sites") == (0, "")
    old = json.loads((tmp_path / "fit.json").read_text())
    way = {"terms": ["u[n]"], "step": [0], "seconds": [0], "loss": [0], "coefficients": [[0]]}
    for changed, reason in (
        ({**old, "shown": None}, "write it again"), ({**old, "schema": "latticebench/run/1"}, "no document of"),
        ({**old, "shown": {**old["shown"], "t": [0.0]}}, "do not match"), ([], "no document of"),
        ({**old, "shown": {**old["shown"], "learning": {**way, "step": [0, 1]}}}, "steps, losses and coefficients"),
    ):  # fmt: skip
        (tmp_path / "other.json").write_text(json.dumps(changed))
        code, said = run("plot", "other.json", "--out", "other.png")
        assert (code, len(said.splitlines())) == (2, 1)
        assert reason in said


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--out", "a.jpg"), "unknown ending '.jpg'"), (("--out", "a"), "known: .pdf, .png, .svg"),
        (("--animate", "a.png"), "known: .gif, .mp4"), ((), "give --out FILE"),
        (("--out", "a.png", "--only", "residual"), "unknown panel"), (("--out", "a.png", "--trajectory", "2"), "has 1"),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_refused_in_one_line(
    words: tuple[str, ...], reason: str, run: Run, swings: Samples, tmp_path: Path
) -> None:
    write([swings], tmp_path / "swings.csv")
    code, said = run("plot", "swings.csv", *words)
    assert (code, len(said.splitlines())) == (2, 1)
    assert reason in said
    assert [path.name for path in tmp_path.iterdir()] == ["swings.csv"]


def test_a_figure_of_a_run_is_the_picture_that_its_place_says(run: Run, tmp_path: Path) -> None:
    suite = '[methods.zero]\nmethod = "zero"\n[[grid]]\nsystem = "phi4"\nsites = 5\nsamples = 8\nlibraries = ["lib1"]\n'
    (tmp_path / "s.toml").write_text(suite)
    assert run("run", "s.toml", "--jobs", "1", "--results", "store")[0] == 0
    assert run("figures", "store", "--only", "errors", "--out", "errors.png") == (0, "")
    assert (tmp_path / "errors.png").read_bytes().startswith(FIRST[".png"])
    for out, reason in (("all.png", "there are 2 figures"), ("errors.gif", "'.gif'")):
        code, said = run("figures", "store", "--out", out)
        assert (code, reason in said) == (2, True)
        assert not (tmp_path / out).exists()


def test_mp4_without_ffmpeg_is_refused_with_what_to_install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from matplotlib.animation import FFMpegWriter

    monkeypatch.setattr(FFMpegWriter, "isAvailable", lambda: False)
    with pytest.raises(InputError, match="install it"):
        animation.check_film(tmp_path / "a.mp4")
    animation.check_film(tmp_path / "a.gif")


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="there is no ffmpeg")
def test_an_mp4_has_a_picture_for_each_row(run: Run, swings: Samples, tmp_path: Path) -> None:
    write([swings], tmp_path / "swings.csv")
    assert run("plot", "swings.csv", "--animate", "a.mp4")[0] == 0
    command = ["ffmpeg", "-v", "error", "-i", str(tmp_path / "a.mp4"), "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    pictures = subprocess.run(command, capture_output=True, check=True).stdout
    width, height = (round(side * animation.DENSITY) for side in animation.SIZE)
    assert len(pictures) == len(swings.t) * width * height


def test_the_page_of_a_fit_has_data_table_and_pictures_and_lets_nothing_run(swings: Samples) -> None:
    evil = "<script>document.title='owned'</script>$x.csv"
    own = library("terms", TERMS)
    found = solve(make(methods.find("weak"), {}), [swings], own, 2, 1)
    overlay = of_fit([replace(swings, source=evil)], found)
    text = fit_page(found, overlay, adequacy([swings], found))
    assert "<script" not in text
    assert "default-src 'none'" in text
    assert text.count("<svg ") == len(panels(overlay)) == 5
    assert "standard error" in text
    for term in own.texts:
        assert f"<td>{term}</td>" in text
