"""The pages and the scripts in results/."""

from __future__ import annotations

import re
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
from latticebench.bench.trials.laboratory.tables import nothing_missing
from latticebench.bench.trials.laboratory.tables import share as shares
from latticebench.methods.engine.integrated_equation import PRICE, SPAN

RESULTS = Path(__file__).parents[2] / "results"
SCRIPTS = sorted(path.relative_to(RESULTS).as_posix() for path in RESULTS.rglob("*.py"))


@pytest.mark.parametrize("path", SCRIPTS)
def test_a_script_can_be_imported(script: Callable[[str], ModuleType], path: str) -> None:
    assert script(path).__doc__


@pytest.mark.parametrize(
    "path",
    [
        "ablation/ablation.py", "cross/cross.py", "default/kernels.py", "efficiency/efficiency.py", "gpu/gpu.py",
        "limits/which.py", "paper/claims.py",
    ],
)  # fmt: skip
def test_a_page_is_what_its_script_makes_of_the_tables_beside_it(
    script: Callable[[str], ModuleType], path: str
) -> None:
    published = (RESULTS / path).with_suffix(".md").read_text(encoding="utf-8")
    assert script(path).page() == published


def test_the_headline_is_what_the_paired_tests_say(script: Callable[[str], ModuleType]) -> None:
    text = words("protocol")
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
    seconds = table["cpu seconds"].unstack()
    slower = seconds["pinn-gn"] / seconds["trajectory"]
    assert follows["beside it"] == "better"
    for told in (
        f"{best['wins']} of the {best['cases']} lattices and libraries",
        f"(median ratio {format_number(best['ratio'])}, p = {format_number(best['p'])})",
        f"{wide['wins']} of {wide['cases']} kinds of data",
        f"(ratio {format_number(wide['ratio'])}, p = {format_number(wide['p'])})",
        f"({own['wins']} won, {own['losses']} lost, p = {format_number(own['p'])})",
        f"(ratio {format_number(follows['ratio'])}, p = {format_number(follows['p'])})",
        f"`pinn-gn` takes {slower.min():.2g} to {slower.max():.2g} times as long as `trajectory`",
    ):
        assert told in text


def test_what_a_gpu_saves_is_what_its_table_says(script: Callable[[str], ModuleType]) -> None:
    gpu = script("gpu/gpu.py")
    table = (
        gpu.beside(pd.read_csv(RESULTS / "gpu" / "gpu.csv", comment="#")).set_index(["method", "members"]).sort_index()
    )
    faster = table["times as fast"]
    many, alone = (faster.loc["pinn-gn", members].dropna() for members in (64, 1))
    text = words("method")
    assert f"with 64 members takes {many.min():.0f} to {many.max():.0f} times less time" in text
    assert f"without members {alone.min():.2g} to {alone.max():.2g} times less" in text
    assert faster.loc["pinn", 1].max() < 1 < faster.loc["pinn", 8].min()
    own = table.loc["pinn-gn"]
    own = own[own["cpu e2"] != ""]
    assert (abs(own["cpu e2"] - own["cuda e2"]) < 1e-4 * own["cuda e2"]).all()


def words(page: str) -> str:
    """Return the words of a page of docs/, one space between two."""
    return " ".join((RESULTS.parent / "docs" / f"{page}.md").read_text(encoding="utf-8").split())


def test_the_page_on_the_limit_says_what_the_table_of_efficiencies_says(script: Callable[[str], ModuleType]) -> None:
    counts = script("efficiency/efficiency.py")
    found, text = counts.measured(counts.load()), words("limit")
    head = "| recordings |"
    methods = re.findall(r"`(\S+)`", text[text.index(head) :].split(" |:--")[0])
    assert set(methods) == set(found["method"])
    for part, told in counts.PARTS.items():
        own = dict(iter(found[found["part"] == part].groupby("method")["efficiency"]))
        cells = [counts.ends(own[method]) if method in own else "not run" for method in methods]
        assert f"| {told[0].lower()}{told[1:]} | {' | '.join(cells)} |" in text, part


NAMED = "every effect named, alone or in its group, and no other"


def share(text: str, digits: int = 0) -> str:
    """Return a share such as "97.4 (92.6-99.1) of 115" as the page has it."""
    found = re.fullmatch(r"(\S+) \((\S+)-(\S+)\) of (\d+)", text)
    assert found, text
    value, low, high = (f"{float(one):.{digits}f}" for one in found.groups()[:3])
    return f"{value} % ({low}-{high}) of {found[4]}"


def test_the_page_on_the_diagnosis_says_what_the_tables_of_laboratory_recordings_say() -> None:
    exact = []
    for folder in ("laboratory", "laboratory-later", "laboratory-third", "laboratory-fourth"):
        summary = pd.read_csv(RESULTS / "loop" / folder / "summary.csv", comment="#", dtype=str)
        every = summary[summary["by"] == "all"].iloc[0]
        for column in ("right", "residual at most 1.3", "intervals that hold", "forecast worse"):
            assert f"| {share(every[column])} |" in words("diagnosis"), (folder, column)
        exact.append(share(every["right"]))
    classic = pd.read_csv(RESULTS / "loop" / "classic" / "summary.csv", comment="#", dtype=str)
    assert f"among two or three effects | {NAMED} | {share(classic['right'].iloc[0])} |" in words("diagnosis")
    readme = " ".join((RESULTS.parent / "README.md").read_text(encoding="utf-8").split())
    own = pd.read_csv(RESULTS / "loop" / "own-make" / "summary.csv", comment="#", dtype=str)
    assert f"and no other in {share(own['right'].iloc[0])}." in words("diagnosis")
    hum = pd.read_csv(RESULTS / "loop" / "hum" / "summary.csv", comment="#", dtype=str)
    assert f"`results/loop/hum`): {share(hum['right'].iloc[0])}." in words("diagnosis")
    mains = pd.read_csv(RESULTS / "loop" / "mains" / "summary.csv", comment="#", dtype=str)
    assert f"`results/loop/mains`): {share(mains['right'].iloc[0])}." in words("diagnosis")
    shaken = pd.read_csv(RESULTS / "loop" / "shaken" / "summary.csv", comment="#", dtype=str)
    assert f"`results/loop/shaken`): {share(shaken['right'].iloc[0])}." in words("diagnosis")
    still = nothing_missing(pd.read_csv(RESULTS / "loop" / "shaken" / "laboratory.csv", comment="#")).iloc[0]
    assert f"with nothing missing {share(still['false alarms'])} had" in words("diagnosis")
    assert f"and {share(still['unexplained'])} were `unexplained` or partly so" in words("diagnosis")
    lag = pd.read_csv(RESULTS / "loop" / "lag" / "summary.csv", comment="#", dtype=str)
    assert f"`results/loop/lag`): {share(lag['right'].iloc[0])}." in words("diagnosis")
    later = pd.read_csv(RESULTS / "loop" / "lag-later" / "summary.csv", comment="#", dtype=str).iloc[0]
    assert f"effect was named and no other in {share(later['right'])}, and intervals" in words("diagnosis")
    assert f"intervals hold the true size in {share(later['intervals that hold'])}." in words("diagnosis")
    lens = pd.read_csv(RESULTS / "loop" / "lens" / "summary.csv", comment="#", dtype=str)
    assert f"`results/loop/lens`): {share(lens['right'].iloc[0])}." in words("diagnosis")
    jump = pd.read_csv(RESULTS / "loop" / "jump" / "summary.csv", comment="#", dtype=str)
    assert f"`results/loop/jump`): {share(jump['right'].iloc[0])}." in words("diagnosis")
    held = pd.read_csv(RESULTS / "loop" / "held" / "summary.csv", comment="#", dtype=str)
    assert f"`results/loop/held`): {share(held['right'].iloc[0])}." in words("diagnosis")
    still = nothing_missing(pd.read_csv(RESULTS / "loop" / "held-nothing" / "laboratory.csv", comment="#")).iloc[0]
    assert f"`results/loop/held-nothing`) {share(still['false alarms'])} had an effect named" in words("diagnosis")
    change = pd.read_csv(RESULTS / "loop" / "change" / "summary.csv", comment="#", dtype=str)
    assert f"`results/loop/change`): {share(change['right'].iloc[0])}." in words("diagnosis")
    sensors = pd.read_csv(RESULTS / "loop" / "sensors" / "summary.csv", comment="#", dtype=str).iloc[0]
    assert f"`results/loop/sensors`): {share(sensors['right'])}, and" in words("diagnosis")
    assert f"and intervals hold the true size in {share(sensors['intervals that hold'])}. A gain" in words("diagnosis")
    effects = pd.read_csv(RESULTS / "loop" / "sensors" / "effects.csv", comment="#", dtype=str).set_index("effect")
    named = {name: share(effects.loc[f"sensor-{name}", "named"]) for name in ("gain-drift", "clock", "crosstalk")}
    assert f"drifts was named in {named['gain-drift']}, a slow clock in {named['clock']}, crosstalk in" in words(
        "diagnosis"
    )
    assert f"crosstalk in {named['crosstalk']}: of less" in words("diagnosis")
    assert effects.loc["sensor-crosstalk", "z 5-10"].startswith("60.0 ")
    effects = pd.read_csv(RESULTS / "loop" / "change" / "effects.csv", comment="#", dtype=str).set_index("effect")
    assert f"steady were named in {share(effects.loc['coefficient-drift', 'named'])}" in words("diagnosis")
    assert f"those at one time in {share(effects.loc['coefficient-jump', 'named'])}" in words("diagnosis")
    effects = pd.read_csv(RESULTS / "loop" / "jump" / "effects.csv", comment="#", dtype=str).set_index("effect")
    assert effects.loc["sensor-jump", "z 5-10"].startswith("16.7 ")
    *others, last = (f"{one.split(' (')[0]} of {one.split()[-1]}" for one in exact)
    assert f"in {', '.join(others)} and {last} laboratory recordings" in readme


def test_the_page_on_the_diagnosis_says_how_often_what_hangs_or_rubs_and_what_is_off_was_named() -> None:
    hangs, ranges = (
        pd.read_csv(RESULTS / "loop" / name / "summary.csv", comment="#", dtype=str).iloc[0]
        for name in ("hangs", "ranges")
    )
    assert f"`results/loop/hangs`): {share(hangs['right'])}, and intervals" in words("diagnosis")
    assert f"hold the true size in {share(hangs['intervals that hold'])}. Friction" in words("diagnosis")
    held = pd.read_csv(RESULTS / "loop" / "hangs" / "effects.csv", comment="#", dtype=str).set_index("effect")["named"]
    assert f"Friction at one site was named in {share(held['local-friction'])}, a mass" in words("diagnosis")
    assert f"a mass beside one in {share(held['side-mass'])}, a support in" in words("diagnosis")
    assert f"a support in {share(held['swaying-support'])}: forces" in words("diagnosis")
    again = RESULTS / "loop" / "supports"
    supports = pd.read_csv(again / "summary.csv", comment="#", dtype=str).iloc[0]
    named = pd.read_csv(again / "effects.csv", comment="#", dtype=str).set_index("effect")["named"]
    assert f"and no other in {share(supports['right'])}, and the support in" in words("diagnosis")
    assert f"the support in {share(named['swaying-support'])}." in words("diagnosis")
    assert f"`results/loop/ranges`): {share(ranges['right'])}, and intervals" in words("diagnosis")
    assert f"the true size in {share(ranges['intervals that hold'])}. Of other" in words("diagnosis")


def test_the_page_on_the_diagnosis_says_what_the_table_of_white_and_slow_noise_says() -> None:
    slow = pd.read_csv(RESULTS / "loop" / "slow" / "summary.csv", comment="#", dtype=str).iloc[0]
    page = words("diagnosis")
    assert f"`results/loop/slow`): {share(slow['right'])}; intervals hold the true size in" in page
    assert f"hold the true size in {share(slow['intervals that hold'])}. With nothing" in page
    frame = pd.read_csv(RESULTS / "loop" / "slow" / "laboratory.csv", comment="#")
    still = nothing_missing(frame).iloc[0]
    assert f"With nothing missing {share(still['false alarms'])} had an effect named: zeros that wander" in page
    wrong = frame[(frame["count"] == 0) & ~frame["right"].astype(bool)]
    assert set(wrong["sites"]) == {24}
    assert wrong["named"].str.contains("sensor-wander").all()


def test_the_page_on_the_diagnosis_says_how_long_laboratory_recordings_take() -> None:
    frame = pd.read_csv(RESULTS / "loop" / "laboratory-third" / "laboratory.csv", comment="#")
    long, others = (frame.loc[which, "cpu_seconds"] for which in (frame["sites"] == 24, frame["sites"] < 24))
    assert f"`results/loop/laboratory-third` took {long.min():.0f} to {long.max():.0f} seconds" in words("diagnosis")
    assert f"Of its other {len(others)} recordings half took less than 8 seconds, a third more" in words("diagnosis")
    assert 7 < others.median() < 8
    assert (others > 15).mean() == pytest.approx(1 / 3, abs=0.03)


def test_the_page_on_the_diagnosis_says_what_the_second_look_at_held_out_instruments_found() -> None:
    frame = pd.read_csv(RESULTS / "loop" / "second-look" / "laboratory.csv", comment="#")
    alarms = nothing_missing(frame).set_index("instrument")["false alarms"]
    for instrument, told in (
        ("jittered-gaps", "jittered times and missing stretches"),
        ("drifting-zero", "a zero that drifts, up to five effects besides"),
    ):
        right = frame.loc[(frame["instrument"] == instrument) & (frame["count"] > 0), "right"]
        rows = (
            f"| {told} | every effect named, and no other | {share(shares(right.astype(bool)))} | "
            f"| | nothing missing: an effect named | {share(alarms[instrument])} |"
        )
        assert rows in words("diagnosis"), instrument


def test_the_page_on_the_diagnosis_says_what_the_tables_of_short_recordings_say() -> None:
    loop, pairs = (pd.read_csv(RESULTS / name / "trials.csv", comment="#") for name in ("loop", "loop/pairs"))
    loop, pairs = (frame[frame["status"] == "ok"] for frame in (loop, pairs))
    nameless = loop["effect"].str.startswith("other: ")
    alone = ~nameless & (loop["effect"] != "none") & ~loop["effect"].str.contains("+", regex=False)
    for row, some in (
        ("one effect of 10 to 100 standard deviations | it is named", loop[alone & (loop["z"] >= 10)]),
        ("one effect of 5 standard deviations | it is named", loop[alone & (loop["z"] == 5)]),
        ("two effects of 20 standard deviations | both are named", pairs),
        (
            "one effect without a name, 5 or more from all that have one | the verdict says that something is left",
            loop[nameless & (loop["apart"] >= 5)],
        ),
        ("one effect without a name, nearer to one that has | the same", loop[nameless & (loop["apart"] < 5)]),
        ("nothing missing | no effect named", loop[loop["effect"] == "none"]),
    ):
        assert f"| short, {row} | {share(shares(some['right']))} |" in words("diagnosis"), row


def test_the_page_on_the_diagnosis_says_what_the_table_of_recordings_that_lack_nothing_says() -> None:
    frame = pd.read_csv(RESULTS / "loop" / "nothing-missing" / "laboratory.csv", comment="#")
    every = nothing_missing(frame).iloc[0]
    assert every["no answer"] == 0
    for column in ("false alarms", "unexplained"):
        assert f"| {share(every[column], digits=1)} |" in words("diagnosis"), column
    frame = pd.read_csv(RESULTS / "loop" / "nothing-missing-later" / "laboratory.csv", comment="#")
    later = nothing_missing(frame).iloc[0]
    assert later["no answer"] == 1
    assert f"was named in {share(later['false alarms'], digits=1)}, one more had no answer" in words("diagnosis")
    others = [
        pd.read_csv(RESULTS / "loop" / f"nothing-missing-{which}" / "laboratory.csv", comment="#")
        for which in ("third", "fourth", "fifth", "sixth")
    ]
    each = nothing_missing(pd.concat(others)).set_index("instrument")
    assert (each["no answer"] == 0).all()
    exact = share(each.loc["all", "false alarms"], digits=1)
    assert f"effect was named in {exact}, and `unexplained` were " in words("diagnosis")
    assert f"`unexplained` were {share(each.loc['all', 'unexplained'], digits=1)}" in words("diagnosis")
    counts = [one.split()[-1] for one in each.drop("all")["false alarms"]]
    assert f"Each instrument has {min(counts)} to {max(counts)} of these" in words("diagnosis")
    # At most one, and two, of each in the smallest count.
    most = each.drop("all")[["false alarms", "unexplained"]].map(lambda one: float(one.split(" (")[0])).max()
    assert most["false alarms"] <= round(100 / int(min(counts)), 1)
    assert most["unexplained"] <= round(200 / int(min(counts)), 1)
    readme = " ".join((RESULTS.parent / "README.md").read_text(encoding="utf-8").split())
    assert f"it names something in {exact.split(' (')[0]} of {exact.split()[-1]} " in readme


def test_the_page_on_the_limit_says_what_the_table_of_all_crossed_says(script: Callable[[str], ModuleType]) -> None:
    cross = script("cross/cross.py")
    table = cross.load(RESULTS / "cross" / "summary.csv")
    noisy = table[table["noise"] > 0]
    own, large = noisy[noisy["own"]], noisy[~noisy["own"]]
    ratio = {name: own.loc[own["method"] == name, "ratio"] for name in ("trajectory", "weak")}
    noisiest = noisy[(noisy["method"] == "trajectory") & (noisy["noise"] == 0.1)]
    lost = noisiest[noisiest["ratio"] > cross.LOST]
    assert not lost["own"].any()
    page = re.sub(r"\s+", " ", words("limit"))
    for said in (
        f"the median error of `trajectory` (one seed) is {ratio['trajectory'].median():.2g} times the bound and at "
        f"most {ratio['trajectory'].max():.2g} times, that of `weak` (ten seeds) {ratio['weak'].median():.1f} and at "
        f"most {ratio['weak'].max():.2g} times",
        f"rightly in {100 * large.loc[large['method'] == 'weak', 'right'].mean():.0f} %",
        f"loses {len(lost)} of the {noisiest['ratio'].count()} fits that have a bound",
        f"{len(table.groupby(['data', 'library']))} kinds of data, "
        f"{table['ok'].str.split('/').str[1].astype(int).sum()} fits",
    ):
        assert said in page


def test_the_page_on_methods_says_what_the_table_of_limits_says(script: Callable[[str], ModuleType]) -> None:
    shows = script("limits/which.py")
    table = shows.load(shows.HERE)
    own = table[(table["part"] == "noise") & (table["noise"] > 0) & table["own"]]
    near = shows.arranged(own, ["system", "noise"], "efficiency")[list(shows.NEAR_BOUND)].stack()
    text = words("method")
    assert f"are {shows.span(1 / near)} times the bound" in text
    assert f"has {shows.span(shows.error_ratio(own, 'stlsq', 'trajectory'))} times the error of `trajectory`" in text


def test_the_trained_network_is_nearly_as_efficient_as_the_best_method_wherever_it_was_tried(
    script: Callable[[str], ModuleType],
) -> None:
    counts = script("efficiency/efficiency.py")
    found = counts.measured(counts.load())
    network = found[found["method"] == "pinn-gn"]
    assert set(zip(network["part"], network["noise"], strict=True)) >= {
        ("noise", 0.1),
        ("shaken", 0.1),
        ("shaken", 0.01),
    }
    assert network["efficiency"].min() >= 0.65
    assert network["beside"].max() < 1.2
    assert not network["lost"].any()


def test_the_published_spread_covers_what_another_kernel_does(script: Callable[[str], ModuleType]) -> None:
    check = script("default/kernels.py")
    table = pd.read_csv(RESULTS / "default" / "kernels.csv", comment="#")
    assert len(table) >= check.SHARE * len(
        read_cases(RESULTS / "default").query("method != 'zero'").dropna(subset="e2")
    )
    found = check.compared(table).set_index("method")
    several = found["seeds"] > 1
    # Without draws of its own a method repeats itself; with them it scatters no more than its seeds do.
    assert (found.loc[~several, "covered"] == found.loc[~several, "fits"]).all()
    assert (found.loc[several, "covered"] >= found.loc[several, "fits"] * 2 / 3).all()
    told = found.loc["pinn"]
    assert f"{told['covered']:g} of {told['fits']:g} fits of `pinn`" in words("protocol")
    assert f"at most {format_number(found.loc['pinn-gn', 'largest change'])}" in words("protocol")


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


def test_of_the_faults_that_were_played_none_lost_anything_and_the_protocol_counts_the_mutants() -> None:
    faults = pd.read_csv(RESULTS / "scale" / "faults.csv", comment="#")
    assert len(faults) == 9
    assert faults["struck"].eq(50).all()
    assert faults[["lost", "twice", "never run", "left over"]].eq(0).all(axis=None)
    assert "at fifty random moments" in words("cluster")
    mutants = pd.read_csv(RESULTS / "mutants" / "mutants.csv", comment="#")
    assert f"no test notices, of {len(mutants)} drawn" in words("protocol")


def test_the_protocol_says_what_the_tables_of_deepxde_say() -> None:
    steps = pd.read_csv(RESULTS / "peers" / "step_time.csv", comment="#")["milliseconds per step"]
    text = words("protocol")
    for ratio, where in zip(steps[1:] / steps[0], ("as long as `pinn`", "with all", "with its forward"), strict=True):
        assert f"{ratio:.0f} times {where}" in text
    fits = pd.read_csv(RESULTS / "peers" / "fit.csv", comment="#")
    for program, name in (("pinn-gn", "`pinn-gn`"), ("pielm", "`pielm`"), ("pinn", "`pinn`")):
        times = fits.loc[fits["program"] == f"latticebench {program}", "seconds to E2 <= 0.01"]
        middle, least, most = (f"{one:.2g}" for one in (times.median(), times.min(), times.max()))
        assert f"{name} after {middle} s" in text
        assert f"({least} to {most})" in text
    other = fits[fits["program"].str.startswith("DeepXDE")]
    times = other["seconds to E2 <= 0.01"]
    assert times.max() == float("inf")
    assert f"DeepXDE after {float(f'{times.median():.2g}'):g} s ({float(f'{times.min():.2g}'):g} s to never" in text
    assert f"as it ends at {100 * other['E2'].max():.3g} %)" in text
