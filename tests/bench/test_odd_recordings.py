"""Recordings that nobody would take but that can be read: the diagnosis of each is one, or is refused in one line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from commandline import Seeds, blocks, soon
from latticebench.systems.samples import Samples
from latticebench.systems.writers import write

TERMS = (
    "u[n]", "u[n]**3", "u[n]**2", "1", "u[n+1]", "u[n+1]-u[n-1]", "u[n+1]+u[n-1]-2*u[n]", "v[n]", "sign(v[n])",
    "abs(v[n])*v[n]", "sin(u[n])", "cos(t)", "t*u[n]", "n*u[n]", "exp(u[n])", "u[n]**15", "u[n]+1e-12*u[n]**2", "f[n]",
    "1e30*u[n]", "sin(1e6*u[n])", "i*u[n]", "abs(u[n])**2*u[n]", "conj(u[n])", "0*u[n]", "u[n+2]", "sign(u[n])",
    "v[n]**3",
)  # fmt: skip


def chain(draw: np.random.Generator, t: np.ndarray, sites: int) -> np.ndarray:
    """Return oscillations (T, sites) about rest with a little noise."""
    phases = draw.uniform(0, 2 * np.pi, sites)
    u = np.cos(draw.uniform(0.5, 2.0) * t[:, None] + phases) * draw.uniform(0.2, 1.5, sites)
    return np.asarray(u + draw.choice([0.0, 1e-3, 0.1]) * draw.normal(size=u.shape))


def constant(draw: np.random.Generator, u: np.ndarray) -> None:
    u[:, draw.integers(u.shape[1])] = draw.choice([0.0, 1.0, -1e5])


def doubled(draw: np.random.Generator, u: np.ndarray) -> None:
    u[:, draw.integers(u.shape[1])] = u[:, draw.integers(u.shape[1])]


def never_read(draw: np.random.Generator, u: np.ndarray) -> None:
    u[:, draw.integers(u.shape[1])] = np.nan


def jumping(draw: np.random.Generator, u: np.ndarray) -> None:
    u[draw.integers(len(u)) :, draw.integers(u.shape[1])] += draw.choice([1.0, 1e3, -1e12])


def full_of_gaps(draw: np.random.Generator, u: np.ndarray) -> None:
    u[draw.random(u.shape) < draw.choice([0.1, 0.6, 0.95])] = np.nan


def rounded(draw: np.random.Generator, u: np.ndarray) -> None:
    u[:] = np.round(u, int(draw.integers(0, 3)))


def wild_row(draw: np.random.Generator, u: np.ndarray) -> None:
    u[draw.integers(len(u))] = draw.choice([1e8, -1e19])


def still(draw: np.random.Generator, u: np.ndarray) -> None:
    u[:] = u[:1]


def clipped(draw: np.random.Generator, u: np.ndarray) -> None:
    u[:] = np.clip(u, -0.1, 0.1)


def noise_alone(draw: np.random.Generator, u: np.ndarray) -> None:
    u[:] = draw.normal(size=u.shape)


def drifting(draw: np.random.Generator, u: np.ndarray) -> None:
    u[:] = u[:1] + np.linspace(0, 1, len(u))[:, None] ** int(draw.integers(1, 4))


FAULTS = (
    constant, doubled, never_read, jumping, full_of_gaps, rounded, wild_row, still, clipped, noise_alone, drifting,
)  # fmt: skip


def spoiled(draw: np.random.Generator, u: np.ndarray) -> np.ndarray:
    """Return readings with some of what goes wrong with instruments, in some unit."""
    u = u.copy()
    for number in draw.choice(len(FAULTS), size=draw.integers(0, 4), replace=False):
        FAULTS[number](draw, u)
    return np.asarray(u * 10.0 ** draw.choice([0, 0, 0, -30, -12, -3, 3, 12, 30]))


def odd(seed: int, folder: Path) -> list[str]:
    """Write the recordings of a seed, and return the command that diagnoses them."""
    draw = np.random.default_rng(seed)
    sites, is_complex = int(draw.choice([1, 2, 2, 3, 4, 6])), bool(draw.random() < 0.2)
    order = 1 if is_complex else int(draw.integers(1, 3))
    files = []
    for number in range(int(draw.choice([1, 1, 1, 2]))):
        rows = int(draw.choice([2, 7, 8, 12, 20, 30]))
        t = np.linspace(0, draw.uniform(1, 20), rows) * 10.0 ** draw.choice([0, 0, 0, -9, 9])
        if draw.random() < 0.3:
            t = np.sort(draw.uniform(t[0], t[-1], rows)) if rows > 2 else t
        u = spoiled(draw, chain(draw, t, sites))
        if is_complex:
            u = u + 1j * spoiled(draw, chain(draw, t, sites))
        # All missing is another refusal.
        u[0] = 1.0 if np.isnan(u).all() else u[0]
        v = spoiled(draw, chain(draw, t, sites)) if order == 2 and draw.random() < 0.4 else None
        f = spoiled(draw, chain(draw, t, sites)) if draw.random() < 0.15 else None
        files.append(f"r{seed}-{number}.csv")
        write([Samples(t, u, v, f)], folder / files[-1])
    lacking = [name for name, there in (("i", is_complex), ("v", order == 2), ("f", f is not None)) if not there]
    known = [text for text in TERMS if not any(re.search(rf"\b{name}\b", text) for name in lacking)]
    terms = "; ".join(draw.choice(known if draw.random() < 0.9 else TERMS, size=draw.integers(1, 5), replace=False))
    ends = str(draw.choice(["unknown", "free", "free", "fixed", "periodic"]))
    outputs = ["--json", f"r{seed}.json", "--html", f"r{seed}.html"]
    return ["diagnose", *files, "--terms", terms, "--order", str(order), "--ends", ends, *outputs]


def survive(folder: Path, seeds: range) -> None:
    for seed in seeds:
        arguments = odd(seed, folder)
        code, out, err = soon(*arguments, cwd=folder)
        told = (seed, arguments, err)
        assert code in (0, 2), told
        # A failure that is told is one all the same.
        assert err == "" if code == 0 else err.startswith("error: ") and err.count("\n") == 1, told
        assert " failed: " not in err, told
        assert (folder / f"r{seed}.json").exists() == (folder / f"r{seed}.html").exists() == (code == 0), told
        assert bool(out) == (code == 0), told


def test_an_odd_recording_is_diagnosed_or_refused_in_one_line_and_soon(tmp_path: Path, seeds: Seeds) -> None:
    survive(tmp_path, seeds(0, 12))


@pytest.mark.slow
@pytest.mark.parametrize("first", blocks(1000, 1300, 50))
def test_many_odd_recordings_are_diagnosed_or_refused_in_one_line_and_soon(
    tmp_path: Path, seeds: Seeds, first: int
) -> None:
    survive(tmp_path, seeds(first, first + 50))
