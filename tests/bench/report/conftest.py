"""What the tests of reports share: published forms, diagnoses made by hand, and a browser."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest

from latticebench.bench.report.content import content
from latticebench.bench.report.curves import curves
from latticebench.bench.report.document import Provenance, to_json
from latticebench.bench.report.page import page
from latticebench.bench.report.schema import DOCUMENTS
from latticebench.diagnosis.acting import Chain, Placed, way_of
from latticebench.diagnosis.acting.everywhere import Everywhere
from latticebench.diagnosis.acting.gain import Gain
from latticebench.diagnosis.model import Model
from latticebench.diagnosis.noise import Noise, Structure
from latticebench.diagnosis.progress import Horizon, Tried
from latticebench.systems.effects import Effect, find
from latticebench.systems.lattice import library
from latticebench.systems.samples import Samples

Conforms = Callable[[str, str], dict[str, Any]]


@pytest.fixture
def conforms() -> Conforms:
    """Check that a document is JSON without NaN, as its published schema says, and is read back as it was."""

    def check(kind: str, text: str) -> dict[str, Any]:
        schemas = resources.files("latticebench.bench.report") / "schemas"
        schema = json.loads((schemas / f"{kind}.json").read_text(encoding="utf-8"))
        found: dict[str, Any] = json.loads(text, parse_constant=pytest.fail)
        jsonschema.validate(found, schema, jsonschema.Draft202012Validator)
        assert found["schema"] == DOCUMENTS[kind].model_fields["schema_"].default
        assert set(found["provenance"]) >= {"command", "commit", "date", "machine", "versions", "seeds"}
        assert to_json(DOCUMENTS[kind].model_validate_json(text)) == text
        return found

    return check


@pytest.fixture(scope="session")
def about() -> Provenance:
    return Provenance(command="latticebench diagnose", commit="c", date="d", machine="m", versions={}, seeds=[1])


# By hand --------------------------------------------------------------------------------------------------------------

OMEGA = 3.0


def _chain_of(sites: int, order: int = 2, *, is_complex: bool = False, levels: int = 1) -> Chain:
    """A chain with free ends, every site of which has an equation."""
    return Chain(sites, order, is_complex, levels, "free", tuple(range(sites)), sites)


def _noise_of(size: list[float], memory: float = 0.0, growth: float = 0.0, tail: float = np.inf) -> Noise:
    """Noise of sensors of given sizes."""
    return Noise(np.array(size), growth, tail, np.full(len(size), memory), Structure(own_sizes=True))


def _forms(effect: Effect, chain: Chain) -> list[Placed]:
    """An effect as it may stand in a model on a chain, in each of its forms, with numbers of its own."""
    scene: Any = SimpleNamespace(
        chain=chain, begin=0.0, span=30.0, seen=(0.0, 30.0), middle=15.0, top=4.0, frequencies=np.array([1.7234567]),
        recordings=((0, 1, 2), (0, 1, 2)), step=0.05, main=3.0, largest=1.0,
        fast=(), inputs=True,
        past=(lambda t: np.zeros((len(t), chain.parts, chain.sites)),), texts=("u[n+1]+u[n-1]-2*u[n]", "sin(u[n])"),
        terms=lambda one: one.texts(chain.order, chain.is_complex),
    )  # fmt: skip
    kinds: dict[tuple[object, ...], Placed] = {}
    for one in way_of(effect).places(effect, scene):
        kinds.setdefault((type(one), len(one.numbers), one.site is None, getattr(one, "recording", None)), one)
    draw = np.random.default_rng(1)
    return [
        one.moved([*draw.normal(size=len(one.strength)), *one.numbers[len(one.strength) :]]) for one in kinds.values()
    ]


def _curve(t: np.ndarray, seen: np.ndarray, level: np.ndarray) -> Any:
    """Readings (T, N) beside what a model reads."""
    shown = {"seen": seen, "level": level, "field": level, "swing": level - np.mean(level, axis=0)}
    return SimpleNamespace(t=t, **{name: value[:, None, None] for name, value in shown.items()})


def _fitted(model: Model, chain: Chain, noise: Noise, curves: list[Any], **options: Any) -> Any:
    """A fit with standard errors of a per cent of one."""
    count = len(model.numbers)
    about = {"converged": True, "pieces": len(curves), "longest": len(curves[0].t), "cost": 0.0, **options}
    return SimpleNamespace(
        model=model, chain=chain, noise=noise, covariance=1e-4 * np.eye(count), stderr=np.full(count, 0.01),
        curves=lambda: curves, **about,
    )  # fmt: skip


def _finding(placed: Placed, chain: Chain, alternatives: tuple[str, ...] = (), error: float = 0.002) -> Any:
    """A finding whose numbers are known alike."""
    names = [*placed.labels(chain), *placed.shape]
    values = {name: (float(value), error) for name, value in zip(names, placed.numbers, strict=True)}
    return SimpleNamespace(
        placed=placed, alternatives=alternatives, evidence=321.0, values=values, name=placed.effect.name,
        site=placed.site,
    )  # fmt: skip


def _pendula(**changes: Any) -> Any:
    """Two coupled pendula with a damping and a second sensor that reads 1.677 times what it should; no velocities."""
    chain, draw = _chain_of(2), np.random.default_rng(4)
    t = np.linspace(0, 40, 800)
    swing = np.exp(-0.05 * t)[:, None] * np.cos(np.multiply.outer(t, [OMEGA, 1.1 * OMEGA]))
    size = np.array([0.03, 0.02])
    seen = swing * [1, 1.677] + size * draw.normal(size=swing.shape)
    declared = library("own", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")
    damping = Everywhere(effect=find("damping"), texts=("v[n]",), strength=(-0.1,))
    gain = Gain(effect=find("sensor-gain"), sites=(1,), both=False, strength=(0.677,))
    noise = _noise_of([*map(float, size)])
    before, after = Model(declared, 2, (0.9, -8.0)), Model(declared, 2, (1.0, -9.0), (damping, gain))
    forecast = SimpleNamespace(t=t[560:], seen=seen[560:, None], error=0.8)
    far, near = (
        SimpleNamespace(**vars(forecast), predicted=one[560:, None]) for one in (0.5 * swing, swing * [1, 1.677])
    )
    peaks = [(OMEGA, np.nan), (1.1 * OMEGA, np.nan)]
    modes = (peaks, [(0.97 * OMEGA, 0.0), (1.08 * OMEGA, 0.0)], [(OMEGA, 0.05), (1.1 * OMEGA, 0.05)])
    tried = (("kick", 9.0), ("clock", 2.0))
    about = {
        "before": _fitted(before, chain, noise, [_curve(t, seen, 0.9 * swing)], pieces=40, longest=20),
        "after": _fitted(after, chain, noise, [_curve(t, seen, swing * [1, 1.677])]),
        "findings": (
            _finding(damping, chain),
            _finding(gain, chain, ("unequal-masses", "asymmetric-coupling")),
        ),
        "verdict": "explained",
        "horizons": (
            Horizon(20, 0.5, ((("sensor-gain",), 0.0), (("memory",), 3.2)), ()),
            Horizon(800, 20.0, ((("damping", "sensor-gain"), 0.0),), tuple(Tried(*one, 7.0) for one in tried)),
        ),
        "inputs": "", "dead": (), "held": (), "exchanged": (), "left": (),
        "data": (Samples(t, seen, source="pendula.csv", ends="free"),), "used": (800, 800),
        "noise": size, "noise_lines": ("sensor 1: 0.03", "sensor 2: 0.02"), "residual": (15.0, 1.0),
        "rms": (0.4, 0.025), "dynamics": (0.3, 0.02), "forecasts": ([far], [near]), "forecast": (0.8, 0.01),
        "forecast_by_noise": 0.008,
        "criterion": (0.0, -9000.0), "declared": (np.array([0.9, -8.0]), np.array([1.0, -9.0])),
        "modes": tuple([SimpleNamespace(frequency=w, decay=d) for w, d in one] for one in modes),
        "truth": np.array([1.0, -9.0]), "coefficients": (0.11, 0.0), "whole": True,
    }  # fmt: skip
    return SimpleNamespace(**{**about, **changes})


@pytest.fixture(scope="session")
def pendula() -> Callable[..., Any]:
    return _pendula


@pytest.fixture(scope="session")
def forms() -> Callable[[Effect, Chain], list[Placed]]:
    return _forms


@pytest.fixture(scope="session")
def chain_of() -> Callable[..., Chain]:
    return _chain_of


@pytest.fixture(scope="session")
def noise_of() -> Callable[..., Noise]:
    return _noise_of


# In a browser ---------------------------------------------------------------------------------------------------------

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)


def _browsed(path: Path, *, extra: tuple[str, ...] = ()) -> str:
    """Open a page in a browser without a window and give its document back."""
    if BROWSER is None:
        pytest.skip("there is no Chromium; install Debian's package chromium")
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={path.parent / 'profile'}",
        "--virtual-time-budget=3000", *extra, "--dump-dom", path.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    if done.returncode != 0 and not done.stdout:
        pytest.skip(f"Chromium does not run here: {done.stderr[-200:]}")
    return done.stdout


MEASURE = """<script>addEventListener('load', () => {
  const box = (one) => { const b = one.getBoundingClientRect(); return [b.width, b.height]; };
  const every = (selector) => [...document.querySelectorAll(selector)];
  const handled = (one) => [...one.attributes].some((a) => a.name.startsWith('on'));
  const found = {
    figures: every('figure svg').map(box), math: every('math').map(box), images: every('svg image, img').map(box),
    text: document.body.innerText, title: document.title, scripts: document.scripts.length,
    wide: document.documentElement.scrollWidth, window: innerWidth, handlers: every('*').filter(handled).length,
  };
  const out = document.createElement('pre');
  out.id = 'measured';
  out.textContent = JSON.stringify(found);
  document.body.append(out);
});</script>"""


def _measured(text: str, path: Path, **options: tuple[str, ...]) -> dict[str, Any]:
    """Measure a page with a script of the test's own; the page's policy against scripts is taken off for it."""
    bare = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)
    assert bare != text
    path.write_text(bare.replace("</body>", MEASURE + "</body>"))
    document = _browsed(path, **options)
    inner = re.search(r'<pre id="measured">(.*?)</pre>', document, re.DOTALL)
    assert inner is not None
    found: dict[str, Any] = json.loads(html.unescape(inner[1]))
    return found


def _check_figures(diagnosis: Any, path: Path) -> None:
    """Every figure and equation of a page has a size in a browser, and the page says what it should."""
    found = _measured(page(content(diagnosis), curves(diagnosis), None), path, extra=("--window-size=1000,900",))
    assert len(found["figures"]) == (5 if diagnosis.findings else 4)
    for width, height in found["figures"]:
        assert width > 200
        assert height > 100
    for width, height in [*found["math"], *found["images"]]:
        assert width > 5
        assert height > 5
    words = (content(diagnosis).sentence, "How the search went", "Angular frequencies", "residual over the noise")
    for text in words:
        assert text in found["text"]
    assert found["scripts"] == 1


@pytest.fixture(scope="session")
def browsed() -> Callable[..., str]:
    return _browsed


@pytest.fixture(scope="session")
def measured() -> Callable[..., dict[str, Any]]:
    return _measured


@pytest.fixture(scope="session")
def check_figures() -> Callable[[Any, Path], None]:
    return _check_figures
