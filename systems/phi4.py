"""The discrete phi^4 lattice, a chain of bistable oscillators.

    u_n'' = C (u_{n+1} + u_{n-1} - 2 u_n) + 2 (u_n - u_n^3),   n = 1..N

Real field, second order, dimensionless. Site n is entry n - 1 of an array. The ends are free: u_0 = u_1 and
u_{N+1} = u_N. C = 1/h^2 with the lattice spacing h; initial states are functions of x_n, N points evenly spaced on
[-N h/2, N h/2], both ends included.

The wells are at u = +-1. The equation does not change under u -> -u, n -> -n and t -> -t. On free, fixed, periodic and
antiperiodic chains it conserves the energy

    E = sum_n [ v_n^2 / 2 + (u_n^2 - 1)^2 / 2 ] + (C/2) sum over bonds (u_{n+1} - u_n)^2

Source: the paper (see `latticebench.systems`), equation (1) and Table 1; libraries (18)-(21).
"""

from latticebench.systems.lattice import Initial, System, library

NEIGHBOURS = "u[n+1]; u[n-1]; u[n]; u[n]**3"

SYSTEM = System(
    name="phi4",
    title="discrete phi^4",
    equation="C*(u[n+1]+u[n-1]-2*u[n]) + 2*(u[n]-u[n]**3)",
    order=2,
    is_complex=False,
    # The paper does not state the speed v of the kink; 0.5 moves it by about a quarter of the chain in ten time units.
    parameters={"C": 2.0, "v": 0.5},
    initials={
        "kink": Initial(
            u="tanh(x/sqrt(1-v**2))",
            v="-v/sqrt(1-v**2)/cosh(x/sqrt(1-v**2))**2",
        ),
        # Not the paper's: few sites in motion, and all, to see what their number matters.
        "kick": Initial(u="1", v="exp(-x**2)"),
        "wave": Initial(u="cos(pi*x/4)/2"),
    },
    libraries=(
        library("lib1", "u[n+1]+u[n-1]-2*u[n]; (u[n+1]-u[n-1])/2; u[n]; u[n]**3", "paper, Lib(1)"),
        library("lib2", NEIGHBOURS, "paper, Lib(2)"),
        library("lib3", f"{NEIGHBOURS}; u[n+2]; u[n-2]", "paper, Lib(3)"),
        library(
            "lib4",
            f"{NEIGHBOURS}; u[n+1]**2*u[n]; u[n-1]**2*u[n]; u[n+1]*u[n-1]*u[n]; u[n+1]**2*u[n-1]; u[n-1]**2*u[n+1]; "
            "u[n]**2*u[n+1]; u[n]**2*u[n-1]; u[n+1]**3; u[n-1]**3",
            "paper, Lib(4)",
        ),
        library("lib2-even", f"{NEIGHBOURS}; u[n]**2; u[n]**4", "paper, Lib(2) with the even terms of its remark"),
        library("equation", "u[n+1]+u[n-1]-2*u[n]; u[n]; u[n]**3", "the equation's own terms"),
    ),
    source="the paper, equation (1), Table 1",
    conserved="v[n]**2/2 + (u[n]**2-1)**2/2 - C/2*u[n]*(u[n+1]+u[n-1]-2*u[n])",
    half_length="N/(2*sqrt(C))",
    integrator="rk4",
    notes="The paper does not give the kink's speed v; 0.5 is this project's choice.",
)
