"""The machine: clocks, and what a fixed rate needs of the operating system."""
