"""The terms that tests go through, and second implementations that results are compared with."""

import cmath
import math

import numpy as np
import pytest

from latticebench.systems.parser import FUNCTIONS

TERMS = [
    "u[n]",
    "u[n+1]+u[n-2]-2*u[n]",
    "u[n]**3",
    "abs(u[n])**2*u[n]",
    "abs(u[n])**3",
    "conj(u[n])**2",
    "u[n]*conj(u[n+1])*v[n]",
    "sin(2*u[n])",
    "sign(v[n])",
    "cos(1.7*t)",
    "n*u[n]",
    "n**2",
    "f[n]*u[n]",
    "re(u[n])*im(u[n+1])",
    "sqrt(abs(u[n]))",
    "sqrt(2)*u[n]",
    "sin(1)*log(3)*exp(0.5)*u[n]",
    "pi*u[n]/7",
    "u[n]**-2",
    "-u[n]",
    "+u[n]-0.1*v[n]",
    "(u[n]-0.25)*(u[n]+0.5)/(1+abs(u[n+1])**2)",
    "3",
    "0*u[n]",
    "tanh(u[n])*cosh(u[n+1])-sinh(v[n])",
    "1e-3*exp(-abs(u[n])**2)",
]
COMPLEX_TERMS = [
    *TERMS,
    "i*u[n]",
    "(1+2*i)*conj(u[n])",
    "i*abs(u[n])**2*u[n]",
    *(f"{name}(u[n])" for name in FUNCTIONS),
    *(f"{name}(0.3*u[n]+i*u[n+1]+0.1)" for name in FUNCTIONS),
    "u[n]**1.7",
    "u[n]**0.5",
    "sign(u[n])*v[n]",
]
REAL_TERMS = [
    *TERMS,
    *(f"{name}(0.2+u[n]**2)" for name in FUNCTIONS),
    "abs(u[n])",
    "abs(v[n])*v[n]",
    "atan(u[n])",
    "i*i*u[n]",
    "abs(i*u[n])",
]
PLAIN = {
    "abs": abs,
    "conj": lambda z: complex(z).conjugate(),
    "re": lambda z: complex(z).real,
    "im": lambda z: complex(z).imag,
    "sign": lambda z: z / abs(z) if z else 0.0,
    **{name: getattr(cmath, name) for name in FUNCTIONS if name not in ("abs", "conj", "re", "im", "sign")},
}
CASES = [(text, False) for text in REAL_TERMS] + [(text, True) for text in COMPLEX_TERMS]


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{'complex' if case[1] else 'real'}")
def case(request):
    """A term, and whether the field is complex."""
    return request.param


@pytest.fixture(params=[text for text in TERMS if text != "0*u[n]"])
def text(request):
    """A term that has a value on real and on complex fields, and is not zero everywhere."""
    return request.param


@pytest.fixture(scope="session")
def texts():
    """All terms that have a value on real and on complex fields."""
    return TERMS


@pytest.fixture(scope="session")
def cases():
    """All terms, each with whether the field is complex."""
    return CASES


@pytest.fixture(scope="session")
def plainly():
    def plainly(text, values, t, n):
        """Evaluate a term by Python itself, for one site; the texts are this file's own."""
        fields = {name: {n + offset: value for (key, offset), value in values.items() if key == name} for name in "uvf"}
        return complex(eval(text, {"__builtins__": {}}, {**PLAIN, **fields, "t": t, "n": n, "i": 1j, "pi": math.pi}))

    return plainly


@pytest.fixture(scope="session")
def draw_values():
    def draw_values(seed, is_complex, count=4):
        draw = np.random.default_rng(seed)
        keys = [("u", 0), ("u", 1), ("u", -2), ("v", 0), ("f", 0)]
        real = {key: draw.uniform(-1.5, 1.5, count) for key in keys}
        if is_complex:
            real = {key: a + (1j * draw.uniform(-1.5, 1.5, count) if key[0] != "f" else 0) for key, a in real.items()}
        return real, draw.uniform(0, 3, count), np.arange(count) - 1.5

    return draw_values


@pytest.fixture(scope="session")
def neighbour():
    def neighbour(u, k, ends):
        """The value at site k = 0..N-1, or what stands beyond the ends, written from their definitions."""
        count = len(u)
        if 0 <= k < count:
            return u[k]
        if ends == "fixed":
            return 0.0
        if ends == "periodic":
            return u[k - count] if k >= count else u[k + count]
        if ends == "antiperiodic":
            return -u[k - count] if k >= count else -u[k + count]
        # Free: u_0 = u_1 and u_{N+1} = u_N, further sites mirrored about the same bond.
        return u[-1 - k] if k < 0 else u[2 * count - 1 - k]

    return neighbour
