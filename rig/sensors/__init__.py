"""Sensors on the bus without a DBC: found, described by their own objects, and set to work."""
