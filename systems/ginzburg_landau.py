"""The discrete complex Ginzburg-Landau lattice (DCGL).

    u_n' = (1 + i) C (u_{n+1} + u_{n-1} - 2 u_n) - (1 - i) |u_n|^2 u_n + u_n,   n = 1..N

Complex field, first order, dimensionless. Site n is entry n - 1 of an array. The ends are free: u_0 = u_1 and
u_{N+1} = u_N. C = 1/h^2 with the lattice spacing h; initial states are functions of x_n, N points evenly spaced on
[-N h/2, N h/2], both ends included.

The equation does not change when u is multiplied by a phase, exp(i a). Nothing is conserved: the linear term pumps, the
coupling and the cubic term damp. The initial state is a Nozaki-Bekki hole.

Source: the paper (see `latticebench.systems`), equation (4) and Table 1; the libraries are those of the DNLS lattice,
every coefficient complex.
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
