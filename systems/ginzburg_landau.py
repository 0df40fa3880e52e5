"""The discrete complex Ginzburg-Landau lattice (DCGL).

    u_n' = (1 + i) C (u_{n+1} + u_{n-1} - 2 u_n) - (1 - i) |u_n|^2 u_n + u_n

Complex field, first order, dimensionless; C = 1/h^2. It turns with the phase of u; nothing is conserved: the linear term
pumps, the coupling and the cubic term damp. The initial state is a Nozaki-Bekki hole.

Source: the paper, equation (4) and Table 1; the libraries are those of the DNLS lattice, every coefficient complex.
"""

from latticebench.systems.dnls import LIBRARIES
from latticebench.systems.lattice import Initial, System, library

SYSTEM = System(
    name="ginzburg-landau",
    title="discrete complex Ginzburg-Landau",
    equation="(1+i)*C*(u[n+1]+u[n-1]-2*u[n]) - (1-i)*abs(u[n])**2*u[n] + u[n]",
    order=1,
    is_complex=True,
    parameters={"C": 2.0},
    initials={"hole": Initial(u="tanh(x)*exp(i*log(cosh(x)))")},
    libraries=(
        *LIBRARIES,
        library(
            "equation",
            "u[n+1]+u[n-1]-2*u[n]; u[n]; abs(u[n])**2*u[n]",
            "the equation's own terms",
            with_imaginary=True,
        ),
    ),
    source="the paper, equation (4), Table 1",
    half_length="N/(2*sqrt(C))",
    integrator="bdf",
)
