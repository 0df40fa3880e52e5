"""
A film of a kink
================

A fast kink of the phi^4 lattice sheds waves behind it, slows down and stops: where the coupling is weak, the lattice
pins it. `latticebench plot FILE --animate film.gif` writes such a film of any recording.
"""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation

from latticebench import systems
from latticebench.bench.colours import AFTER, FAINT
from latticebench.systems.simulate import simulate

times = np.linspace(0, 30, 76)
samples = simulate(systems.find("phi4"), parameters={"C": 1.0, "v": 0.8}, sites=41, times=times)
sites = np.arange(samples.sites) + 1

figure, axes = plt.subplots(figsize=(6.4, 3.4), layout="constrained")
axes.set(xlabel="site", ylabel="u", ylim=(-1.8, 1.8))
for well in (-1, 1):
    axes.axhline(well, color=FAINT, lw=1)
(line,) = axes.plot(sites, samples.u[0], "o-", color=AFTER, ms=4)


def show(row):
    """Draw the chain at one time."""
    line.set_ydata(samples.u[row])
    axes.set_title(f"t = {times[row]:.1f}", loc="left")
    return [line]


film = FuncAnimation(figure, show, frames=len(times), interval=80)
