"""
What an equation lacks
======================

Seven pendula are declared to be coupled and free of friction. The diagnosis names the spring at site 5, the damping and
the sensor that is off, and shows what is left with and without them.
"""

from pathlib import Path

import matplotlib.pyplot as plt

from latticebench.bench.overlay import of_diagnosis
from latticebench.bench.plots import plot
from latticebench.diagnosis.repair import diagnose
from latticebench.systems.effects import CATALOGUE
from latticebench.systems.lattice import library
from latticebench.systems.readers import read

data = read(Path("../data/pendula.csv"), "free")
declared = library("declared", "u[n+1]+u[n-1]-2*u[n]; sin(u[n])")
found = diagnose(declared, 2, data, CATALOGUE)
print(found.verdict, "-", ", ".join(one.name for one in found.findings))

plot(of_diagnosis(found), figure=plt.figure())
