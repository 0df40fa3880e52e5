"""
A sensor that reads too much
============================

Four pendula are read by four sensors, one of which reads a quarter more than the others. The declared equation has no
place for it: without the sensor's gain, the middle of the chain seems to move against the laws of motion. The diagnosis
names it, with its size and standard error.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_ivp

import latticebench as lb
from latticebench.bench.overlay import of_diagnosis
from latticebench.bench.plots import plot

draws = np.random.default_rng(3)
t = np.linspace(0, 25, 251)


def rate(_, state):
    """Return the derivatives of angles and velocities of four pendula, coupled by springs."""
    u, v = np.split(state, 2)
    left, right = np.append(u[0], u[:-1]), np.append(u[1:], u[-1])
    return np.append(v, 1.2 * (left + right - 2 * u) - 4 * np.sin(u))


start = np.append([0.6, -0.2, 0.4, 0.1], np.zeros(4))
angles = solve_ivp(rate, (0, 25), start, t_eval=t, rtol=1e-9, atol=1e-9).y[:4].T
readings = angles * [1, 1, 1.25, 1] + 0.005 * draws.normal(size=angles.shape)

model = lb.Model("u[n+1]+u[n-1]-2*u[n]; sin(u[n])", order=2, ends="free")
cause = lb.diagnose(lb.read(readings, time=t), model)
print(cause)
print(cause.effects.to_string(index=False))

plot(of_diagnosis(cause.result), figure=plt.figure())
