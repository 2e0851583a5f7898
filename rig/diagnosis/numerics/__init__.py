"""Numerics of the diagnosis: compiled loops, smoothing, least squares."""
