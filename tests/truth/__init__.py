"""Simulated benches with planted effects: a truth that shares no code with what is tested.

Every law, the excitation and the integrator are written here a second time, on purpose with other
formulas than an effect catalogue would hold wherever the literature has several.
"""
