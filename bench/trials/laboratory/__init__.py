"""Recordings as laboratories make them: chains in real units, several effects at once, all kinds of instruments."""

from latticebench.bench.trials.laboratory.making import LabEffect, LabRecording, make_recording

__all__ = ["LabEffect", "LabRecording", "make_recording"]
