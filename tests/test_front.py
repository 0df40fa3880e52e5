"""What a notebook uses: one list of names, examples that run, and results that say what the command line says."""

import doctest
import inspect
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

import latticebench as lb
from latticebench import front, recording
from latticebench.systems.errors import InputError

PENDULUM = lb.Model("sin(u[n])", order=2, ends="free")


def swing(scale=1.0, noise=1e-3):
    """A pendulum of small swings, whose motion is known: cos(2 t)."""
    t = np.arange(0, 30, 0.1)
    u = 0.05 * np.cos(2 * t) + noise * np.random.default_rng(0).standard_normal(len(t))
    return lb.read((t, scale * u))


def test_the_public_names_are_these_and_all_can_be_had():
    classes = ["Bound", "Cause", "Fitted", "Model", "Recording", "Run"]
    functions = ["diagnose", "fit", "limit", "read", "results", "run", "system"]
    assert sorted(lb.__all__) == sorted([*classes, *functions, *lb.ROOMS, "__version__"])
    assert [getattr(lb, name).__doc__ for name in lb.__all__ if name != "__version__"].count(None) == 0
    defined = {
        name
        for module in (recording, front)
        for name, one in vars(module).items()
        if getattr(one, "__module__", "") == module.__name__ and not name.startswith("_")
    }
    assert defined == {*classes, *functions}
    with pytest.raises(AttributeError, match="no attribute 'solve'"):
        _ = lb.solve


@pytest.mark.parametrize("module", [recording, front])
def test_the_examples_in_the_docstrings_print_what_they_say(module):
    found = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert found.attempted > 5
    assert found.failed == 0


def test_every_public_function_tells_its_types():
    for name in lb.__all__:
        if inspect.isfunction(getattr(lb, name)):
            signature = inspect.signature(getattr(lb, name))
            assert signature.return_annotation is not inspect.Signature.empty
            assert all(one.annotation is not inspect.Parameter.empty for one in signature.parameters.values())


def test_a_fit_gives_tables_intervals_and_a_simulation():
    data = swing()
    found = lb.fit(data, PENDULUM)
    assert found.table.loc["sin(u[n])", "coefficient"] == pytest.approx(-4, rel=0.01)
    interval = found.confidence(0.999).loc["sin(u[n])"]
    assert interval["lower"] < -4 < interval["upper"]
    assert found.warnings == ()
    assert found.equation.startswith("u'' = -")
    assert found.latex.startswith(r"\ddot{u}_{n} = -")
    again = found.simulate([0.05], t=np.arange(0, 3, 0.1)).to_frame()
    np.testing.assert_allclose(again["u1"], 0.05 * np.cos(2 * again["t"]), atol=1e-3)
    assert "sin(u[n])" in repr(found)
    assert found._repr_html_().count("<table") == 1
    with pytest.raises(InputError, match="unknown ends"):
        lb.fit(data, lb.Model("u[n]"), method="least-squares").simulate([1.0], t=[0, 1])


def test_a_fit_of_degrees_warns_before_anything_else_and_names_a_remedy():
    found = lb.fit(swing(scale=600), PENDULUM, method="least-squares")
    assert repr(found).startswith("Warning: the equation does not fit")
    assert any("--scale deg" in line for line in found.warnings)
    assert "<b>Warning:</b>" in found._repr_html_()


def test_a_bound_and_a_diagnosis_are_objects_with_tables():
    data = swing()
    bound = lb.limit(data, PENDULUM)
    assert bound.table.loc["sin(u[n])", "smallest error"] < 0.01
    assert bound.warnings == ()
    cause = lb.diagnose(lb.read((data.samples[0].t, data.samples[0].u + 0.02)), PENDULUM)
    assert "sensor-offset" in [
        *cause.effects["effect"],
        *(x for e in cause.report.effects for x in e.indistinguishable),
    ]
    assert list(cause.errors.columns) == ["error", "before", "after"]
    assert cause.model.terms.startswith("sin(u[n])")
    assert "<iframe" in cause._repr_html_()
    assert repr(cause).startswith(cause.report.sentence)


def test_tables_that_were_published_are_frames_of_numbers():
    found = lb.results("paper")
    assert found["cases"]["e2"].dtype.kind == "f"
    with pytest.raises(InputError, match="no published tables"):
        lb.results("nothing")


def test_a_recording_shows_itself_and_what_is_suspicious():
    frame = pd.DataFrame({"t": np.arange(9.0), "x1": np.sin(np.arange(9)), "x2": 5.0, "note": "a"})
    data = lb.read(frame, columns="x*")
    assert "not read: note" in repr(data)
    assert "<table" in data._repr_html_()
    (about,) = data.inspect(PENDULUM)
    assert any("x2: always 5" in line for line in about.suspicious)


def test_importing_the_package_loads_no_front():
    names = ["latticebench.front", "latticebench.recording", "numpy"]
    script = f"import sys, latticebench; print({{*{names}}} & set(sys.modules) or 'none')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["none"]
