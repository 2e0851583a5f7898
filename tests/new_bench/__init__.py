"""A bench of one's own: its proposal and its first model."""
