"""A bench of one's own: its signals found in a DBC, its configuration and its first model."""
