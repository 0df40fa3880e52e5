"""Write the baseline of the accuracy tests: python write_baseline.py STORE [keep].

STORE is a run of the suite `accuracy`. With `keep` it may be a run of a part of it: cases that only the baseline has
stay in it, as far as the suite has them, and the head names what made either.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pandas as pd

from latticebench.bench.provenance import describe
from latticebench.bench.publish import render
from latticebench.bench.store import open_store
from latticebench.bench.suite import load
from latticebench.bench.tables import cases
from latticebench.systems.files import write_text

BASELINE = Path(__file__).parent / "baseline.csv"
KEPT = ["data", "library", "method", "noise", "seed", "status", "e2", "residual", "identity"]


def origins(text: str) -> list[dict[str, Any]]:
    """Return what the head of a baseline says of its making, one entry per commit."""
    head = dict(re.findall(r"^# (commit|date|machine): (.*)$", text, re.MULTILINE))
    return [{**head, "commit": one, "versions": {}} for one in head["commit"].split(", ")]


if __name__ == "__main__":
    store = open_store(Path(sys.argv[1]))
    table, made, about = cases(store.results())[KEPT], store.origins(), store.about()
    if sys.argv[2:] == ["keep"]:
        old = pd.read_csv(BASELINE, comment="#")[KEPT]
        stays = old["identity"].isin(load("accuracy").by_identity) & ~old["identity"].isin(table["identity"])
        table = pd.concat([table, old[stays]])
        made = [*origins(BASELINE.read_text(encoding="utf-8")), *made]
        about |= {"command": "python tests/accuracy/write_baseline.py STORE keep", "suite": "a part of accuracy"}
    table = table.sort_values(["data", "library", "method"])
    write_text(BASELINE, render(table, describe(made, about, store.seeds()), "csv"))
