"""A run put together: configuration, bus, clock, bridge and log."""
