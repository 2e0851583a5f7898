"""Physical units as CANopen devices code them.

Reference: CiA 303-2, "Representation of SI units and prefixes": a prefix, a numerator, a
denominator and a reserved byte; the prefix is the power of ten in two's complement. The standard is
sold; the codes here are those that manuals of devices print (V, Ohm, degC, bar, psi, ...), and
between them the SI's units in the SI's own order, which those printed confirm.
"""

_NAMES = {
    0x01: "m",
    0x02: "kg",
    0x03: "s",
    0x05: "K",
    0x10: "rad",
    0x20: "Hz",
    0x21: "N",
    0x22: "Pa",
    0x26: "V",
    0x28: "Ohm",
    0x2D: "degC",
    0x41: "deg",
    0x4B: "g",
    0x4E: "bar",
    0xAB: "psi",
    0xAC: "degF",
}
_PREFIXES = {-9: "n", -6: "u", -3: "m", -2: "c", -1: "d", 0: "", 3: "k", 6: "M"}
_OF_MASS = {"kg": "kgf", "g": "gf"}
"""A scale in units of mass measures the force of that weight."""


def unit_name(code: int) -> str | None:
    """Name of a unit as a DBC has it, from the content of an object such as 6131h.

    Returns:
        Such as ``mm``, ``kN`` or ``m/s``; ``kgf`` for a mass; None if the code is not known.
    """
    exponent = (code >> 24 ^ 0x80) - 0x80
    above, below = code >> 16 & 0xFF, code >> 8 & 0xFF
    if above not in _NAMES or exponent not in _PREFIXES:
        return None
    name = _PREFIXES[exponent] + _NAMES[above]
    if below:
        return f"{name}/{_NAMES[below]}" if below in _NAMES else None
    return _OF_MASS.get(name, name)
