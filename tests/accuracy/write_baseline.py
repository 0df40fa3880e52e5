"""Write the baseline of the accuracy tests from a run of the suite `accuracy`: python write_baseline.py STORE."""

from __future__ import annotations

import sys
from pathlib import Path

from latticebench.bench.provenance import describe
from latticebench.bench.publish import render
from latticebench.bench.store import open_store
from latticebench.bench.tables import cases
from latticebench.systems.files import write_text

KEPT = ["data", "library", "method", "noise", "seed", "status", "e2", "residual", "identity"]

if __name__ == "__main__":
    store = open_store(Path(sys.argv[1]))
    table = cases(store.results())[KEPT].sort_values(["data", "library", "method"])
    write_text(
        Path(__file__).parent / "baseline.csv",
        render(table, describe(store.origins(), store.about(), store.seeds()), "csv"),
    )
