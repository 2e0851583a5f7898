"""Sensors on a bus without a DBC: found, described by their own objects, and configured."""
