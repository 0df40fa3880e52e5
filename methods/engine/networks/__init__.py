"""Networks whose input is time: their layers and derivatives, the equation on them, losses, minimisers and least squares."""
