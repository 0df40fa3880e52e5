"""The pages and the scripts in results/."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from latticebench import systems
from latticebench.bench.against import against
from latticebench.bench.paired import UNDECIDED
from latticebench.bench.publish import format_number
from latticebench.bench.tables import read_cases
from latticebench.methods.engine.integrated_equation import PRICE, SPAN

RESULTS = Path(__file__).parents[2] / "results"
SCRIPTS = sorted(path.relative_to(RESULTS).as_posix() for path in RESULTS.rglob("*.py"))


@pytest.mark.parametrize("path", SCRIPTS)
def test_a_script_can_be_imported(script: Callable[[str], ModuleType], path: str) -> None:
    assert script(path).__doc__


@pytest.mark.parametrize("path", ["ablation/ablation.py", "cross/cross.py", "limits/which.py", "paper/claims.py"])
def test_a_page_is_what_its_script_makes_of_the_tables_beside_it(
    script: Callable[[str], ModuleType], path: str
) -> None:
    published = (RESULTS / path).with_suffix(".md").read_text(encoding="utf-8")
    assert script(path).page() == published


def test_the_headline_is_what_the_paired_tests_say(script: Callable[[str], ModuleType]) -> None:
    text = " ".join((RESULTS.parent / "docs" / "protocol.md").read_text(encoding="utf-8").split())
    default, paper = (
        against(read_cases(RESULTS / name), "stlsq").methods.set_index("method") for name in ("default", "paper")
    )
    best, own, wide = default.loc["pinn-gn"], default.loc["pinn"], paper.loc["pinn-gn"]
    parts = script("ablation/ablation.py")
    table = parts.compared(parts.load()).set_index(["start", "noise", "method"])
    clean, noisy = ([(start, noise) for start in parts.STARTS.values()] for noise in (0.0, 0.01))
    assert [best["verdict"], own["verdict"], wide["verdict"]] == ["pinn-gn better", UNDECIDED, "pinn-gn better"]
    assert all(table.loc[(*place, "trajectory"), "beside it"] == UNDECIDED for place in noisy)
    follows = table.loc[(*clean[0], "trajectory")]
    assert follows["beside it"] == "better"
    for told in (
        f"{best['wins']} of the {best['cases']} lattices and libraries",
        f"(median ratio {format_number(best['ratio'])}, p = {format_number(best['p'])})",
        f"{wide['wins']} of {wide['cases']} kinds of data",
        f"(ratio {format_number(wide['ratio'])}, p = {format_number(wide['p'])})",
        f"({own['wins']} won, {own['losses']} lost, p = {format_number(own['p'])})",
        f"(ratio {format_number(follows['ratio'])}, p = {format_number(follows['p'])})",
    ):
        assert told in text


def test_the_constants_in_use_are_those_that_their_table_chooses_on_lattices_outside_the_benchmark(
    script: Callable[[str], ModuleType],
) -> None:
    chooses = script("tuned/constants.py")
    table = pd.read_csv(RESULTS / "tuned" / "constants.csv", comment="#")
    best = table.loc[table["ratio"].idxmin()]
    assert (best["span"], best["price"]) == (SPAN, PRICE)
    # Not at the rim of what was tried.
    assert min(chooses.SPANS) < SPAN < max(chooses.SPANS)
    assert min(chooses.PRICES) < PRICE < max(chooses.PRICES)
    ours = {systems.find(name).equation for name in systems.names()}
    own = list(chooses.lattices())
    assert not ours & {one.equation for one in own}
    assert all(one.truth(one.libraries[0], one.parameters) is not None for one in own)


def test_the_choice_is_the_least_geometric_mean_of_capped_ratios(script: Callable[[str], ModuleType]) -> None:
    chooses = script("tuned/constants.py")
    table = pd.DataFrame(
        [(1.0, 2.0, 1.0, True), (1.0, 2.0, 1e6, False), (2.0, 2.0, 4.0, True), (2.0, 2.0, 2.0, True)],
        columns=["span", "price", "ratio", "right"],
    )
    # sqrt(1 * 10) is more than sqrt(4 * 2).
    assert list(chooses.means(table)["ratio"]) == pytest.approx([10**0.5, 8**0.5])
    assert chooses.chosen(table) == (2.0, 2.0)
