"""Make pendula.csv: seven pendula, coupled by springs, angles (radians) read ten times a second.

    u_n'' = 1.5 (u_{n+1} + u_{n-1} - 2 u_n) - 4 sin(u_n) - 0.04 v_n - 1.2 u_5 at site 5,   free ends

The camera is off by 0.05 at site 2; its noise is 0.005. Run it in this folder.
"""

import numpy as np
from scipy.integrate import solve_ivp

SITES, OFFSET, NOISE = 7, 0.05, 0.005
draws = np.random.default_rng(5)


def rate(_: float, state: np.ndarray) -> np.ndarray:
    """Return the derivatives of angles and velocities."""
    u, v = state[:SITES], state[SITES:]
    left, right = np.append(u[0], u[:-1]), np.append(u[1:], u[-1])
    force = 1.5 * (left + right - 2 * u) - 4 * np.sin(u) - 0.04 * v
    force[4] -= 1.2 * u[4]
    return np.append(v, force)


times = np.arange(300) / 10
start = np.append(0.6 * draws.normal(size=SITES), np.zeros(SITES))
angles = solve_ivp(rate, (0, 30), start, method="DOP853", t_eval=times, rtol=1e-10, atol=1e-12).y[:SITES].T
angles[:, 1] += OFFSET
angles += NOISE * draws.normal(size=angles.shape)
header = "t," + ",".join(f"u{site + 1}" for site in range(SITES))
np.savetxt("pendula.csv", np.column_stack([times, angles]), "%.4f", ",", header=header, comments="")
