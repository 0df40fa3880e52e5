"""Make the paired tests of published runs anew from their tables of cases: paired.csv, paired.md and paired.tex.

    python results/default/paired.py [FOLDER ...]

The folders are results/default, results/paper and results/ablation if none is given.
"""

from __future__ import annotations

import sys
from pathlib import Path

from latticebench.bench.paired import paired
from latticebench.bench.provenance import commit
from latticebench.bench.publish import FORMATS, render
from latticebench.bench.published import read_head
from latticebench.bench.tables import read_cases
from latticebench.systems.files import write_text

RESULTS = Path(__file__).parents[1]
FOLDERS = [RESULTS / name for name in ("default", "paper", "ablation")]


def main() -> None:
    """Write the three files in each folder."""
    for folder in map(Path, sys.argv[1:]) if sys.argv[1:] else FOLDERS:
        found = paired(read_cases(folder))
        about = {**read_head(folder / "cases.csv"), "tests": f"python results/default/paired.py, commit {commit()}"}
        for form in FORMATS:
            write_text(folder / f"paired.{form}", render(found, about, form, "paired"))


if __name__ == "__main__":
    main()
