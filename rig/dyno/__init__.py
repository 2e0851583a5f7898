"""The figures that a damper engineer reads: peak force over peak velocity, friction, gas, energy.

strokes      a record divided into strokes, and like ones into blocks
stroke_force a fit of a block's force, of which every figure is a functional
figures      the figures of a block, and those of the damper over all blocks
characterise from a recording to all of it
report       all of it with the verdict against a band and a master
"""
