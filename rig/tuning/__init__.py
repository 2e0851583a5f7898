"""Observer gains from what a recording, or its user, says of noise and residual force.

expectation   noise and residual force of a strut: from a run, or as stated
latency       how much later a height comes than it is true, from a run
gains         gains with the smallest expected error of the force
command       `rig tune` but for its words
"""
