"""A run: live, in lockstep, replayed, and changed while it is running."""
