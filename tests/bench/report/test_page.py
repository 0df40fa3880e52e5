"""What a diagnosis looks like in a browser."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from latticebench.bench.report import pictures, rows
from latticebench.bench.report.content import content
from latticebench.bench.report.curves import curves
from latticebench.bench.report.document import Provenance, to_dict
from latticebench.bench.report.page import page, write_page
from latticebench.bench.report.whereabouts import spectrum
from latticebench.diagnosis.repair import SMALL
from latticebench.diagnosis.rules import MOST_EFFECTS
from latticebench.systems.errors import InputError

Made = Callable[..., Any]
EVIL = '<img src=x onerror="document.title=\'owned\'"><script>document.title="owned"</script>$\\frac{&.csv'


def page_of(diagnosis: Any, about: Provenance | None = None) -> str:
    return page(content(diagnosis), curves(diagnosis), about)


def test_a_page_without_effects_shows_what_there_is(
    pendula: Made, check_figures: Callable[[Any, Path], None], tmp_path: Path
) -> None:
    plain = pendula()
    check_figures(pendula(findings=(), after=plain.before, verdict="nothing missing"), tmp_path / "page.html")


def test_the_page_fits_a_phone(pendula: Made, browsed: Callable[..., str], tmp_path: Path) -> None:
    # A window of Chromium's is at least 500 wide; a frame is as narrow as it is told to be.
    inner = tmp_path / "inner.html"
    write_page(content(pendula()), curves(pendula()), None, inner)
    outer = tmp_path / "outer.html"
    outer.write_text(
        f"<iframe id=f src='{inner.as_uri()}' style='width:360px;height:800px;border:0'></iframe>"
        "<script>onload = () => { document.title = f.contentDocument?.documentElement.scrollWidth ?? 'none' }</script>"
    )
    document = browsed(outer, extra=("--allow-file-access-from-files", "--disable-web-security"))
    title = re.search(r"<title>(.*?)</title>", document)
    assert title is not None
    assert int(title[1]) <= 360


def test_no_script_from_a_name_survives_on_the_page(
    pendula: Made, about: Provenance, measured: Callable[..., dict[str, Any]], tmp_path: Path
) -> None:
    about = about.model_copy(update={"command": f"latticebench diagnose {EVIL}"})
    data = tuple(replace(one, source=EVIL) for one in pendula().data)
    text = page_of(pendula(data=data, noise_lines=(EVIL,)), about)
    assert "<script" not in text
    assert "<img" not in text
    found = measured(text, tmp_path / "page.html")
    assert found["title"] == "Diagnosis: explained"
    assert found["handlers"] == 0
    assert found["scripts"] == 1
    assert EVIL in found["text"]


def test_the_page_lets_nothing_run_or_load(pendula: Made, browsed: Callable[..., str], tmp_path: Path) -> None:
    text = page_of(pendula())
    # Even a script that got in would not run.
    (tmp_path / "page.html").write_text(text.replace("</body>", "<script>document.title='owned'</script></body>"))
    assert "<title>owned</title>" not in browsed(tmp_path / "page.html")
    assert "default-src 'none'" in text
    for attribute, value in re.findall(r'\b(src|href|xlink:href)="([^"]*)"', text):
        assert value.startswith(("#", "data:")), attribute
    assert "url(http" not in text


def test_the_page_says_once_what_cannot_be_told_apart_and_what_would_separate_it(pendula: Made) -> None:
    text = page_of(pendula())
    assert text.count("cannot be told from") == 1
    assert "sensor-gain (or unequal-masses, asymmetric-coupling)" in text
    alone = tuple(SimpleNamespace(**{**vars(one), "alternatives": ()}) for one in pendula().findings)
    assert "cannot be told" not in page_of(pendula(findings=alone))


def test_candidates_have_bars_and_the_mark_of_their_price(pendula: Made) -> None:
    text = page_of(pendula())
    assert text.count('class="bar"') == text.count('class="price"') == 2
    assert text.count('class="alike"') == 1
    assert "price 7.0" in text
    assert "What else was tried" not in page_of(pendula(horizons=pendula().horizons[:1]))


def test_why_effects_explain_a_part_only_stands_beside_the_verdict(pendula: Made) -> None:
    left = (SimpleNamespace(name="u[n]**4", gain=31.0, price=9.5, site=None, instead=()),)
    assert f">{SMALL}</span>" in page_of(pendula(left=left, verdict="partly explained"))
    assert SMALL not in page_of(pendula())


def test_why_a_candidate_above_its_price_was_not_taken_is_said(pendula: Made) -> None:
    (fitted,) = rows.not_chosen(content(pendula()))
    assert "fitted in full" in fitted
    assert fitted in html.unescape(page_of(pendula()))
    first, last = pendula().horizons
    many = pendula().findings[:1] * MOST_EFFECTS
    assert rows.not_chosen(content(pendula(findings=many))) == [
        "The model has 8 effects, the most that it may have: no more were fitted."
    ]
    below = tuple(replace(one, gain=one.price - 1) for one in last.tried)
    assert rows.not_chosen(content(pendula(horizons=(first, replace(last, tried=below))))) == []
    (share,) = rows.not_chosen(content(pendula(horizons=(first, replace(last, tried=below, misfit=True)))))
    assert "10 % of what is left" in share
    assert "50 %" in share
    assert rows.not_chosen(content(pendula(horizons=(first, replace(last, tried=(), misfit=True))))) == []


def test_a_forecast_that_runs_away_is_said_to_and_hides_no_readings(pendula: Made) -> None:
    far = [
        SimpleNamespace(**{**vars(one), "predicted": np.full_like(one.predicted, np.inf), "error": np.inf})
        for one in pendula().forecasts[0]
    ]
    away = pendula(forecasts=(far, pendula().forecasts[1]), forecast=(np.inf, 0.01))
    assert ["forecast error on held-out data", "diverges", "1 %"] in rows.errors(content(away))[1]
    assert to_dict(content(away))["error"]["forecast"]["before"] == "inf"
    assert ["forecast error by noise alone", "0.8 %", "0.8 %"] in rows.errors(content(away))[1]
    assert "<svg" in page_of(away)


def test_models_over_pieces_of_unlike_lengths_are_not_compared_by_a_criterion(pendula: Made) -> None:
    (told,) = [row[1:] for row in rows.errors(content(pendula()))[1] if row[0].startswith("information")]
    assert told == ["0.0", "-9000.0"]
    (told,) = [row[1:] for row in rows.errors(content(pendula(criterion=(0.0, np.nan))))[1] if "criterion" in row[0]]
    assert told == ["-", "-"]


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


def test_pages_of_one_diagnosis_are_the_same(pendula: Made, about: Provenance) -> None:
    assert page_of(pendula(), about) == page_of(pendula(), about)


def test_a_page_is_written_whole_or_not_at_all(pendula: Made, tmp_path: Path) -> None:
    report, drawn = content(pendula()), curves(pendula())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_page(report, drawn, None, tmp_path / "file" / "page.html")
    write_page(report, drawn, None, tmp_path / "new" / "page.html")
    assert (tmp_path / "new" / "page.html").read_text().endswith("</html>\n")
