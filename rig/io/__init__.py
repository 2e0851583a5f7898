"""The outside world: bus, clock and run log."""
