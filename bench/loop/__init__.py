"""The loop: fit a declared equation, find the residual, trace it to an effect, add that effect, and report."""
