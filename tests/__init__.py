"""Tests; a package, because an installed distribution carries another `tests`."""
