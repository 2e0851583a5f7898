"""The quantities of a bench, and the channels that carry them."""
