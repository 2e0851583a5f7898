"""A bench that prescribes a strut's motion: the motion is exact, and the force is the law's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from can_dbc.codec import compile_decoder
from can_dbc.database import DEFAULT_DATABASE, load_database
from can_dbc.errors import InputError
from can_dbc.units import Dimension
from rig.plan.config import CONFIGS
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig
from rig.simulated_bench.trajectory import simulate
from tests.rig_bench.linear_bench import linear_strut

STIFFNESS_N_PER_M, DAMPING_N_S_PER_M, LENGTH_M = 5000.0, 200.0, 0.5
SECOND_NS = 1_000_000_000


def dyno(components: list[dict[str, Any]], **more: Any) -> BenchConfig:
    strut = {
        "name": "strut",
        "between": ["world", "body"],
        "free_length_m": LENGTH_M,
        "spring": {
            "height_m": [0.4, 0.6],
            "force_n": [0.1 * STIFFNESS_N_PER_M, -0.1 * STIFFNESS_N_PER_M],
        },
        "damper": {
            "velocity_m_per_s": [-1.0, 1.0],
            "force_n": [DAMPING_N_S_PER_M, -DAMPING_N_S_PER_M],
        },
    }
    return BenchConfig.model_validate(
        {
            "name": "dyno",
            "masses": [{"name": "body", "mass_kg": 3.0}],
            "struts": [strut],
            "prescribed_motion": {
                "strut": "strut",
                "mean_height_m": LENGTH_M,
                "components": components,
            },
            **more,
        }
    )


SINE = {"kind": "sine", "amplitude_m": 0.02, "frequency_hz": 2.0, "phase_rad": 0.3}


def test_a_sine_is_followed_exactly_and_the_cell_reads_spring_and_damper() -> None:
    motion = simulate(dyno([SINE]), SECOND_NS)
    t_s = motion.t_ns * 1e-9
    phase = 4.0 * np.pi * t_s + 0.3
    deflection_m, rate = 0.02 * np.sin(phase), 0.02 * 4.0 * np.pi * np.cos(phase)
    np.testing.assert_allclose(motion.height_m[:, 0], LENGTH_M + deflection_m, atol=1e-14)
    np.testing.assert_allclose(motion.velocity_m_per_s[:, 0], rate, atol=1e-12)
    force_n = -STIFFNESS_N_PER_M * deflection_m - DAMPING_N_S_PER_M * rate
    np.testing.assert_allclose(motion.strut_force_n[:, 0], force_n, atol=1e-9)
    assert not motion.applied_force_n.any()


@pytest.mark.parametrize(
    "component",
    [
        {"kind": "multisine", "rms_m": 0.01, "low_hz": 0.5, "high_hz": 8.0, "lines": 12, "seed": 4},
        {"kind": "sweep", "amplitude_m": 0.01, "start_hz": 0.5, "end_hz": 9.0, "duration_s": 0.6},
        {
            "kind": "sweep",
            "amplitude_m": 0.01,
            "start_hz": 0.5,
            "end_hz": 9.0,
            "duration_s": 0.6,
            "spacing": "logarithmic",
        },
    ],
)
def test_velocity_is_the_derivative_of_height(component: dict[str, Any]) -> None:
    motion = simulate(dyno([component]), SECOND_NS, 100_000)
    height_m, rate = motion.height_m[:, 0], motion.velocity_m_per_s[:, 0]
    assert np.std(height_m) > 0.003
    numeric = (height_m[2:] - height_m[:-2]) / 2e-4
    away = np.abs(motion.t_ns[1:-1] - 600_000_000) > 200_000
    np.testing.assert_allclose(rate[1:-1][away], numeric[away], atol=1e-4)


def test_a_sweep_stays_where_it_ends() -> None:
    sweep = {
        "kind": "sweep",
        "amplitude_m": 0.01,
        "start_hz": 1.0,
        "end_hz": 4.0,
        "duration_s": 0.5,
    }
    motion = simulate(dyno([sweep]), SECOND_NS)
    after = motion.t_ns >= 500_000_000
    # 1.25 turns in all.
    np.testing.assert_allclose(motion.height_m[after, 0], LENGTH_M + 0.01, atol=1e-12)
    assert not motion.velocity_m_per_s[after, 0].any()


def test_a_file_is_a_spline_through_its_samples_and_still_outside(tmp_path: Path) -> None:
    t_s = np.arange(0.2, 0.8001, 0.01)
    height_m = 0.5 + 0.02 * np.sin(2.0 * np.pi * 3.0 * (t_s - 0.2))
    lines = [f"{t:.4f},{z:.12f}\n" for t, z in zip(t_s, height_m, strict=True)]
    (tmp_path / "motion.csv").write_text("t_s,height_m\n" + "".join(lines))
    config = BenchConfig.model_validate(
        {
            **dyno([SINE]).model_dump(),
            "prescribed_motion": {
                "strut": "strut",
                "components": [{"kind": "file", "path": "motion.csv"}],
            },
        },
        context=tmp_path,
    )
    motion = simulate(config, SECOND_NS)
    t, z, v = motion.t_ns * 1e-9, motion.height_m[:, 0], motion.velocity_m_per_s[:, 0]
    inside = (t >= 0.2) & (t <= 0.8)
    phase = 2.0 * np.pi * 3.0 * (t - 0.2)
    np.testing.assert_allclose(z[inside], 0.5 + 0.02 * np.sin(phase[inside]), atol=2e-6)
    slope = 0.02 * 6.0 * np.pi * np.cos(phase[inside])
    np.testing.assert_allclose(v[inside], slope, atol=2e-3)
    assert not v[~inside].any()
    np.testing.assert_allclose(z[t < 0.2], 0.5, atol=1e-12)


def test_bodies_above_an_prescribed_strut_move_by_their_own_laws() -> None:
    """A mass on a linear strut on a shaken ground: closed form of base excitation."""
    mass_kg, stiffness, damping, omega = 2.0, 800.0, 12.0, 2.0 * np.pi * 1.5
    config = BenchConfig.model_validate(
        {
            "name": "shaken",
            "gravity_m_per_s2": 0.0,
            "masses": [{"name": "table", "mass_kg": 9.0}, {"name": "body", "mass_kg": mass_kg}],
            "struts": [
                {**dyno([SINE]).struts[0].model_dump(), "between": ["world", "table"]},
                {
                    **linear_strut(),
                    "name": "upper",
                    "between": ["table", "body"],
                    "free_length_m": 0.4,
                    "spring": {
                        "height_m": [0.3, 0.5],
                        "force_n": [0.1 * stiffness, -0.1 * stiffness],
                    },
                    "damper": {"velocity_m_per_s": [-1.0, 1.0], "force_n": [damping, -damping]},
                    "initial_height_m": 0.4,
                },
            ],
            "prescribed_motion": {
                "strut": "strut",
                "mean_height_m": 0.5,
                "components": [{"kind": "sine", "amplitude_m": 0.01, "frequency_hz": 1.5}],
            },
        }
    )
    motion = simulate(config, 6 * SECOND_NS)
    settled = motion.t_ns > 4 * SECOND_NS
    t_s = motion.t_ns[settled] * 1e-9
    response = mass_kg * omega**2 / (stiffness - mass_kg * omega**2 + 1j * omega * damping)
    expected = 0.01 * np.imag(response * np.exp(1j * omega * t_s))
    stretch_m = motion.height_m[settled, 1] - 0.4
    np.testing.assert_allclose(stretch_m, expected, atol=1e-7)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            {
                "undeclared_effects": [
                    {"name": "added_mass", "strut": "strut", "parameters": {"mass_kg": 1.0}}
                ]
            },
            "does not change the force",
        ),
        (
            {"prescribed_motion": {"strut": "other", "components": [SINE]}},
            "prescribed_motion.strut = 'other', expected strut",
        ),
        (
            {"prescribed_motion": {"strut": "strut", "components": [{**SINE, "amplitude_n": 1.0}]}},
            "amplitude_n",
        ),
        (
            {
                "applied_force": {
                    "components": [{"kind": "sine", "amplitude_n": 1.0, "frequency_hz": 1.0}]
                }
            },
            "body is missing",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(more: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words.replace(".", r"\.")):
        dyno([SINE], **more)


def test_a_height_at_the_start_and_an_prescribed_motion_contradict(tmp_path: Path) -> None:
    text = (CONFIGS / "dyno_bench.yaml").read_text()
    path = tmp_path / "dyno.yaml"
    path.write_text(
        text.replace("free_length_m: 0.3", "free_length_m: 0.3\n    initial_height_m: 0.31")
    )
    with pytest.raises(InputError, match="expected none: its motion is prescribed"):
        load_bench_config(path)


def test_the_shipped_dyno_sends_height_and_cell_in_one_frame() -> None:
    database = load_database(DEFAULT_DATABASE)
    message = database.message("DYNO_MEASUREMENT")
    config = load_bench_config(CONFIGS / "dyno_bench.yaml")
    frames, _ = SimulatedBench(config, database).update(SECOND_NS)
    decode = compile_decoder(
        message, ["HEIGHT", "STRUT_FORCE"], [Dimension.LENGTH, Dimension.FORCE]
    )
    sent = [frame for frame in frames if frame.arbitration_id == message.arbitration_id]
    assert len(sent) == 1001
    measured = np.array([decode(frame.data) for frame in sent])
    truth = simulate(config, SECOND_NS)
    assert np.abs(measured[:, 0] - truth.height_m[:, 0]).max() <= 1.0001e-7
    assert np.std(measured[:, 1] - truth.strut_force_n[:, 0]) == pytest.approx(0.5, rel=0.1)
