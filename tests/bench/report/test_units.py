"""Numbers of a diagnosis in the units of the recording."""

from __future__ import annotations

import pytest

from latticebench.bench.report.units import Units, in_sentence, of_coefficient, of_natural
from latticebench.systems.terms import Term

# A sensor that counts backwards, in millimetres.
MIRRORED = Units(time="s", reading="mm", equation="m", scale=-0.001)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("offset of u1: 0.02", "offset of u1: -20 mm"),
        ("drift of u3: -0.5 over the recording", "drift of u3: 500 mm over the recording"),
        ("jump of u3: -0.5 at t = 17.2", "jump of u3: 500 mm at t = 17.2 s"),
        (
            "from t = 25.1 on, the coefficient of u[n] changes by -0.5",
            "from t = 25.1 s on, the coefficient of u[n] changes by -0.5",
        ),
        # A standard deviation has no sign, whichever way the sensor counts.
        ("walk of u2: 0.5 over the recording, and so on", "walk of u2: 500 mm over the recording, and so on"),
        (
            "hum of u1: 0.002 to either side of u, at the angular frequency 6.86",
            "hum of u1: 2 mm to either side of u, at the angular frequency 6.86 rad/s",
        ),
        ("offset of u1 in recording 2 beyond others: 0.02", "offset of u1 in recording 2 beyond others: -20 mm"),
        ("the ends are fixed", "the ends are fixed"),
    ],
)
def test_zeros_are_said_in_the_unit_of_the_readings(line: str, expected: str) -> None:
    assert in_sentence(line, MIRRORED) == expected


def test_the_natural_form_of_a_walk_is_positive_in_that_unit() -> None:
    assert of_natural("walk of u2", MIRRORED) == (1000.0, "mm")
    assert of_natural("offset of u2", MIRRORED) == (-1000.0, "mm")
    assert of_natural("hum of u2, cos(6.86*(t-5))", MIRRORED) == (-1000.0, "mm")


PENDULA = Units(time="s", reading="deg", equation="rad", scale=0.0174533)
GLIDERS = Units(time="s", reading="mm", equation="mm", scale=1.0)


@pytest.mark.parametrize(
    ("text", "order", "units", "expected"),
    [
        ("u[n+1]+u[n-1]-2*u[n]", 2, GLIDERS, "1/s^2"), ("u[n]**3", 2, GLIDERS, "1/(mm^2 s^2)"),
        ("v[n]", 2, GLIDERS, "1/s"), ("abs(v[n])*v[n]", 2, GLIDERS, "1/mm"), ("1", 2, GLIDERS, "mm/s^2"),
        ("sign(v[n])", 2, GLIDERS, "mm/s^2"), ("abs(u[n])**2*u[n]", 1, GLIDERS, "1/(mm^2 s)"),
        ("u[n]*v[n]**2", 2, GLIDERS, "1/mm^2"), ("(u[n+1]-u[n])**2/u[n]", 2, GLIDERS, "1/s^2"),
        # What is no power has a unit of an angle alone; nobody knows that of an input, nor that of a function of time.
        ("sin(u[n])", 2, PENDULA, "rad/s^2"), ("sin(u[n])", 2, GLIDERS, ""), ("u[n]+u[n]**3", 2, GLIDERS, ""),
        ("sin(v[n])", 2, PENDULA, ""), ("f[n]", 2, GLIDERS, ""), ("cos(3*t)", 2, GLIDERS, ""),
        # Without a unit of the readings that of a linear term is known, without one of time nothing.
        ("u[n]", 2, Units(time="s", reading="", equation="", scale=1.0), "1/s^2"),
        ("u[n]**3", 2, Units(time="s", reading="", equation="", scale=1.0), ""),
        ("u[n]", 2, Units(time="", reading="mm", equation="mm", scale=1.0), ""),
        ("u[n]**2", 2, Units(time="s", reading="m/s", equation="m/s", scale=1.0), "1/((m/s) s^2)"),
    ],
)  # fmt: skip
def test_a_coefficient_has_the_unit_of_the_derivative_over_that_of_its_term(
    text: str, order: int, units: Units, expected: str
) -> None:
    assert of_coefficient(Term(text), order, units) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("v[n]", "1/s"), ("u[n] at site 3", "1/s^2"), ("(-1)^k*u[n]", "1/s^2"), ("cos(2.5*t)", "mm/s^2"),
        ("cos(2.5*(t-12.5))", "mm/s^2"), ("cos(2.5*(t-12.5))*[5.5 < t < 19]", "mm/s^2"), ("begin", "s"), ("end", "s"),
        ("sin(2.5*t)*u[n]*[t > 3]", "1/s^2"),
        ("sin(2.5*t)*u[n]", "1/s^2"),
        ("sin(2.5*(t+3))*u[n]", "1/s^2"), ("exp(-((t-3)/0.5)**2/2)", "mm/s^2"),
        ("exp(-((t+3.2)/0.5)**2/2)", "mm/s^2"), ("exp(-(t/0.5)**2/2)*u[n]", "1/s^2"),
        ("step of u[n+1]+u[n-1]-2*u[n]", "1/s^2"), ("step of u[n]**3", "1/(mm^2 s^2)"), ("(t-20)/40*v[n]", "1/s"),
        ("t/1.5e+03*(u[n+1]+u[n-1]-2*u[n])", "1/s^2"), ("omega", "rad/s"), ("delay", "s"),
        ("decay time", "s"), ("mass_ratio", ""), ("slowness of the clock", ""), ("u[n](t-0.3)", "1/s^2"),
    ],
)  # fmt: skip
def test_numbers_of_effects_have_the_units_of_what_they_are(name: str, expected: str) -> None:
    assert of_natural(name, GLIDERS) == (1.0, expected)
