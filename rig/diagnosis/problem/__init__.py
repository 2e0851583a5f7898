"""A model held against recordings: one contract, two kinds of bench."""
