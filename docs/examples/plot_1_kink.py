"""
A kink on a lattice
===================

The discrete phi^4 lattice carries kinks, which lose energy to waves behind them. `plot` draws the samples as a map of
site against time, as lines of the sites that move most, and in their phase planes.
"""

import matplotlib.pyplot as plt

from latticebench import systems
from latticebench.bench.overlay import of_recording
from latticebench.bench.plots import plot
from latticebench.systems.simulate import simulate

samples = simulate(systems.find("phi4"), parameters={"C": 2.0, "v": 0.7}, sites=31)
plot(of_recording(samples), figure=plt.figure())
