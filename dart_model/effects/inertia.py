"""Inertia the model lacks: a mass with its weight, or an inerter, which has none.

The upper body alone carries both: an inerter between two moving bodies would also act on the lower
one.
"""

from dart_model.effects.law import Effect, Parameter


def _none_beyond_dart() -> float:
    # DART simulates the mass and its weight.
    return 0.0


def _weight_compensation(gravity_m_per_s2: float, inertance_kg: float) -> float:
    # DART simulates the mass with its weight, which an inerter does not have.
    return inertance_kg * gravity_m_per_s2


ADDED_MASS = Effect(
    name="added_mass",
    family="inertia",
    words="inertia (a mass that moves with the upper body)",
    parameters=(Parameter("mass_kg", "kg", -1e9, 1e9, "mass that moves with the upper body"),),
    force=_none_beyond_dart,
    excitation="frequencies above and below the resonance, which distinguish mass and stiffness",
    reference="Featherstone, Rigid Body Dynamics Algorithms (2008), 2.13",
    adds_mass=True,
    linear=True,
    benches=("force_given",),
    shown=("mass_kg",),
)

INERTER = Effect(
    name="inerter",
    family="inertia",
    words="inertia without weight (an inerter)",
    parameters=(
        Parameter(
            "inertance_kg",
            "kg",
            -1e9,
            1e9,
            "added inertia of the upper body, without weight; an inerter if the lower end is fixed",
        ),
    ),
    force=_weight_compensation,
    excitation="frequencies above and below the resonance, which distinguish mass and stiffness",
    reference="Smith, Synthesis of mechanical networks: the inerter, IEEE TAC 47 (2002)",
    adds_mass=True,
    linear=True,
    benches=("force_given",),
    shown=("inertance_kg",),
)
