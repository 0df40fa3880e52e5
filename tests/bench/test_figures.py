"""Figures: drawn from results, with their provenance inside."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pandas as pd
from PIL import Image

from latticebench.bench.colours import SERIES
from latticebench.bench.figures import draw_all, error_against_noise, errors, panel
from latticebench.bench.fitting import FitCase
from latticebench.bench.tables import SCORES
from latticebench.bench.worker import outcome


def learned() -> dict[str, object]:
    case = FitCase(system="phi4", library="lib1", label="net", method="net")
    made = {**outcome(case, "ok"), "case": case.model_dump(mode="json"), "identity": case.identity}
    made.update(
        e2=0.01, seconds=3.0, cpu_seconds=2.9, coefficients={"u[n]": 1.9, "u[n]**3": 0.1},
        truth={"u[n]": 2.0, "u[n]**3": 0.0},
        history={
            "step": [0, 10, 20], "seconds": [0, 1, 2], "loss": [3, 2, 1],
            "coefficients": [[0, 0], [1, 0.3], [1.9, 0.1]],
        },
    )  # fmt: skip
    return made


def test_a_panel_shows_found_solid_true_dashed_and_absent_black() -> None:
    axes = panel([learned()]).axes[0]
    solid = [line for line in axes.lines if line.get_linestyle() == "-"]
    dashed = [line for line in axes.lines if line.get_linestyle() == "--"]
    assert [list(line.get_ydata()) for line in solid] == [[0, 1, 1.9], [0, 0.3, 0.1]]
    assert [line.get_color() for line in solid] == [SERIES[0], "black"]
    assert len(dashed) == 1
    assert set(dashed[0].get_ydata()) == {2.0}


def test_beside_a_panel_stands_what_each_method_ends_with() -> None:
    other = {**learned(), "history": None, "coefficients": {"u[n]": 1.5, "u[n]**3": 0.0}}
    last = panel([learned(), other]).axes[1]
    marks = [
        (round(float(line.get_xdata()[0])), line.get_ydata()[0]) for line in last.lines if line.get_marker() == "o"
    ]
    assert marks == [(0, 1.9), (0, 0.1), (1, 1.5), (1, 0.0)]


def test_every_figure_is_written_with_its_provenance(tmp_path: Path) -> None:
    other = learned()
    other["case"] = FitCase(system="phi4", library="lib1", label="net", method="net", noise=0.1).model_dump(mode="json")
    paths = draw_all([learned(), other], {"command": "latticebench run x", "seeds": [1]}, tmp_path)
    assert {path.name for path in paths} >= {
        "errors.png",
        "error-against-seconds.png",
        "error-against-noise.png",
        "cost.png",
    }
    assert sum(path.name.startswith("coefficients-") for path in paths) == 2
    assert [path.name for path in draw_all([learned(), other], {}, tmp_path / "one", ["cost"])] == ["cost.png"]
    for path in paths:
        assert matplotlib.image.imread(path).std() > 0.01
        with Image.open(path) as image:
            assert "command: latticebench run x" in image.text["Description"]


def test_methods_of_equal_errors_hide_none_of_one_another_and_an_asterisk_is_explained() -> None:
    rows = [
        {
            "part": "", "data": data, "library": "lib1", "method": method, "noise": 0.0, "seed": 1, "status": "ok",
            "e2": 0.1,
        }
        for data in ("phi4", "dnls") for method in ("a", "b*", "c*")
    ]  # fmt: skip
    table = pd.DataFrame(rows).reindex(columns=[*rows[0], *(score for score in SCORES if score != "e2")])
    axes = errors(table).axes[0]
    marks = [line for line in axes.lines if line.get_marker() not in ("None", None, "")]
    heights = sorted(float(place) for line in marks for place in line.get_ydata())
    assert len(heights) == 6
    assert min(np.diff(heights)) > 0.2
    assert [round(place) for place in heights] == [0, 0, 0, 1, 1, 1]
    assert "published" not in axes.get_xlabel()
    told = table.assign(published=table["method"].str.endswith("*").map({True: "abc", False: ""}))
    assert "* published, commit abc" in errors(told).axes[0].get_xlabel()


def test_error_against_noise_has_a_line_a_method_and_the_bound_as_its_dashed_floor() -> None:
    rows = [
        {
            "part": "", "data": f"phi4 noise={noise} known ends", "library": "lib1", "method": method, "noise": noise,
            "seed": seed, "status": "ok", "e2": scale * noise * seed, "bound": 0.1 * noise if noise else None,
        }
        for method, scale in (("good", 0.1), ("poor", 3.0)) for noise in (0.0, 0.01, 0.1) for seed in (1, 2, 4)
    ]  # fmt: skip
    axes = error_against_noise(pd.DataFrame(rows)).axes[0]
    lines = {str(line.get_label()): line for line in axes.lines}
    np.testing.assert_allclose(lines["good"].get_ydata(), [0.002, 0.02])
    np.testing.assert_allclose(lines["poor"].get_ydata(), [0.06, 0.6])
    floor = lines["Cramer-Rao bound, all terms kept"]
    assert floor.get_linestyle() == "--"
    np.testing.assert_allclose(floor.get_xdata(), [0.01, 0.1])
    np.testing.assert_allclose(floor.get_ydata(), [0.001, 0.01])
    assert axes.get_title() == "phi4, lib1"
