"""Methods against one of them: by tables of the literature and by hand."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from latticebench.bench.against import against, critical_difference, interval
from latticebench.bench.beside import read_published
from latticebench.bench.figures import save
from latticebench.bench.fitting import FitCase
from latticebench.bench.ranking import alike, draw_ranks
from latticebench.bench.tables import cases
from latticebench.bench.worker import outcome
from latticebench.systems.errors import InputError

RESULTS = Path(__file__).parents[2] / "results"


def result(method: str, library: str, e2: float | None, seed: int = 1, status: str = "ok") -> dict[str, Any]:
    case = FitCase(system="phi4", library=library, label=method, method=method, seed=seed)
    about = {"case": case.model_dump(mode="json"), "identity": case.identity}
    return {**outcome(case, status), **about, "e2": e2, "residual": 0.1}


@pytest.mark.parametrize(
    ("methods", "quantile"), [(2, 1.960), (3, 2.343), (4, 2.569), (5, 2.728), (6, 2.850), (8, 3.031), (10, 3.164)]
)
def test_the_critical_difference_is_that_of_the_table_of_demsar(methods: int, quantile: float) -> None:
    expected = quantile * np.sqrt(methods * (methods + 1) / (6 * 14))
    assert critical_difference(methods, 14) == pytest.approx(expected, rel=5e-4)


def test_wins_losses_and_ties_are_counted_by_case() -> None:
    errors = {"a": 1.0, "b": 1.0, "c": 1.0, "d": 1.0, "e": None}
    other = {"a": 0.5, "b": 2.0, "c": 1.005, "d": None, "e": None}
    rows = [result("ours", name, e2, status="ok" if e2 else "failed") for name, e2 in other.items()]
    rows += [result("theirs", name, e2, status="ok" if e2 else "failed") for name, e2 in errors.items()]
    rows += [result("oracle", name, 1e-15) for name in errors]
    found = against(cases(rows), "theirs")
    told = found.methods.set_index("method").loc["ours"]
    assert told[["cases", "wins", "losses", "ties"]].tolist() == [5, 1, 2, 2]
    assert told["ratio"] == pytest.approx(1.005)
    assert found.cases.set_index("library")["outcome"].to_dict() == {
        "a": "win", "b": "loss", "c": "tie", "d": "loss", "e": "tie"
    }  # fmt: skip
    assert found.cases.set_index("library").loc["d", "ratio"] == np.inf
    assert list(found.methods["method"]) == ["ours"]
    assert found.ranks is None


def test_with_seeds_enough_a_case_is_won_only_if_its_interval_says_so() -> None:
    rng = np.random.default_rng(3)
    rows = []
    for seed in range(12):
        size, luck = float(np.exp(rng.normal())), 3.0 if seed % 2 else 1 / 3
        rows += [result("base", "lib1", size, seed), result("base", "lib2", size, seed)]
        rows += [result("sure", "lib1", 0.9 * size, seed), result("lucky", "lib2", size * luck, seed)]
    found = against(cases(rows), "base").cases.set_index("method")
    assert found.loc["sure", "outcome"] == "win"
    assert found.loc["sure", ["low", "ratio", "high"]].to_numpy(float) == pytest.approx([0.9] * 3)
    assert found.loc["lucky", "outcome"] == "tie"
    assert found.loc["lucky", "low"] < 1 < found.loc["lucky", "high"]


def test_an_interval_of_the_median_holds_it_about_as_often_as_it_says() -> None:
    held = []
    for k in range(100):
        low, high = interval(np.random.default_rng(k).exponential(size=25))
        held.append(low <= np.log(2) <= high)
    # Of a hundred some 95; a bootstrap of 25 values may come to a few less.
    assert np.mean(held) > 0.85
    assert np.isnan(interval(np.ones(2))).all()


def test_ranks_are_means_over_the_cases_that_all_have() -> None:
    errors = {"a": [1, 1, 1, 1], "b": [2, 2, 2, 0.5], "c": [3, 3, 3, 3], "d": [9, None, None, None]}
    rows = [
        result(name, f"lib{k}", e2)
        for name, values in errors.items() for k, e2 in enumerate(values) if e2 is not None
    ]  # fmt: skip
    ranks = against(cases(rows), "a").ranks
    assert ranks is not None
    assert ranks.mean.to_dict() == {"a": 1.25, "b": 1.75, "c": 3.0}
    assert (ranks.cases, ranks.left_out) == (4, ("d",))
    assert ranks.distance == pytest.approx(critical_difference(3, 4))


def test_equal_errors_share_their_rank() -> None:
    rows = [result(name, library, 1.0) for name, library in itertools.product("abc", ("x", "y", "z"))]
    ranks = against(cases(rows), "a").ranks
    assert ranks is not None
    assert list(ranks.mean) == [2.0, 2.0, 2.0]
    assert ranks.p == 1.0


def test_bars_join_the_longest_runs_that_are_not_told_apart() -> None:
    assert alike([1.0, 1.5, 2.4, 4.0], 1.0) == [(0, 1), (1, 2)]
    assert alike([1.0, 1.2, 1.4], 1.0) == [(0, 2)]
    assert alike([1.0, 3.0], 1.0) == []


def test_a_run_is_compared_with_published_methods_by_their_names_and_drawn(tmp_path: Path) -> None:
    there = read_published(RESULTS / "default")
    own = there.cases[there.cases["method"] == "stlsq"].assign(method="mine")
    own["e2"] /= 2
    found = against(there.joined(own), "stlsq")
    told = found.methods.set_index("method").loc["mine"]
    assert told["against"] == "stlsq*"
    assert (told["wins"], told["losses"], told["verdict"]) == (told["cases"], 0, "mine better")
    assert told[["low", "ratio", "high"]].to_numpy(float) == pytest.approx([0.5] * 3)
    assert found.ranks is not None
    for ending in (".png", ".svg", ".pdf"):
        path = save(draw_ranks(found.ranks), tmp_path / f"ranks{ending}", {"command": "x"})
        assert path.stat().st_size > 3000
    assert "mine" in (tmp_path / "ranks.svg").read_text() or b"mine" in (tmp_path / "ranks.pdf").read_bytes()


def test_a_method_that_is_not_there_is_told_with_those_that_are() -> None:
    table = cases([result("a", "lib1", 1.0), result("b", "lib2", 1.0)])
    with pytest.raises(InputError, match="--against: unknown method 'stlsq'; known: a, b"):
        against(table, "stlsq")
    with pytest.raises(InputError, match="no other method has a case that it has"):
        against(table, "a")


def test_a_picture_names_every_method_with_its_rank() -> None:
    rows = [
        result(name, f"lib{k}", float(place + 1)) for place, name in enumerate(["a", "_b", "$c", "d", "e"])
        for k in range(4)
    ]  # fmt: skip
    ranks = against(cases(rows), "a").ranks
    assert ranks is not None
    figure = draw_ranks(ranks)
    words = " ".join(text.get_text() for text in figure.axes[0].texts)
    for text in (
        "a  1.00",
        "_b  2.00",
        r"\$c  3.00",
        "4.00  d",
        "5.00  e",
        f"critical difference {ranks.distance:.2f}",
    ):
        assert text in words
