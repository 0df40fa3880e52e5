"""A recording to try the diagnosis on: seven coupled pendula, made by simulation and written as a laboratory does.

Angles obey theta_n'' = C (theta_{n+1} + theta_{n-1} - 2 theta_n) - k sin(theta_n) - s_n theta_n - gamma theta_n', in
radians and seconds, with free ends. The fifth pendulum alone hangs on an extra spring (s_n), air brakes all of them,
and the sensor of the third is off. The file is in degrees, with semicolons, decimal commas and a column that is none
of the motion.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from latticebench.systems.files import write_text

if TYPE_CHECKING:
    from jaxtyping import Float
    from numpy import ndarray

SITES, COUPLING, STIFFNESS, DAMPING = 7, 4.0, 25.0, 0.06
# Sites are counted from 1; the extra spring is in 1/s^2, the offset in degrees.
DEFECT, EXTRA = 5, 3.0
OFF, OFFSET = 3, 2.0
NOISE, STEP, SPAN = 0.1, 0.03, 15.0
SEED = 5
TERMS = "u[n+1]+u[n-1]-2*u[n]; sin(u[n])"
TIME, COLUMNS, SCALE = "time_s", "theta_*_deg", "deg"


def motion() -> tuple[Float[ndarray, " time"], Float[ndarray, "time sites"]]:
    """Return times in seconds and the sensors' readings in degrees."""
    from scipy.integrate import solve_ivp

    draw = np.random.default_rng(SEED)
    extra = np.zeros(SITES)
    extra[DEFECT - 1] = EXTRA

    def rate(_: float, y: ndarray) -> ndarray:
        angle, velocity = y[:SITES], y[SITES:]
        padded = np.pad(angle, 1, mode="edge")
        pull = COUPLING * (padded[2:] + padded[:-2] - 2 * angle)
        return np.concatenate([velocity, pull - STIFFNESS * np.sin(angle) - extra * angle - DAMPING * velocity])

    t = np.arange(0, SPAN, STEP)
    start = np.concatenate([np.deg2rad(draw.uniform(-30, 30, SITES)), np.zeros(SITES)])
    angles = np.rad2deg(solve_ivp(rate, (0, SPAN), start, t_eval=t, rtol=1e-10, atol=1e-12).y[:SITES].T)
    angles += NOISE * draw.standard_normal(angles.shape)
    angles[:, OFF - 1] += OFFSET
    return t, angles


def write_recording(path: Path) -> None:
    """Write the recording as a laboratory does.

    Raises:
        InputError: it cannot be written.
    """
    t, angles = motion()
    lines = [";".join([TIME, *(f"theta_{site}_deg" for site in range(1, SITES + 1)), "temperature"])]
    lines += [
        ";".join([f"{one:.2f}", *(f"{angle:.3f}" for angle in row), "21.5"]).replace(".", ",")
        for one, row in zip(t, angles, strict=True)
    ]
    write_text(path, "\n".join(["Seven coupled pendula, simulated", *lines]) + "\n")
