"""How fast this processor is just now, so that a bound in seconds is one of work and holds on a slow one too."""

from __future__ import annotations

import gc
import json
import time

# Processor seconds of `_work` on an idle core of 2.5 GHz, and how often it is done.
NOMINAL, TIMES = 0.032, 5


def pace() -> float:
    """Return how many times as long as an idle core of 2.5 GHz this one takes now, at least 1."""
    collects = gc.isenabled()
    # What is collected belongs to whoever made it.
    gc.disable()
    try:
        began = time.process_time()
        for _ in range(TIMES):
            _work()
        return max(1.0, (time.process_time() - began) / (TIMES * NOMINAL))
    finally:
        if collects:
            gc.enable()


def _work() -> None:
    """Make, write, read and sort records: plain Python and memory, as in most of what is bounded."""
    rows = [{"name": f"case {number}", "value": number * 0.37, "seed": number % 7} for number in range(20_000)]
    again = json.loads(json.dumps(rows))
    again.sort(key=lambda row: (row["seed"], -row["value"]))
