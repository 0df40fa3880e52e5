"""The colours of figures: they can be told apart with deuteranopia, and in grey by their lightness and their marks.

`tests/bench/test_colours.py` simulates deuteranopia and measures how far apart they are.
"""

from __future__ import annotations

SERIES = (
    "#1a57ad", "#d0711c", "#217c0e", "#c1a4b5", "#730f1d", "#6ade78", "#01009f", "#269edf", "#cc497f", "#4f4556"
)  # fmt: skip
"""Of methods, terms and sites, in this order."""

BEFORE, AFTER, INK, FAINT = SERIES[1], SERIES[0], "#1d2126", "#c9ced4"
"""Of a declared equation, of a fit or of what a diagnosis has found, of readings, and of lines that guide the eye."""

MAP = "cividis"
"""Of values in space and time: from dark blue through grey to light yellow, so that grey print keeps their order."""


def series(place: int) -> str:
    """Return the colour of the `place`-th method, term or site; after the last the first follows."""
    return SERIES[place % len(SERIES)]
