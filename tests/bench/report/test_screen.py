"""Tables on a terminal: numbers stay whole, however narrow it is."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from latticebench.bench.report import screen

HEADS = ["data", "library", "least-squares", "trajectory", "weak"]
CELLS = [["phi4 C=2 v=0.5 noise=0.01", "lib2", "0.055 [0.0082, 0.057] n=5", "1.8e-08", "2.0e-04 [3.6e-04, 1e-3] n=3"]]


def printed(monkeypatch: pytest.MonkeyPatch, width: int, keys: int = 2) -> str:
    out = io.StringIO()
    monkeypatch.setattr(screen, "console", lambda: Console(file=out, width=width))
    screen.show_rows(HEADS, CELLS, keys)
    return out.getvalue()


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_table_that_is_too_wide_is_printed_in_parts_with_whole_numbers(
    monkeypatch: pytest.MonkeyPatch, width: int
) -> None:
    text = printed(monkeypatch, width)
    assert all(cell in text for cell in (*CELLS[0][1:], *HEADS))
    assert max(map(len, text.splitlines())) <= width
    assert text.count("library") == text.count("lib2") > 1


@pytest.mark.parametrize("keys", [0, 2])
def test_a_table_that_fits_is_one(monkeypatch: pytest.MonkeyPatch, keys: int) -> None:
    text = printed(monkeypatch, 200, keys)
    assert (text.count("library"), "  ".join(CELLS[0]).split()) == (1, text.splitlines()[3].split())


def test_a_log_is_told_now_and_then_what_is_being_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, 3.0, 21.0, 30.0, 65.5])
    monkeypatch.setattr(screen.time, "monotonic", lambda: next(clock))
    with screen.watching() as tell:
        for text in ("first", "second", "third", "fourth"):
            tell(text)
    assert capsys.readouterr().err == "after 21 s: second\nafter 66 s: fourth\n"
