"""A restoring-force surface: a table of the force over height and velocity, where no law fits."""

from dart_model.effects.law import Effect, Floats, Parameter

HEIGHTS = 9
"""Rows of the table."""

VELOCITIES = 7
"""Columns of the table."""

FIRST_FORCE = 4
"""Parameters before the table: lowest and highest height, lowest and highest velocity."""


def _surface(
    height_m: float,
    velocity_m_per_s: float,
    lowest_height_m: float,
    highest_height_m: float,
    lowest_velocity_m_per_s: float,
    highest_velocity_m_per_s: float,
    forces_n: Floats,
) -> float:
    row = (height_m - lowest_height_m) / (highest_height_m - lowest_height_m) * (HEIGHTS - 1)
    column = (velocity_m_per_s - lowest_velocity_m_per_s) / (
        highest_velocity_m_per_s - lowest_velocity_m_per_s
    )
    column = column * (VELOCITIES - 1)
    row = min(max(row, 0.0), HEIGHTS - 1.000001)
    column = min(max(column, 0.0), VELOCITIES - 1.000001)
    i = int(row)
    j = int(column)
    x = row - i
    y = column - j
    at = i * VELOCITIES + j
    low = forces_n[at] * (1.0 - y) + forces_n[at + 1] * y
    high = forces_n[at + VELOCITIES] * (1.0 - y) + forces_n[at + VELOCITIES + 1] * y
    return low * (1.0 - x) + high * x


RESTORING_SURFACE = Effect(
    name="restoring_surface",
    family="restoring_surface",
    words="a restoring-force surface (a table of the force over height and velocity)",
    parameters=(
        Parameter("lowest_height_m", "m", -1e4, 1e4, "height of the first row"),
        Parameter("highest_height_m", "m", -1e4, 1e4, "height of the last row"),
        Parameter("lowest_velocity_m_per_s", "m/s", -1e6, 1e6, "velocity of the first column"),
        Parameter("highest_velocity_m_per_s", "m/s", -1e6, 1e6, "velocity of the last column"),
        *(
            Parameter(
                f"force_{i}_{j}_n",
                "N",
                -1e12,
                1e12,
                f"force in row {i}, column {j}",
                group="forces_n",
            )
            for i in range(HEIGHTS)
            for j in range(VELOCITIES)
        ),
    ),
    force=_surface,
    excitation="all combinations of height and velocity that occur in use",
    reference="Masri and Caughey, J. Appl. Mech. 46 (1979), restoring force surface",
    scaled=tuple(range(FIRST_FORCE, FIRST_FORCE + HEIGHTS * VELOCITIES)),
)
