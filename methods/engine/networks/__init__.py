"""Networks of time: layers, derivatives, the equation on them, losses, minimisers and least squares."""
