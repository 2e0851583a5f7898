"""Measured data of other programs: foreign tables, bus logs, and runs in their formats."""
