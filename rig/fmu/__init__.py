"""A model as a functional mock-up unit (FMI 2.0 and 3.0), and an FMU as a model.

    law_in_c      a law of the catalogue as C, derived from its Python
    component     variables of an FMU of a strut or of a bench, and the C that computes them
    source        the C sources around it
    description   the variables as XML
    binaries      shared libraries, compiled for this system and for others
    archive       all of it in one file
    export        a model file, written as that file
    import_fmu    an FMU from elsewhere, read as a model

Reference: Modelica Association, "Functional Mock-up Interface Specification", 2.0.4 and 3.0.2.
"""
