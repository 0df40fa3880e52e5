"""The command line: one file per command; `main` runs it."""

from latticebench.bench.cli.app import main

__all__ = ["main"]
