"""A rigid body on four corners, against Lagrange's equations that share no code with the bench."""

import numpy as np
import pytest
import yaml

from can_dbc.errors import InputError
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig
from rig.simulated_bench.trajectory import simulate
from tests.bridge.full_car import FullCar

RATE_HZ, DURATION_S = 500, 5.0
CAR = FullCar()


def full_car():
    """The car of the tests as a simulated bench; its cubic springs as undeclared effects."""
    tones = ((1.0, 0.9), (0.8, 2.3), (0.5, 4.7))
    effects = []
    struts = [
        {
            "name": f"tyre_{name}",
            "between": ["world", name],
            "free_length_m": CAR.tyre_free_m,
            "spring": line("height_m", CAR.tyre_free_m, CAR.tyre),
            "damper": line("velocity_m_per_s", 0.0, CAR.tyre_damping),
        }
        for name in CAR.corners
    ]
    for name, place in CAR.corners.items():
        struts.append(
            {
                "name": f"suspension_{name}",
                "between": [name, "body"],
                "place_m": list(place),
                "free_length_m": CAR.free_m,
                "spring": line("height_m", CAR.free_m, CAR.stiffness[name]),
                "damper": line("velocity_m_per_s", 0.0, CAR.damping[name]),
            }
        )
        cubic = {"stiffness_n_per_m3": CAR.cubic_n_per_m3[name]}
        effects.append(
            {"name": "cubic_stiffness", "strut": f"suspension_{name}", "parameters": cubic}
        )
    return {
        "name": "full_car",
        "masses": [
            *({"name": name, "mass_kg": CAR.wheel_kg} for name in CAR.corners),
            {
                "name": "body",
                "mass_kg": CAR.body_kg,
                "moments_kg_m2": [CAR.roll_kg_m2, CAR.pitch_kg_m2, CAR.yaw_kg_m2],
            },
        ],
        "struts": struts,
        "undeclared_effects": effects,
        "applied_force": {
            "body": "body",
            "components": [
                {"kind": "sine", "amplitude_n": 1500.0 * a, "frequency_hz": f} for a, f in tones
            ],
        },
    }


def line(key, zero, slope):
    return {key: [zero - 1.0, zero + 1.0], "force_n": [slope, -slope]}


class SuddenCar(FullCar):
    """The same car under a force that does not swell, and whose struts stay vertical."""

    @staticmethod
    def load_n(t):
        return FullCar.load_n(t) / max(min(t, 1.0), 1e-12)

    def _places(self, q):
        (x, y), (rise, pitch, roll) = np.array(list(self.corners.values())).T, q[:3]
        sp, cp, sr, cr = np.sin(pitch), np.cos(pitch), np.sin(roll), np.cos(roll)
        wheels = self.wheel_m + q[3:]
        slopes = np.zeros((4, 7))
        slopes[:, 0], slopes[:, 1] = 1.0, -x * cp - y * sr * sp
        slopes[:, 2] = y * cr * cp
        slopes[np.arange(4), 3 + np.arange(4)] = -1.0
        return wheels, self.body_m + rise - x * sp + y * sr * cp - wheels, slopes


def test_a_car_moves_as_by_lagranges_equations():
    t_s = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    heights, rates, forces = SuddenCar().run(t_s)
    bench = BenchConfig.model_validate(full_car())
    found = simulate(bench, round(t_s[-1] * 1e9), round(1e9 / RATE_HZ))
    stroke = np.ptp(heights, axis=0)
    assert stroke.min() > 0.005
    assert np.abs(found.height_m - heights).max() < 1e-6 * stroke.min()
    assert np.abs(found.velocity_m_per_s - rates).max() < 1e-6
    assert np.abs(found.strut_force_n - forces).max() < 1e-3


def test_vertical_struts_are_those_of_the_model_but_for_the_cosine_of_the_pitch():
    """The model's struts lean: their lengths differ by less than a sensor's noise."""
    t_s = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    leaning, vertical = FullCar(), SuddenCar()
    vertical.load_n = FullCar.load_n
    assert np.abs(leaning.run(t_s)[0] - vertical.run(t_s)[0]).max() < 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"between": ["fl", "rear"]}, "struts.4.between.1 = 'rear', expected"),
        ({"place_m": None}, "struts.4.place_m: expected one, the place on the rigid body"),
        ({"initial_height_m": 0.4}, "struts.4.initial_height_m: expected none of a strut below"),
    ],
)
def test_a_wrong_strut_below_a_rigid_body_is_refused(tmp_path, change, message):
    content = full_car()
    content["struts"][4] |= change
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InputError) as refused:
        load_bench_config(tmp_path / "bench.yaml")
    assert message in str(refused.value)


def test_a_place_without_a_rigid_body_and_too_few_struts_are_refused(tmp_path):
    for change, message in (
        (lambda it: it["struts"][0].update(place_m=[1.0, 0.0]), "struts.0.place_m: expected none"),
        (lambda it: it["struts"].__delitem__(slice(6, 8)), "expected 3 that carry body"),
    ):
        content = full_car() | {"undeclared_effects": []}
        change(content)
        (tmp_path / "bench.yaml").write_text(yaml.safe_dump(content))
        with pytest.raises(InputError, match=message):
            load_bench_config(tmp_path / "bench.yaml")
