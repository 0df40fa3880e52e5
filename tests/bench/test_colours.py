"""Colours: told apart with deuteranopia and in grey. The references are published formulas, written out here."""

from __future__ import annotations

import itertools
import re
from importlib import resources

import numpy as np
import pytest

from latticebench.bench.colours import AFTER, BEFORE, SERIES

# Machado, Oliveira & Fernandes, IEEE Trans. Vis. Comput. Graph. 15, 1291 (2009): deuteranopia, in linear RGB.
DEUTERANOPIA = np.array([
    [0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881],
])  # fmt: skip
# IEC 61966-2-1: linear sRGB to XYZ, white being D65.
XYZ = np.array([
    [0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041],
])  # fmt: skip
STYLE = resources.files("latticebench.bench.report") / "templates" / "diagnosis.css"


def linear(colour: str) -> np.ndarray:
    part = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    x = (XYZ @ rgb) / XYZ.sum(axis=1)
    f = np.where(x > (6 / 29) ** 3, np.cbrt(x), x / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def ciede2000(one: np.ndarray, two: np.ndarray) -> float:
    """Sharma, Wu & Dalal, Color Res. Appl. 30, 21 (2005), with unit weights."""
    (l1, a1, b1), (l2, a2, b2) = one, two
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    stretch = 1.5 - 0.5 * np.sqrt(mean**7 / (mean**7 + 25**7))
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, stretch * a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    turn = (h2 - h1 + 180) % 360 - 180
    hue = (h1 + turn / 2) % 360
    light, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    t = 1 + sum(
        weight * np.cos(np.radians(times * hue + shift))
        for weight, times, shift in ((-0.17, 1, -30), (0.24, 2, 0), (0.32, 3, 6), (-0.20, 4, -63))
    )
    dl = (l2 - l1) / (1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2))
    dc = (c2 - c1) / (1 + 0.045 * chroma)
    dh = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * chroma * t)
    rotation = (
        -2 * np.sqrt(chroma**7 / (chroma**7 + 25**7)) * np.sin(np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2))))
    )
    return float(np.sqrt(dl**2 + dc**2 + dh**2 + rotation * dc * dh))


def closest(colours: list[str], seen: np.ndarray) -> float:
    """Return the least difference between two colours as an eye of a kind sees them."""
    looks = [lab(np.clip(seen @ linear(one), 0, 1)) for one in colours]
    return min(ciede2000(one, two) for one, two in itertools.combinations(looks, 2))


@pytest.mark.parametrize(
    ("one", "two", "difference"),
    [
        ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425), ((50, 2.5, 0), (73, 25, -18), 27.1492),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)  # fmt: skip
def test_the_difference_is_that_of_the_published_examples(
    one: tuple[float, ...], two: tuple[float, ...], difference: float
) -> None:
    assert ciede2000(np.array(one), np.array(two)) == pytest.approx(difference, abs=1e-4)


@pytest.mark.parametrize("seen", [np.eye(3), DEUTERANOPIA], ids=["usual", "deuteranopia"])
def test_all_colours_of_figures_differ_by_fifteen_also_with_deuteranopia(seen: np.ndarray) -> None:
    assert closest(list(SERIES), seen) >= 15
    assert closest([BEFORE, AFTER], seen) >= 40


def test_in_grey_all_colours_differ_in_lightness() -> None:
    lightness = sorted(lab(linear(one))[0] for one in SERIES)
    assert np.min(np.diff(lightness)) >= 4
    assert abs(lab(linear(BEFORE))[0] - lab(linear(AFTER))[0]) >= 15


@pytest.mark.parametrize("seen", [np.eye(3), DEUTERANOPIA], ids=["usual", "deuteranopia"])
def test_before_and_after_differ_on_a_light_and_on_a_dark_page(seen: np.ndarray) -> None:
    text = STYLE.read_text(encoding="utf-8")
    pairs = zip(*(re.findall(rf"--{name}: (#\w{{6}});", text) for name in ("before", "after")), strict=True)
    found = [closest(list(pair), seen) for pair in pairs]
    assert len(found) == 2
    assert min(found) >= 30
