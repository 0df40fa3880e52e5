"""What is missing: looks at what a fitted equation leaves of a recording, and names the effect that it lacks."""
