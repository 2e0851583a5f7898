"""Measured benches that nobody here made: our figures beside the published ones."""
