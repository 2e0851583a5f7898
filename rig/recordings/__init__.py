"""Recordings of a bench: what was measured in a run, read from where it was logged, and checked."""
