"""A model as a functional mock-up unit (FMI 2.0 and 3.0), for programs that know nothing of rig.

    law_in_c      a law of the catalogue as C, from the one place where it is written
    component     what an FMU of a strut or of a bench has: variables, and the C that computes them
    source        the C around it
    description   the same as XML
    binaries      the C, compiled for other systems than this one too
    archive       all of it in one file
    exported      a model file, written as that file

Reference: Modelica Association, "Functional Mock-up Interface Specification", 2.0.4 and 3.0.2.
"""
