"""Trials of the diagnosis: recordings with a known effect, and how often it is named."""
