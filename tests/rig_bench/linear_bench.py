"""A bench of one mass on a linear spring and damper, whose motion has a closed form."""

from typing import Any

from rig.simulated_bench.schema import BenchConfig

MASS_KG = 2.0
STIFFNESS_N_PER_M = 800.0
DAMPING_N_S_PER_M = 12.0
FREE_LENGTH_M = 0.5


def linear_strut(
    stiffness_n_per_m: float = STIFFNESS_N_PER_M,
    damping_n_s_per_m: float = DAMPING_N_S_PER_M,
    **more: Any,
) -> dict[str, Any]:
    return {
        "name": "strut",
        "between": ["world", "body"],
        "free_length_m": FREE_LENGTH_M,
        "spring": {
            "height_m": [0.0, 0.3, 0.4, 1.0],
            "force_n": [stiffness_n_per_m * (FREE_LENGTH_M - h) for h in (0.0, 0.3, 0.4, 1.0)],
        },
        "damper": {
            "velocity_m_per_s": [-1.0, 1.0],
            "force_n": [damping_n_s_per_m, -damping_n_s_per_m],
        },
        **more,
    }


def linear_bench(
    *,
    strut: dict[str, Any] | None = None,
    components: tuple[dict[str, Any], ...] = (),
    effects: tuple[dict[str, Any], ...] = (),
    **more: Any,
) -> BenchConfig:
    """Build the bench; `more` are further keys of the configuration."""
    return BenchConfig.model_validate(
        {
            "name": "linear",
            "masses": [{"name": "body", "mass_kg": MASS_KG}],
            "struts": [linear_strut() if strut is None else strut],
            "applied_force": {"body": "body", "components": list(components)},
            "undeclared_effects": [
                {"name": name, "strut": "strut", "parameters": parameters}
                for effect in effects
                for name, parameters in effect.items()
            ],
            **more,
        }
    )
