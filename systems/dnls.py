"""The discrete nonlinear Schroedinger lattice (DNLS), focusing.

    i u_n' = -C (u_{n+1} + u_{n-1} - 2 u_n) - |u_n|^2 u_n,   n = 1..N,

so that u_n' = i C (u_{n+1} + u_{n-1} - 2 u_n) + i |u_n|^2 u_n. Complex field, first order, dimensionless. Site n is
entry n - 1 of an array. The ends are free: u_0 = u_1 and u_{N+1} = u_N. C = 1/h^2 with the lattice spacing h; initial
states are functions of x_n, N points evenly spaced on [-N h/2, N h/2], both ends included.

The equation does not change when u is multiplied by a phase, exp(i a). It conserves the norm and the energy

    P = sum_n |u_n|^2,   H = C sum over bonds |u_{n+1} - u_n|^2 - sum_n |u_n|^4 / 2

Source: the paper (see `latticebench.systems`), equation (2) and Table 1; libraries (22)-(24), every coefficient
complex.
"""

from latticebench.systems.lattice import Initial, System, library

NEIGHBOURS = "u[n+1]; u[n-1]; u[n]; abs(u[n])**2*u[n]"
TEN = (
    f"{NEIGHBOURS}; abs(u[n])**2; u[n]**2; conj(u[n])**2; (u[n+1]+u[n-1])/2*u[n]; "
    "abs(u[n])**2*(u[n+1]+u[n-1]); u[n]*(abs(u[n+1])**2+abs(u[n-1])**2)"
)
NINE = f"{NEIGHBOURS}; abs(u[n])**2; abs(u[n+1])**2; abs(u[n-1])**2; abs(u[n+1])**2*u[n+1]; abs(u[n-1])**2*u[n-1]"

# The Ginzburg-Landau lattice has the same libraries.
LIBRARIES = (
    library("four", NEIGHBOURS, "paper, four complex terms", with_imaginary=True),
    library("ten", TEN, "paper, ten complex terms", with_imaginary=True),
    library("nine", NINE, "paper, nine complex terms", with_imaginary=True),
    library(
        "four-next",
        f"{NEIGHBOURS}; u[n+2]; u[n-2]",
        "paper, with next-to-next neighbours",
        with_imaginary=True,
    ),
)

SYSTEM = System(
    name="dnls",
    title="discrete nonlinear Schroedinger",
    equation="i*C*(u[n+1]+u[n-1]-2*u[n]) + i*abs(u[n])**2*u[n]",
    order=1,
    is_complex=True,
    parameters={"C": 2.0},
    initials={"gauss": Initial(u="exp(-x**2)")},
    libraries=(
        *LIBRARIES,
        library(
            "equation",
            "i*(u[n+1]+u[n-1]-2*u[n]); i*abs(u[n])**2*u[n]",
            "the equation's own terms, conservative",
        ),
    ),
    source="the paper, equation (2), Table 1",
    conserved="abs(u[n])**2",
    half_length="N/(2*sqrt(C))",
    integrator="bdf",
)
