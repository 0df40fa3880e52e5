"""What a notebook uses: one list of names, examples that run, and results that say what the command line says."""

import doctest
import inspect
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import latticebench as lb
from commandline import succeed
from latticebench import fitted, front, pictures, recording
from latticebench.bench import calls
from latticebench.systems.errors import InputError
from latticebench.systems.simulate import simulate

MODULES = (recording, fitted, front, pictures)
PENDULUM = lb.Model("sin(u[n])", order=2, ends="free")


def swing(scale=1.0, noise=1e-3):
    """A pendulum of small swings, whose motion is known: cos(2 t)."""
    t = np.arange(0, 30, 0.1)
    u = 0.05 * np.cos(2 * t) + noise * np.random.default_rng(0).standard_normal(len(t))
    return lb.read((t, scale * u))


def test_the_public_names_are_these_and_all_can_be_had():
    classes = [
        "Bound", "Cause", "Film", "Fitted", "Inspected", "Model", "Picture", "Recording", "Residual", "Run", "Survey",
        "Tables",
    ]  # fmt: skip
    functions = ["diagnose", "fit", "limit", "read", "results", "run", "simulate", "system"]
    assert sorted(lb.__all__) == sorted([*classes, *functions, *lb.ROOMS, "InputError", "__version__"])
    assert lb.InputError is InputError
    assert [getattr(lb, name).__doc__ for name in lb.__all__ if name != "__version__"].count(None) == 0
    defined = {
        name
        for module in MODULES
        for name, one in vars(module).items()
        if getattr(one, "__module__", "") == module.__name__ and not name.startswith("_")
    }
    assert defined == {*classes, *functions}
    with pytest.raises(AttributeError, match="no attribute 'solve'"):
        _ = lb.solve


@pytest.mark.parametrize("module", MODULES)
def test_the_examples_in_the_docstrings_print_what_they_say(module):
    found = doctest.testmod(module, optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
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
    for wrong in ({"u": np.arange(0, 3, 0.1)}, {"u": [0.1], "v": [0.1, 0.2]}, {"v": 0.1}):
        with pytest.raises(InputError, match=r"the chain has 1 sites?.*t=\.\.\."):
            found.simulate(**wrong)
    assert "sin(u[n])" in repr(found)
    assert found._repr_html_().count("<table") == 1
    with pytest.raises(InputError, match="unknown ends"):
        lb.fit(data, lb.Model("u[n]"), method="least-squares").simulate([1.0], t=[0, 1])


@pytest.mark.parametrize("name", sorted({name for name in lb.__all__ if name[0].isupper()} - {"InputError"}))
def test_every_object_shows_itself_and_has_an_example(name):
    one = getattr(lb, name)
    assert one.__repr__ is not object.__repr__
    assert hasattr(one, "_repr_html_")
    assert name == "Tables" or ">>> import latticebench as lb" in inspect.getdoc(one) + "".join(
        inspect.getdoc(part) or "" for part in vars(one).values() if inspect.isfunction(part)
    )


def test_a_fit_leaves_a_residual_that_can_be_drawn_in_the_unit_of_the_file():
    t = np.arange(0, 20, 0.1)
    noise = 0.1 * np.random.default_rng(2).standard_normal(len(t))
    frame = pd.DataFrame({"t [s]": t, "x_deg": 3 * np.cos(2 * t) + noise})
    data = lb.read(frame, time="t [s]", columns="x_deg", scale="deg")
    found = lb.fit(data, PENDULUM, method="least-squares")
    left = found.residual
    assert left.rms == pytest.approx(0.1, rel=0.3)
    assert left.times == pytest.approx(1, abs=0.4)
    assert "deg as root mean square" in repr(left)
    np.testing.assert_allclose(left.to_frame()["u1"], left.values[:, 0])
    labels = {axes.get_xlabel() for axes in left.plot().figure.axes}
    assert labels == {"t / s", "angular frequency / (rad/s)"}
    short = lb.read((t[:3], np.cos(t[:3])))
    for shown in (left, left.plot(), found.plot("sites"), short.inspect().plot(), short.animate()):
        assert shown._repr_html_().startswith(("<p>", '<img src="data:image/'))
    with pytest.raises(InputError, match="unknown panel 'site'"):
        found.plot("site")
    for draw in (data.plot, data.inspect().plot):
        with pytest.raises(InputError, match="trajectory 2"):
            draw(trajectory=2)


def test_pictures_and_films_are_written_with_what_made_them(tmp_path):
    from PIL import Image

    data = lb.read(([0.0, 0.1, 0.2], [[1.0, 2.0], [1.5, 2.5], [2.0, 3.0]]))
    drawn = (data.plot("map"), data.inspect().plot())
    for one in drawn:
        with Image.open(one.save(tmp_path / "map.png")) as picture:
            assert "commit" in picture.info["Description"]
    with Image.open(data.animate().save(tmp_path / "chain.gif")) as film:
        assert film.n_frames == 3
    for wrong in (*drawn, data.animate()):
        with pytest.raises(InputError, match="unknown ending"):
            wrong.save(tmp_path / "a.jpg")


def test_the_covariance_is_that_of_nonlinear_least_squares_on_the_known_solution():
    """The relaxation u' = a u + b has u = (u0 + b/a) exp(a t) - b/a, which SciPy fits with a covariance of its own."""
    from scipy.optimize import curve_fit

    t = np.linspace(0, 4, 120)

    def motion(t, a, b, start):
        return (start + b / a) * np.exp(a * t) - b / a

    u = motion(t, -0.9, 0.6, 3.0) + 0.02 * np.random.default_rng(5).standard_normal(len(t))
    _, expected = curve_fit(motion, t, u, p0=(-1.0, 0.5, 3.0))
    found = lb.fit(lb.read((t, u)), lb.Model("u[n]; 1", order=1, ends="free"))
    np.testing.assert_allclose(found.covariance, expected[:2, :2], rtol=0.03)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), found.table["standard error"])
    with pytest.raises(InputError, match="no covariance"):
        _ = lb.fit(lb.read((t, u)), found.model, method="least-squares").covariance


def test_a_fit_simulates_the_motion_that_it_is_drawn_with():
    data = swing()
    for method in ("trajectory", "least-squares"):
        found = lb.fit(data, PENDULUM, method=method)
        drawn = data.samples[0].u - found.residual.values
        np.testing.assert_allclose(found.simulate().samples[0].u, drawn, atol=1e-3)
    later = found.simulate(t=[0.0, 60.0]).samples[0]
    assert later.t[-1] == 60


def test_recordings_in_xarray_are_read_as_they_are_labelled():
    xarray = pytest.importorskip("xarray")
    t = np.arange(5.0)
    values = np.arange(10.0).reshape(2, 5)
    one = xarray.DataArray(
        values, dims=("site", "time"), coords={"time": ("time", t, {"units": "s"})}, name="theta",
        attrs={"units": "degrees"},
    )  # fmt: skip
    for data in (
        lb.read(one, scale="deg"),
        lb.read(one.to_dataset(), scale="deg"),
        lb.read(one.to_dataset().assign(temperature=("time", t)), columns="theta", scale="deg"),
    ):
        np.testing.assert_allclose(data.samples[0].u, np.radians(values.T))
        assert (data.samples[0].origin.time, data.samples[0].origin.unit) == ("s", "deg")
    assert "not read: temperature" in repr(data)
    field = xarray.DataArray(values.T * 1j, dims=("t", "n"), coords={"t": t})
    np.testing.assert_array_equal(lb.read(field).samples[0].u, values.T * 1j)
    every = xarray.Dataset({"u": (("t", "n"), values.T), "v": (("t", "n"), 2 * values.T), "f": ("t", t)}, {"t": t})
    (samples,) = lb.read(every).samples
    np.testing.assert_array_equal(samples.v, 2 * values.T)
    np.testing.assert_array_equal(samples.f, np.column_stack([t, t]))
    dated = one.assign_coords(time=pd.date_range("2020-01-01", periods=5, freq="500ms"))
    np.testing.assert_allclose(lb.read(dated).samples[0].t, 0.5 * t)
    for wrong, reason in (
        (xarray.DataArray(values, dims=("x", "y")), "there is no dimension time or t"),
        (xarray.DataArray(values.T, dims=("time", "x")), r"assign_coords\(time="),
        (xarray.DataArray(values[:, :, None], dims=("x", "t", "y"), coords={"t": t}), "choose with .isel"),
    ):
        with pytest.raises(InputError, match=reason):
            lb.read(wrong)


def test_a_fit_of_degrees_warns_before_anything_else_and_names_a_remedy():
    found = lb.fit(swing(scale=600), PENDULUM, method="least-squares")
    assert repr(found).startswith("Warning: the equation does not fit")
    assert any("scale='deg'" in line for line in found.warnings)
    assert "<b>Warning:</b>" in found._repr_html_()


@pytest.mark.parametrize(("damping", "sites", "span"), [(0, 31, 20), (1e-3, 21, 10)])
def test_readings_without_noise_do_not_contradict_themselves(damping, sites, span):
    known = lb.systems.find("sine-gordon")
    moved = replace(known, equation=f"{known.equation} - {damping}*v[n]")
    samples = simulate(moved, parameters={"C": 0.5, "v": 0.5}, sites=sites, times=np.arange(0, span, 0.2))
    cause = lb.diagnose(lb.Recording((samples,)), lb.system("sine-gordon"))
    assert cause.verdict == ("explained" if damping else "nothing missing")
    assert set(cause.effects["effect"]) == ({"damping"} if damping else set())
    assert cause.result.left == ()
    assert not any(one.indistinguishable for one in cause.report.effects)
    assert cause.result.residual[1] < 1
    assert all("at most" in line for line in cause.report.noise_lines)


def test_a_few_readings_without_noise_that_are_far_apart_do_not_contradict_themselves():
    known = lb.systems.find("phi4")
    samples = simulate(known, sites=5, times=np.linspace(0, 55 / 6, 12), integrator="dop853")
    cause = lb.diagnose(lb.Recording((samples,)), lb.system("phi4"))
    assert cause.verdict == "nothing missing"
    assert cause.result.residual[1] < 1


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


def test_a_diagnosis_takes_effects_of_ones_own_and_forecasts_another_recording(tmp_path):
    (tmp_path / "mine.toml").write_text('[[effect]]\nname = "my-force"\nformula = "u[n]**7"\n')
    t = np.arange(0, 12, 0.1)
    first, later = (lb.read((t, 0.05 * np.cos(2 * t + phase) + 1e-3 * np.sin(97 * t))) for phase in (0, 1))
    cause = lb.diagnose(first, PENDULUM, effects=tmp_path / "mine.toml", holdout=later)
    assert "my-force" in [one.effect for one in cause.report.horizons[-1].tried]
    assert [len(one.t) for one in cause.result.data] == [len(t)]
    with pytest.raises(InputError):
        lb.diagnose(first, PENDULUM, holdout=lb.read((t, np.stack([np.cos(t), np.sin(t)], axis=1))))


@pytest.mark.parametrize(
    ("first", "later", "words"),
    [
        (("t [s]", "x [deg]", "deg"), ("t [ms]", "x [deg]", "deg"), "times in ms, those of table in s"),
        (("t [s]", "x [mm]", 1), ("t [s]", "x [cm]", 1), "readings in cm, those of table in mm"),
        (("t [s]", "x [deg]", "deg"), ("t [s]", "x [deg]", 1), "scaled readings in deg, those of table in rad"),
    ],
)
def test_a_recording_in_other_units_is_no_holdout(first, later, words):
    t = np.arange(0, 12, 0.1)
    found = []
    for time, column, scale in (first, later):
        frame = pd.DataFrame({time: t, column: 3 * np.cos(2 * t) + 0.1 * np.sin(97 * t)})
        found.append(lb.read(frame, time=time, columns=column, scale=scale))
    with pytest.raises(InputError, match=f"table: {words}; read them apart"):
        lb.diagnose(found[0], PENDULUM, holdout=found[1])


def test_an_interrupted_diagnosis_returns_what_it_knows():
    def stop(text):
        if "without" in text or "no name" in text:
            raise KeyboardInterrupt

    _, report = calls.diagnose(PENDULUM.of(swing()), PENDULUM.library, 2, watcher=stop)
    assert report.interrupted
    assert len(report.horizons) > 0


def test_tables_that_were_published_are_frames_of_numbers():
    found = lb.results("paper")
    assert found["cases"]["e2"].dtype.kind == "f"
    assert found._repr_html_().count("<tr") == len(found) + 1
    with pytest.raises(InputError, match=r"unknown published run 'papr'; did you mean 'paper'\?"):
        lb.results("papr")
    with pytest.raises(InputError, match="no published tables"):
        lb.results("nothing/here")


def test_a_recording_shows_itself_and_what_is_suspicious():
    frame = pd.DataFrame({"t": np.arange(9.0), "x1": np.sin(np.arange(9)), "x2": 5.0, "note": "a"})
    data = lb.read(frame, columns="x*")
    assert "not read: note" in repr(data)
    assert "<table" in data._repr_html_()
    about = data.inspect(PENDULUM)
    assert any("x2: always 5" in line for line in about.suspicious)
    assert "Suspicious: x2: always 5" in repr(about)
    assert about._repr_html_().count("<table") == 1
    assert about.table["column"].tolist() == ["x1", "x2"]
    assert len(about.plot().figure.axes) == 2


def test_arrays_are_read_as_a_file_with_the_same_readings():
    t = np.arange(0, 10, 0.05)
    angle = 360 * (0.6 * t - 0.02 * t**2)
    order = np.random.default_rng(1).permutation(len(t))
    frame = pd.DataFrame({"t": t, "u1": angle % 360})
    for words in (
        {"scale": "deg"}, {"turn": 360}, {"scale": "deg", "turn": 360, "sort": True}, {"scale": -2.5},
    ):  # fmt: skip
        rows = order if "sort" in words else np.arange(len(t))
        (one,) = lb.read(angle[rows] % 360, time=t[rows], **words).samples
        (pair,) = lb.read((t[rows], angle[rows] % 360), **words).samples
        np.testing.assert_array_equal(pair.u, one.u)
        (other,) = lb.read(frame.iloc[rows], **words).samples
        np.testing.assert_array_equal(one.t, other.t)
        np.testing.assert_array_equal(one.u, other.u)
        assert one.origin.notes == other.origin.notes
        assert (one.origin.scale, one.origin.unit) == (other.origin.scale, other.origin.unit)


def test_readings_without_times_and_times_without_readings_are_refused_with_what_is_read():
    u = np.zeros((4, 2))
    with pytest.raises(InputError, match=r"lb\.read\(u, time=t\)"):
        lb.read(u)
    table = pd.DataFrame({"t": [0, 1], "u1": [0, 1], "dtype": [0, 1]})
    for source in (table, "u.csv", ["u.csv"], (np.arange(4), u)):
        with pytest.raises(InputError, match="it is the name of a column"):
            lb.read(source, time=np.arange(4))
    assert lb.read([[1, 2], [3, 4], [5, 6]], time=[0, 1, 2]).samples[0].sites == 2


TIMES = np.arange(60) / 10
WRONG_CALLS = {
    "no times": lambda: lb.read(pd.DataFrame({"time_s": TIMES, "a_1_deg": TIMES})),
    "no such column": lambda: lb.read(pd.DataFrame({"t": TIMES, "a": TIMES}), columns="b"),
    "a column twice": lambda: lb.read(pd.DataFrame({"t": TIMES, "a": TIMES}), columns=["a", "a"]),
    "no scale": lambda: lb.read(TIMES, time=TIMES, scale="furlong"),
    "no time scale": lambda: lb.read(TIMES, time=TIMES, time_scale="moon"),
    "half a stretch": lambda: lb.read(TIMES, time=TIMES, between=(2,)),
    "no stretch": lambda: lb.read(TIMES, time=TIMES, between=(2, 1)),
    "no turn": lambda: lb.read(TIMES, time=TIMES, turn=-1),
    "unsorted": lambda: lb.read(TIMES, time=TIMES[::-1]),
    "no noise": lambda: lb.simulate("phi4", noise="x"),
    "an empty pattern": lambda: lb.run("tiny", only=[""]),
    "no method": lambda: lb.run("tiny", methods=["x"]),
    "no seeds": lambda: lb.run("tiny", seeds="x"),
    "a velocity of order 1": lambda: lb.fit(lb.read(TIMES, time=TIMES), lb.Model("v[n]", order=1, ends="free")),
}


@pytest.mark.parametrize("wrong", WRONG_CALLS)
def test_messages_in_python_name_arguments_not_options(wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as refused:
        WRONG_CALLS[wrong]()
    assert "--" not in str(refused.value)


def test_none_among_readings_is_a_missing_value():
    (one,) = lb.read(([0, 1, 2], [[1, None], [2, 5.5], [3, 4]])).samples
    np.testing.assert_array_equal(one.u, [[1, np.nan], [2, 5.5], [3, 4]])


def test_the_turn_that_is_advised_for_arrays_in_degrees_unwraps_them():
    t = np.arange(0, 10, 0.05)
    anew = (t, 360 * (0.6 * t - 0.02 * t**2) % 360)
    told = " ".join(lb.read(anew, scale="deg").inspect().suspicious)
    (turn,) = re.findall(r"turn=(\S+)", told)
    data = lb.read(anew, scale="deg", turn=float(turn))
    assert data.notes == ("angles are unwrapped (a full turn is 360 deg)",)
    assert "turn=" not in " ".join(data.inspect().suspicious)


@pytest.mark.parametrize(
    ("pair", "words", "reason"),
    [
        (([0, 1, 2], [[1, 2], [3, 4]]), {}, r"array u has shape \(2, 2\); it must be \(3, N\)"),
        (([[0, 1], [2, 3]], [1, 2]), {}, r"array t has shape \(2, 2\); it must be \(T,\)"),
        ((0.0, 1.0), {}, r"array t has shape \(\)"),
        (([0, 1], np.ones((2, 1, 1))), {}, r"array u has shape \(2, 1, 1\)"),
        (([0, 1], [[1, 2], [3]]), {}, "array u is none of numbers"),
        (([0, 1], ["a", "b"]), {}, "array u: its values are <U1, not numbers"),
        (([0, 1j], [1, 2]), {}, "array t: times are real"),
        (([1, 0], [1, 2]), {}, "sort=True puts the rows in order"),
        (([0, 1], [1j, 2]), {"turn": 360}, "turn is for angles"),
        (([0, 1], [1, 2]), {"columns": "x"}, "leave time and columns out"),
    ],
)
def test_arrays_that_are_no_recording_are_refused_by_name_and_shape(pair, words, reason):
    with pytest.raises(InputError, match=f"arrays: .*{reason}"):
        lb.read(pair, **words)


def test_of_thousands_of_sensors_a_recording_shows_as_many_as_the_command_does():
    u = np.cos(np.arange(12.0))[:, None] * np.arange(1, 3001)
    u[:, ::2] = 5.0
    seen = lb.read((np.arange(12.0), u)).inspect()
    for shown in (repr(seen), seen._repr_html_()):
        assert shown.count("Suspicious: ") == 200
        assert f"{len(seen.suspicious) - 200} more in `.suspicious`" in shown
    assert repr(seen).count("\n") < 420
    assert repr(seen).endswith("\n2800 more in `.table`")
    assert seen._repr_html_().endswith("<p>2800 more in `.table`</p>")
    assert seen._repr_html_().count("<tr") == 201
    assert len(seen.table) == 3000
    one = lb.read((np.arange(12.0), np.cos(np.arange(12.0))))
    many = lb.Recording(one.samples * 300).inspect()
    assert "\n100 more in `.trajectories`\n" in repr(many)
    assert repr(many).endswith("\n100 more in `.table`")


def test_what_is_suspicious_of_several_trajectories_says_of_which():
    t = np.arange(30.0)
    swings, rests, strays = np.cos(t), np.full(30, 5.0), np.where(t == 9, 1e3, np.cos(t))
    frame = pd.concat([pd.DataFrame({"trajectory": k, "t": t, "u1": u}) for k, u in enumerate((swings, rests, strays))])
    seen = lb.read(frame).inspect()
    assert "table, trajectory 1: u1: always 5; does this sensor work?" in seen.suspicious
    assert all(line.startswith("table, trajectory ") for line in seen.suspicious)
    assert any(line.startswith("table, trajectory 2: u1 at t = 9 is 1000") for line in seen.suspicious)
    assert repr(seen.plot(trajectory=3)) == "Survey(table, trajectory 2: 1 site, 30 rows)"
    (alone,) = lb.read(frame[frame["trajectory"] == 1]).inspect().suspicious
    assert alone.startswith("u1: always 5")


def test_one_site_is_no_sites():
    data = lb.read((np.arange(6.0), np.cos(np.arange(6.0))))
    for shown in (repr(data), repr(data.inspect()), repr(data.animate())):
        assert "1 site, 6 rows" in shown


def test_importing_the_package_loads_no_front():
    names = [*(module.__name__ for module in MODULES), "numpy"]
    script = f"import sys, latticebench; print({{*{names}}} & set(sys.modules) or 'none')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["none"]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"order": 3}, "order=3: the order of the time derivative is 1 or 2"),
        ({"ends": "loose"}, "unknown ends 'loose'"),
        ({"terms": "u[n"}, r"u\[n"),
        ({"terms": ["u[n]"]}, "not list"),
    ],
)
def test_what_is_no_model_is_refused_at_once(wrong, told):
    with pytest.raises(InputError, match=told):
        lb.Model(**{"terms": "u[n]", **wrong})


@pytest.mark.parametrize("act", [lb.fit, lb.diagnose, lb.limit])
def test_what_is_no_recording_or_no_model_is_one_line(act):
    model, data = lb.Model("u[n]"), lb.read((np.arange(9.0), np.ones(9)))
    with pytest.raises(InputError, match=r"a recording is what lb\.read\(\.\.\.\) returns, not str"):
        act("lab.csv", model)
    with pytest.raises(InputError, match=r"a model is made by .*; this is str"):
        act(data, "u[n]")


def test_a_notebook_simulates_what_the_command_line_writes(tmp_path):
    file = tmp_path / "phi4.csv"
    succeed(
        "simulate", "phi4", "--set", "C=1.5", "--sites", "7", "--samples", "20", "--noise", "0.01", "--missing", "0.1",
        "--trajectories", "2", "--seed", "5", "--out", file, cwd=tmp_path,
    )  # fmt: skip
    made = lb.simulate(
        "phi4", parameters={"C": 1.5}, sites=7, samples=20, noise=0.01, missing=0.1, trajectories=2, seed=5
    )
    pd.testing.assert_frame_equal(made.to_frame(), lb.read(file).to_frame())


@pytest.mark.parametrize(
    ("given", "told"),
    [({"name": "phi5"}, "phi4"), ({"parameters": {"D": 1.0}}, "D"), ({"noise": -1.0}, "noise"),
     ({"span": 1e300}, "hour.*has no limits"), ({"samples": 1}, "samples"),
     ({"nosie": 0.1}, "noise")],
)  # fmt: skip
def test_what_cannot_be_simulated_is_refused(given, told):
    with pytest.raises(InputError, match=told):
        lb.simulate(**{"name": "phi4", **given})
