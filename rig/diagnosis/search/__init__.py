"""The search for missing effects, for every kind of bench."""
