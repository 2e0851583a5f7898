"""The simulated bench: its own equations of motion, curves and integrator."""
