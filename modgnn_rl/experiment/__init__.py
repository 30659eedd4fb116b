"""Whole jobs: settings in, a run folder out."""
