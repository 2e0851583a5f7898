"""Benches for the observers' tables: other masses and natural frequencies."""

import numpy as np
import pyarrow as pa
import yaml

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, parse_model
from rig.bridge.mode_supervisor import Supervision
from rig.bridge.values import Mode, StepInput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import APPLIED_FORCE, HEIGHT
from rig.log.step_columns import LogColumns
from rig.plan.config import CONFIGS
from rig.simulated_bench.schema import BenchConfig
from rig.simulated_bench.trajectory import simulate
from tests.bridge.cores import supervised

STRUT = "strut"
REST_M = 0.4
STROKE_M = 0.02


def bench_content(mass_kg, natural_hz, damping_ratio=0.25):
    """A bench about 0.4 m whose spring hardens by a third and whose damper bends at its knee."""
    content = yaml.safe_load((CONFIGS / "reference_bench.yaml").read_text())
    omega = 2.0 * np.pi * natural_hz
    stiffness, damping = mass_kg * omega**2, 2.0 * damping_ratio * mass_kg * omega
    z = np.linspace(-4.0, 4.0, 33) * STROKE_M
    spring = mass_kg * 9.81 - stiffness * z * (1.0 + (z / STROKE_M) ** 2 / 12.0)
    v = np.linspace(-4.0, 4.0, 33) * STROKE_M * omega
    knee = 0.5 * STROKE_M * omega
    damper = -damping * knee * np.sinh(np.clip(v / knee, -3, 3)) / np.cosh(v / knee / 2.0)
    content["masses"][0]["mass_kg"] = float(mass_kg)
    content["struts"][0] |= {
        "initial_height_m": REST_M,
        "free_length_m": REST_M,
        "spring": {"height_m": (REST_M + z).tolist(), "force_n": spring.tolist()},
        "damper": {"velocity_m_per_s": v.tolist(), "force_n": damper.tolist()},
    }
    content["applied_force"]["components"] = [
        {
            "kind": "sine",
            "amplitude_n": float(share * stiffness * STROKE_M),
            "angular_frequency_rad_per_s": float(times * omega),
        }
        for share, times in ((0.5, 0.31), (0.35, 0.83), (0.3, 1.37))
    ]
    return content, stiffness, damping


def model_text(mass_kg, stiffness, damping):
    """A linear model of it, a quarter too soft and half as much damped."""
    content = yaml.safe_load((MODELS / "reference.yaml").read_text())
    content["skeleton"]["bodies"][0]["mass_kg"] = float(mass_kg)
    soft = 0.75 * stiffness
    content["struts"][0] |= {
        "free_length_m": float(REST_M + mass_kg * 9.81 / soft),
        "stiffness_n_per_m": float(soft),
        "damping_n_s_per_m": float(0.5 * damping),
    }
    return yaml.safe_dump(content)


class Truth:
    """The motion of a bench at a rate, and its model."""

    def __init__(self, mass_kg, natural_hz, rate_hz, duration_s):
        content, stiffness, damping = bench_content(mass_kg, natural_hz)
        self.period_ns = round(1e9 / rate_hz)
        bench = BenchConfig.model_validate(content)
        found = simulate(bench, round(duration_s * 1e9), self.period_ns)
        self.height_m = found.height_m[:, 0]
        self.force_n = found.strut_force_n[:, 0]
        self.applied_n = found.applied_force_n
        self.plant = DartPlant(parse_model(model_text(mass_kg, stiffness, damping), "grid"))
        self.rest_m = REST_M


def follow(truth, heights_m, observer):
    """Steps of an observer that follows heights, as an Arrow table like that of a log."""
    period_ns = truth.period_ns
    stale_s = 100 * period_ns * 1e-9
    supervision = Supervision(stale_after_s=stale_s, safe_after_s=10 * stale_s)
    bench = (
        Channel(0, Role.HEIGHT, HEIGHT, STRUT, "", 0, period_ns),
        Channel(1, Role.INPUT, APPLIED_FORCE, "applied_force", "", -1, period_ns),
    )
    core = supervised(truth.plant, (observer,), supervision, bench)
    state, columns, rows = core.init(0), LogColumns([STRUT], bench), []
    for tick, (height_m, applied_n) in enumerate(zip(heights_m, truth.applied_n, strict=True)):
        t_ns = tick * period_ns
        samples = (Sample(0, float(height_m), t_ns), Sample(1, float(applied_n), t_ns))
        given = StepInput(t_ns, samples)
        state, output, _ = core.step(state, given)
        rows.append((t_ns, int(output.mode), *columns.numbers(given, output)))
    names = ("t_ns", "mode", *columns.names)
    return pa.table(
        {
            name: np.array(column)
            for name, column in zip(names, zip(*rows, strict=True), strict=True)
        }
    )


def judged(truth, steps, first):
    """RMS error of the force over its peak, and share of the 95 % intervals that hold it."""
    mode = steps.column("mode").to_numpy()[first:]
    force_n = steps.column(f"{STRUT}.force_n").to_numpy()[first:]
    std_n = steps.column(f"{STRUT}.force_std_n").to_numpy()[first:]
    missed = force_n - truth.force_n[first : first + len(force_n)]
    # The error counts whether or not it is published as valid.
    if not np.all((mode == Mode.RUNNING) | (mode == Mode.SETTLING)):
        return np.inf, np.nan
    share = float(np.sqrt(np.mean(missed**2)) / np.ptp(truth.force_n[first:]) * 2.0)
    return share, float(np.mean(np.abs(missed) < 1.96 * std_n))
