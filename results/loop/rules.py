"""Show what each rule of the diagnosis buys: rules.csv and rules.md.

    python results/loop/rules.py [JOBS [FOLDER [NAME ...]]]

Each number of `diagnosis/rules.py` is switched off, halved and doubled, one at a time. The same recordings are
diagnosed every time, and with the rules as they are at the same commit, so that a rule is judged by the recordings
whose answer it changes. What rules.csv already has is not computed again. FOLDER has the measured recordings; without
it, or with "", they are left out. Only the rules and the kinds of recordings that are named are tried, or else all.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from latticebench.bench import suite
from latticebench.bench.case import Case, Folders
from latticebench.bench.provenance import commit, machine
from latticebench.bench.publish import markdown_list, markdown_table
from latticebench.bench.trials import recorded, scores
from latticebench.bench.trials.faults import FIFTH_BLIND
from latticebench.bench.trials.laboratory import tables as laboratory
from latticebench.bench.trials.laboratory.case import Laboratory
from latticebench.bench.trials.laboratory.instruments import KINDS
from latticebench.bench.trials.laboratory.tables import share
from latticebench.bench.trials.measured import Measured
from latticebench.bench.trials.trial import Trial
from latticebench.diagnosis import rules
from latticebench.systems.files import write_text

HERE = Path(__file__).parent
AS_IS = "as they are"
NEVER, ALWAYS = 0.0, 1e9
# What stands for a rule that is switched off, by its number: a value at which it never acts, or always does.
OFF: Mapping[str, Any] = {
    "FALSE_ALARM": 1.0, "FALSE_DOUBT": NEVER, "NAMED": NEVER, "STAND_IN": NEVER,
    "FEW_AROUND": ALWAYS, "CROWDED": 0.5, "STRETCHES": 1, "RIVALS": 1, "TRIED": 1, "UNDERSTATED": 1.0,
    "MOST_EFFECTS": 100, "EQUAL": NEVER, "SLOWER": ALWAYS, "PERIODS": NEVER, "FIRST_HORIZON": 1e6, "MOVES": ALWAYS,
    "AT_ONCE": NEVER, "FASTER": rules.GROWTH, "ALMOST": 1.0, "BORDER": 1e6, "LOST": ALWAYS, "FOLLOWED": NEVER,
    "SHARE": NEVER, "SHARE_TIMED": NEVER, "REPELLING": NEVER, "DISPLACED": NEVER, "PLAINER": NEVER, "LEANER": NEVER,
    "PUSHED": NEVER, "IN_COMMON": ALWAYS, "BESIDE_WHITE": ALWAYS, "WORSE": ALWAYS, "BEYOND_NOISE": NEVER,
    "HELD": ALWAYS, "AWAY": ALWAYS, "EXCHANGED": NEVER, "OTHERWISE": NEVER,
}  # fmt: skip
# Numbers that only mean something as they are, or that are gone with another one.
NEITHER = {"STAND_INS"}
# Half of these is no rule at all, or the rule switched off.
NOT_HALVED = {"RIVALS", "UNDERSTATED", "AT_ONCE", "GROWTH", "FASTER"}
NOT_DOUBLED = {"ALMOST", "SHARE_TIMED"}
KINDS_OF_RECORDINGS = {
    "missing": "laboratory recordings of one to three sites, something missing: every effect is named and no other",
    "nothing": "such recordings with nothing missing: nothing is named, and the verdict is not `unexplained`",
    "wandering": "laboratory recordings of one to three sites, one of whose zeros drifts or wanders: as missing",
    "bent": "laboratory recordings of two sites that rub, with a gain, offsets and a curve of one sensor: as missing",
    "mains": "laboratory recordings of two sites with damping, one of whose sensors has mains in its cable: as missing",
    "shaken": "laboratory recordings of two or three sites and a shaking camera, every other one with nothing missing: "
    "as missing, or as nothing",
    "slow": "laboratory recordings of one to three sites with white and slow noise, every other one with nothing "
    "missing: as missing, or as nothing",
    "held": "laboratory recordings of one to three sites that begin before the chain is let go, every other one with "
    "nothing missing: as missing, or as nothing",
    "unnamed": "short recordings of 25 sites with an effect that has no name: the verdict says that something is left",
    "relaxing": "short recordings of a Ginzburg-Landau lattice of 25 sites, one effect missing: it alone is named",
    "measured": "measured recordings: the effects that are known to be there are named, and the forecast is not worse",
}
# Seeds that nothing else uses.
SEEDS = {
    "missing": range(31000, 31040),
    "nothing": range(32000, 32040),
    "unnamed": (33001,),
    "relaxing": (34001, 34002),
    "wandering": range(35000, 35018),
    "bent": range(36000, 36016),
    "mains": range(39000, 39016),
    "shaken": range(42000, 42016),
    "slow": range(43000, 43016),
    "held": range(55000, 55016),
}
SITES = (1, 2, 3)
# What is missing where a sensor is bent, and where one has mains.
BENT, MAINS = "own-sensor-curve+sensor-gain+sensor-offset+dry-friction", "mains+damping"
# Of so many laboratory recordings in a row so many are kept: those that take least time.
OF, KEPT = 5, 3
# Of the fifth blind set's effects every so many is taken.
EVERY = 3
# What is missing in lattices that relax.
MISSING = ("ends", "onsite-quadratic", "gradient", "next-neighbour", "defect", "sensor-gain", "drive", "kick")
# What is known to be in the measured recordings that take least time; of several effects joined by / one is enough.
THERE = {
    "gliders": ["sensor-offset", "unequal-masses", "damping/quadratic-drag/dry-friction"],
    "carts": ["sensor-gain"],
    "pendulum-tail": ["dry-friction"],
    "pendulum-published": ["dry-friction/quadratic-drag"],
}
KEYS = ["rule", "value", "kind", "recording"]


def variants() -> Iterator[tuple[str, str, Any]]:
    """Yield each rule with what is done to it and the value that it gets: all that are off first."""
    yield AS_IS, "", None
    for name, value in OFF.items():
        yield name, "off", value
    numbers = [name for name in vars(rules) if name.isupper() and name not in NEITHER]
    for how, factor, but in (("half", 0.5, NOT_HALVED), ("double", 2, NOT_DOUBLED)):
        for name in numbers:
            if name not in but:
                value = getattr(rules, name) * factor
                yield name, how, int(value) if isinstance(getattr(rules, name), int) else value


def recordings(folder: Path | None) -> list[tuple[str, str, Case]]:
    """Return every recording with its kind and its name."""
    found: list[tuple[str, str, Case]] = []
    for kind in ("missing", "nothing"):
        for place, seed in enumerate(SEEDS[kind]):
            sites = SITES[place % len(SITES)]
            case = Laboratory(seed=seed, sites=sites)
            if kind == "nothing":
                case = Laboratory(seed=seed, sites=sites, instrument=KINDS[place % len(KINDS)], effects="none")
            found.append((kind, str(seed), case))
    found += [
        ("wandering", str(seed), Laboratory(seed=seed, sites=SITES[place % len(SITES)], instrument="drifting-zero"))
        for place, seed in enumerate(SEEDS["wandering"])
    ]
    for kind, effects in (("bent", BENT), ("mains", MAINS)):
        found += [(kind, str(seed), Laboratory(seed=seed, sites=2, effects=effects)) for seed in SEEDS[kind]]
    for kind, few in (("shaken", SITES[1:]), ("slow", SITES), ("held", SITES)):
        found += [
            (kind, str(seed), Laboratory(seed=seed, sites=few[place // 2 % len(few)], instrument=kind,
                                         effects="none" if place % 2 else "any"))
            for place, seed in enumerate(SEEDS[kind])
        ]  # fmt: skip
    for seed in SEEDS["unnamed"]:
        trials = [(name, Trial(system="phi4", effect=name, z=30.0, seed=seed)) for name in [*FIFTH_BLIND][::EVERY]]
        found += [("unnamed", f"{name} {seed}", trial) for name, trial in trials]
    found += [
        ("relaxing", f"{name} {seed}", Trial(system="ginzburg-landau", effect=name, z=30.0, seed=seed))
        for seed in SEEDS["relaxing"]
        for name in MISSING
    ]
    measured = [] if folder is None else suite.load("measured", folder).cases
    found += [("measured", one.name, one) for one in measured if isinstance(one, Measured) and one.name in THERE]
    return found


def judged(kind: str, name: str, result: Mapping[str, Any]) -> dict[str, Any]:
    """Return the verdict, what was named, and whether that is right."""
    if kind in ("missing", "nothing", "wandering", "bent", "mains", "shaken", "slow", "held"):
        row = laboratory.table([result]).iloc[0]
        right = row["right"] and not (kind in ("nothing", "shaken", "slow", "held") and row["verdict"] == "unexplained")
        return {"truth": row["truth"], "verdict": row["verdict"], "named": row["named"], "right": right}
    if kind in ("unnamed", "relaxing"):
        row = scores.table([result]).iloc[0]
        right = bool(row["right"]) and (kind == "unnamed" or row["extra"] == 0)
        return {"truth": row["effect"], "verdict": row["verdict"], "named": row["named"], "right": right}
    found = recorded.summarised(result["report"])
    effects = [] if result["report"] is None else result["report"]["effects"]
    named = {one for effect in effects for one in (effect["effect"], *effect["indistinguishable"])}
    there = all(named & set(one.split("/")) for one in THERE[name])
    better = found["forecast_after"] is not None and found["forecast_after"] <= found["forecast_before"]
    return {"truth": " + ".join(THERE[name]), "verdict": found["verdict"], "named": found["named"],
            "right": there and better}  # fmt: skip


def diagnosed(rule: str, value: str, changed: Any, one: tuple[str, str, Case], folder: Path | None) -> dict[str, Any]:
    """Diagnose one recording with one rule changed and return its row."""
    kind, name, case = one
    before = getattr(rules, rule, None)
    if rule != AS_IS:
        setattr(rules, rule, changed)
    result = {"case": case.model_dump(mode="json"), "status": "ok", "reason": "", **case.blank()}
    begin = time.process_time()
    try:
        case.run(Folders() if folder is None else Folders(data=folder), result)
        answer = judged(kind, name, result)
    except Exception as error:
        answer = {"truth": "", "verdict": "failed", "named": repr(error), "right": False}
    finally:
        if rule != AS_IS:
            setattr(rules, rule, before)
    seconds = round(time.process_time() - begin, 2)
    return {"rule": rule, "value": value, "kind": kind, "recording": name, **answer, "seconds": seconds,
            "commit": commit()}  # fmt: skip


def known() -> pd.DataFrame:
    """Return what has been computed; an empty table at first."""
    path = HERE / "rules.csv"
    if not path.is_file():
        return pd.DataFrame(columns=KEYS)
    return pd.read_csv(path, comment="#", keep_default_na=False, dtype={"recording": str})


def short(rows: pd.DataFrame, every: Sequence[tuple[str, str, Case]]) -> set[tuple[str, str]]:
    """Return the recordings that rules are tried on, by what they take with the rules as they are."""
    names = ["kind", "recording"]
    base = rows[rows["rule"] == AS_IS].drop_duplicates(names).set_index(names)["seconds"]
    kept = {(kind, name) for kind, name, _ in every if kind not in ("missing", "nothing")}
    for kind in ("missing", "nothing"):
        names = [name for other, name, _ in every if other == kind]
        for begin in range(0, len(names), OF):
            group = names[begin : begin + OF]
            kept |= {(kind, name) for name in sorted(group, key=lambda name: float(base[kind, name]))[:KEPT]}
    return kept


def compute(jobs: int, folder: Path | None, only: Sequence[str]) -> pd.DataFrame:
    """Diagnose whatever is not yet known, and keep each answer as it comes."""
    rows, every = known(), recordings(folder)
    kinds = set(only) & set(KINDS_OF_RECORDINGS) or set(KINDS_OF_RECORDINGS)
    names = set(only) - kinds
    for rule, value, changed in variants():
        if names and rule not in (AS_IS, *names):
            continue
        here = rows[(rows["rule"] == rule) & (rows["value"] == value)]
        have = set(zip(here["kind"], here["recording"], strict=True))
        asked = {(kind, name) for kind, name, _ in every} if rule == AS_IS else short(rows, every)
        if value in ("half", "double"):
            asked = {(kind, name) for kind, name in asked if kind not in ("unnamed", "measured")}
        work = [one for one in every if one[0] in kinds and one[:2] in asked - have]
        here = rows[(rows["rule"] == AS_IS) & (rows["commit"] == commit())]
        have = set(zip(here["kind"], here["recording"], strict=True))
        beside = [] if rule == AS_IS else [(AS_IS, "", None, one) for one in work if one[:2] not in have]
        with ProcessPoolExecutor(jobs) as pool:
            asking = [*beside, *((rule, value, changed, one) for one in work)]
            for one in as_completed([pool.submit(diagnosed, *what, folder) for what in asking]):
                row = pd.DataFrame([one.result()])
                rows = pd.concat([rows, row], ignore_index=True) if len(rows) else row
                write_text(HERE / "rules.csv", rows.to_csv(index=False))
        print(rule, value, len(work), flush=True)
    return rows


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Return, for each rule and value, how many answers are right, and in how many it is another one."""
    names = ["kind", "recording"]
    tried = set(map(tuple, rows.loc[rows["rule"] != AS_IS, names].to_numpy().tolist()))
    rows = rows[[pair in tried for pair in zip(rows["kind"], rows["recording"], strict=True)]]
    rows = rows.assign(right=rows["right"].astype(str) == "True")
    base = rows[rows["rule"] == AS_IS]
    found = []
    for (rule, value), group in rows.groupby(["rule", "value"], sort=False):
        here = group.drop_duplicates(names, keep="last").set_index(names)
        there = _as_they_are(here, base)
        other = (here["named"] != there["named"]) | (here["verdict"] != there["verdict"])
        gained, lost = (int(np.sum(one & ~two)) for one, two in ((here["right"], there["right"]),
                                                                  (there["right"], here["right"])))  # fmt: skip
        line = {"rule": _said(str(rule)), "is": value or AS_IS, "other answers": int(other.sum()),
                "gained": gained, "lost": lost}  # fmt: skip
        line["p"] = f"{binomtest(gained, gained + lost).pvalue:.2g}" if gained + lost else ""
        for kind in KINDS_OF_RECORDINGS:
            line[kind] = share(here["right"].xs(kind, level=0)) if kind in here.index.get_level_values(0) else ""
        line["time"] = f"{here['seconds'].sum() / there['seconds'].sum():.2f}"
        found.append(line)
    return pd.DataFrame(found)


def _as_they_are(here: pd.DataFrame, base: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the same recordings with no rule changed: of the same commit, or else the latest."""
    names = ["kind", "recording"]
    exact = base.drop_duplicates(["commit", *names]).set_index(["commit", *names])
    latest = base.drop_duplicates(names, keep="last").set_index(names)
    pairs = [(commit, *name) for commit, name in zip(here["commit"], here.index, strict=True)]
    found = [exact.loc[pair] if pair in exact.index else latest.loc[pair[1:]] for pair in pairs]
    return pd.DataFrame(found, index=here.index)


def _said(rule: str) -> str:
    if rule == AS_IS:
        return ""
    return rule if hasattr(rules, rule) else f"{rule} (deleted)"


def write(rows: pd.DataFrame) -> None:
    """Write the page."""
    about = {
        "command": "python results/loop/rules.py",
        "commit": ", ".join(sorted(set(rows["commit"]))),
        "machine": machine(),
        "seeds": ", ".join(f"{kind} {min(seeds)}-{max(seeds)}" for kind, seeds in SEEDS.items()),
    }
    words = {"off": "switched off (see `OFF` in `rules.py` beside this page)", "half": "halved", "double": "doubled"}
    done = " or ".join(said for value, said in words.items() if value in set(rows["value"]))
    text = [
        "# What each rule buys", "",
        *markdown_list([f"{name}: {value}" for name, value in about.items()]), "",
        f"Each number of `diagnosis/rules.py` is {done}, one at a time, on the same recordings; what is empty was not "
        "tried. A recording is right if:", "",
        *markdown_list([f"{kind}: {what}" for kind, what in KINDS_OF_RECORDINGS.items()]), "",
        "`other answers` are recordings whose verdict or names differ from those with the rules as they are; of these "
        "`gained` are right now and were not, `lost` the other way round, and `p` is the chance of so uneven a pair "
        "(sign test). Shares are in per cent, with 95 % intervals (Wilson). `time` is the processor time over that "
        f"with the rules as they are. Of {OF} laboratory recordings the {KEPT} that take least time are tried.", "",
        markdown_table(summary(rows)),
    ]  # fmt: skip
    write_text(HERE / "rules.md", "\n".join(text))


if __name__ == "__main__":
    place = None if sys.argv[2:3] in ([], [""]) else Path(sys.argv[2])
    write(compute(int(sys.argv[1]) if sys.argv[1:] else 1, place, sys.argv[3:]))
