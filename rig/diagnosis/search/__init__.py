"""The search for what a model lacks: one for every kind of bench."""
