"""Errors of virtual sensors: `python -m tests.observers.sensor_errors [--page]`.

Each bench has equations of its own. The struts under test are 30 % too weak in the model. The model
runs once without observers, driven by its inputs alone, and once with virtual forces.
"""

import argparse
import math
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from dart_model.virtual_sensors import VirtualSensor
from rig.bridge.mode_supervisor import Supervision
from rig.bridge.motion_errors import MotionErrorTracker, block_for
from rig.bridge.values import StepInput
from rig.bridge.virtual_sensors import SensorPlace, VirtualSensors
from rig.channels.channel import Sample
from rig.channels.measured_quantities import APPLIED_FORCE
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.noise_response import motion_by_noise
from rig.formats.run_arrays import open_run
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.observers.none import NoObserver
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig
from rig.simulated_bench.trajectory import simulate
from tests.bridge.cores import bench_sample, channels, supervised
from tests.bridge.test_larger_systems import wrong
from tests.diagnosis.mechanisms import GRAVITY, TrailingArm
from tests.evidence import add_page_option, command_line, table, write_evidence

SHARE, NOISE_M, SETTLED_S = 0.7, 5e-6, 2.0
SEAT = (0.4, 0.35)
"""Of the body of the car on posts, forwards and to the left of its centre, in m."""
POINTS = {"fl": (1.25, 0.75), "fr": (1.25, -0.75), "rl": (-1.35, 0.75), "rr": (-1.35, -0.75)}
BODY_KG, ROLL_KG_M2, PITCH_KG_M2 = 1400.0, 520.0, 1900.0


class Row(NamedTuple):
    """Errors of a virtual sensor.

    Attributes:
        alone: RMS error of the model without observers over the signal's deviation.
        observed: The same with virtual forces.
        within: Share of the 95 % intervals that hold the true value.
    """

    bench: str
    sensor: str
    alone: float
    observed: float
    within: float


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def row_of(bench, sensor, truth, alone, observed, std):
    """Row of a sensor's true values, readings without and with observers, and their deviations."""
    missed = observed - truth
    within = float(np.mean(np.abs(missed) < 1.96 * std))
    return Row(
        bench, sensor, rms(alone - truth) / np.std(truth), rms(missed) / np.std(truth), within
    )


# --- benches over virtual CAN ---------------------------------------------------------------------


def readings(name, observers, sensors, duration_s, seed):
    """Times and columns of a run of a shipped bench; the model's suspensions are too weak."""
    config = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
    config |= {"observers": observers, "virtual_sensors": sensors}
    for key in ("dbc", "model"):
        if key in config and Path(str(config[key])).suffix:
            config[key] = str(CONFIGS / config[key])
    bench = load_bench_config(CONFIGS / f"{name}_bench.yaml")
    bench = BenchConfig.model_validate(bench.model_dump(mode="python") | {"seed": seed})
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "rig.yaml"
        path.write_text(yaml.safe_dump(config))
        plan = load_plan(path, duration_s=duration_s)
        weak = [it for it in plan.strut_names if it.startswith("suspension")]
        plan = plan.with_model(wrong(plan.model, SHARE, weak).spec)
        with_bench(plan, bench, Path(temporary) / "run", lockstep=True)
        run = open_run(Path(temporary) / "run")
        counts = run.t_s > SETTLED_S
        return run.t_s[counts], {key: run.columns[key][counts] for key in run.columns}


class Truth(NamedTuple):
    """Force, height and rate of each strut of a shipped bench at times."""

    force_n: dict
    height_m: dict
    velocity_m_per_s: dict


def true_motion(name, duration_s, t_s):
    """Truth of a shipped bench at times."""
    bench = load_bench_config(CONFIGS / f"{name}_bench.yaml")
    truth = simulate(bench, round(duration_s * 1e9), 500_000)

    def at(columns):
        each = zip(bench.struts, columns.T, strict=True)
        return {it.name: np.interp(t_s, truth.t_ns * 1e-9, column) for it, column in each}

    return Truth(at(truth.strut_force_n), at(truth.height_m), at(truth.velocity_m_per_s))


def known():
    return {"kind": "none", "noise_std_m": NOISE_M}


def kalman(bandwidth_hz):
    return {"kind": "kalman", "filter": {"bandwidth_hz": bandwidth_hz, "noise_std_m": NOISE_M}}


def on_can(name, title, bandwidth_hz, motions, seat, duration_s, seed):
    """Rows of a bench over CAN: load of each tyre, and motions of the body."""
    names = load_plan(CONFIGS / f"{name}.yaml").strut_names
    tyres = [it for it in names if it.startswith("tyre")]
    observers = {it: known() if it in tyres else kalman(bandwidth_hz) for it in names}
    sensors = {f"load of {it.replace('_', ' ')}": {"force_of": it} for it in tyres}
    sensors["acceleration of the seat"] = {"acceleration_of": "body", "at": [*seat, 0.0]}
    sensors |= {title: sensor for title, (sensor, _) in motions.items()}
    columns = {it.replace(" ", "_"): sensor for it, sensor in sensors.items()}
    nothing = {it: {"kind": "none"} for it in names}
    t_s, alone = readings(name, nothing, columns, duration_s, seed)
    _, observed = readings(name, observers, columns, duration_s, seed)
    truth = true_motion(name, duration_s, t_s)
    true = {f"load of {it.replace('_', ' ')}": truth.force_n[it] for it in tyres}
    true["acceleration of the seat"] = accelerations(name, truth.force_n)
    true |= {title: of_truth(truth) for title, (_, of_truth) in motions.items()}
    rows = []
    for sensor, values in true.items():
        column, std = columns_of(sensor.replace(" ", "_"), observed)
        rows.append(row_of(title, sensor, values, alone[column], observed[column], observed[std]))
    return rows


def columns_of(sensor, columns):
    """Columns of a sensor's value and of its standard deviation; of a strut's force that of it."""
    own = [it for it in columns if it.partition(".")[0] == sensor]
    std = [it for it in own if "_std_" in it]
    return next(it for it in own if it not in std), std[0]


ON_A_ROAD = {
    "position of the body": (
        {"position_of": "body"},
        lambda truth: sum(truth.height_m.values()),
    ),
    "velocity of the body": (
        {"velocity_of": "body"},
        lambda truth: sum(truth.velocity_m_per_s.values()),
    ),
    "velocity of the wheel": (
        {"velocity_of": "wheel"},
        lambda truth: truth.velocity_m_per_s["shaker"] + truth.velocity_m_per_s["tyre"],
    ),
}
"""Motions of the quarter car: sensor, and its true values."""


def roll(each):
    """Of the body, by motions of its struts."""
    up = {it: sum(each[f"{part}_{it}"] for part in ("post", "tyre", "suspension")) for it in POINTS}
    return (up["fl"] + up["rl"] - up["fr"] - up["rr"]) / (4.0 * POINTS["fl"][1])


ON_POSTS = {
    "roll angle": (
        {"angle_of": "body", "axis": [1, 0, 0]},
        lambda truth: roll(truth.height_m),
    ),
    "roll rate": (
        {"rate_of": "body", "axis": [1, 0, 0]},
        lambda truth: roll(truth.velocity_m_per_s),
    ),
}
"""Motions of the car on posts."""


def accelerations(name, forces):
    """True accelerations of the point, by Newton's and Euler's equations for small angles."""
    if name != "four_post":
        body_kg = {it.name: it.mass_kg for it in bench_masses(name)}["body"]
        return forces["suspension"] / body_kg - GRAVITY
    each = {corner: forces[f"suspension_{corner}"] for corner in POINTS}
    heave = sum(each.values()) / BODY_KG - GRAVITY
    pitch = sum(-x * each[corner] for corner, (x, _) in POINTS.items()) / PITCH_KG_M2
    roll = sum(y * each[corner] for corner, (_, y) in POINTS.items()) / ROLL_KG_M2
    return heave - SEAT[0] * pitch + SEAT[1] * roll


def bench_masses(name):
    return load_bench_config(CONFIGS / f"{name}_bench.yaml").masses


# --- an arm on a pivot ----------------------------------------------------------------------------


class PivotArm(TrailingArm):
    """The arm, with the vertical force that its pivot exerts on it, by Newton's equations."""

    def reaction_n(self, t_s, angle, rate):
        height, slope = self.length(angle)
        strut_n = -self.stiffness * (height - self.free_m) - self.damping * slope * rate
        inertia = self.arm_kg_m2 + self.arm_kg * self.arm_centre_m**2
        inertia += self.hub_kg_m2 + self.hub_kg * self.hub_m**2
        turning = self.moment_n_m(angle, rate, self.load_n(t_s)) / inertia
        lever = self.arm_kg * self.arm_centre_m + self.hub_kg * self.hub_m
        needed = lever * (turning * math.cos(angle) - rate**2 * math.sin(angle))
        needed += (self.arm_kg + self.hub_kg) * GRAVITY
        above = self.hinge_m[2] + self.attachment_m * math.sin(angle) - self.foot_m[2]
        return needed - self.load_n(t_s) - strut_n * above / height

    def motion(self, duration_s, rate_hz):
        """Times, heights, and true angles, rates and reactions."""
        t_s, heights = self.heights(duration_s, rate_hz)
        angles = np.array([self._angle_of(height) for height in heights[:, 0].tolist()])
        rates = np.gradient(angles, t_s)
        reactions = [self.reaction_n(*it) for it in zip(t_s.tolist(), angles, rates, strict=True)]
        return t_s, heights, np.array([angles, rates, reactions])

    def _angle_of(self, height):
        along, up = (self.foot_m[i] - self.hinge_m[i] for i in (0, 2))
        reach, foot = self.attachment_m, math.hypot(along, up)
        cosine = (reach**2 + foot**2 - height**2) / (2.0 * reach * foot)
        return math.acos(cosine) + math.atan2(up, along)


ON_ARM = {
    "angle of the arm": (VirtualSensor(coordinate_of="hinge"), "height"),
    "rate of the arm": (VirtualSensor(speed_of="hinge"), "rate"),
    "reaction in the pivot": (VirtualSensor(reaction_of="hinge"), "force"),
}
"""Sensors of the arm, and what they are known by."""


def on_arm(bandwidth_hz, duration_s, seed):
    """Rows of the arm, at 1 kHz."""
    arm, period_ns = PivotArm(), 1_000_000
    t_s, heights, truth = arm.motion(duration_s, 1000)
    noise = NOISE_M * np.random.default_rng(seed).standard_normal(len(t_s))
    with tempfile.TemporaryDirectory() as temporary:
        plant = wrong(arm.model(Path(temporary)), SHARE)
    read = {it: sensor for it, (sensor, _) in ON_ARM.items()}
    places = [SensorPlace(sensor.kind, -1, known_by) for sensor, known_by in ON_ARM.values()]
    found = {}
    for kind, observer in (
        ("alone", NoObserver("none")),
        ("observed", KalmanObserver("kalman", ErrorFilter(bandwidth_hz, NOISE_M))),
    ):
        core = supervised(plant, (observer,), Supervision(), channels(1, interval_ns=period_ns))
        estimator = core.estimator
        struts, corners = ((), ()) if kind == "alone" else ((0,), (2.0 * math.pi * bandwidth_hz,))
        block = block_for(corners, (period_ns,))
        reader, tracker = estimator.read_model(read), None
        if struts:
            timing = SampleTiming.of(period_ns, period_ns, 0)
            by_noise = motion_by_noise(plant, (observer,), heights[0], timing, struts)
            of_motions = (0, 1), struts, struts, (False, True)
            tracker = MotionErrorTracker(reader, *of_motions, block, by_noise)
        sensors = VirtualSensors(places, reader, tracker)
        state, sensed, values = core.init(0), None, np.full((len(t_s), 2 * len(read)), np.nan)
        for tick, (height, t) in enumerate(zip(heights[:, 0] + noise, t_s.tolist(), strict=True)):
            t_ns = tick * period_ns
            drive = bench_sample(1, APPLIED_FORCE, arm.load_n(t), t_ns)
            given = StepInput(t_ns, (Sample(0, float(height), t_ns), drive))
            state, output, _ = core.step(state, given)
            now = state.estimator
            if estimator.model_of(now) is not None and output.struts:
                sensed, values[tick] = sensors.read(sensed, t_ns, estimator, now, output.struts)
        found[kind] = values[t_s > SETTLED_S].T
    return [
        row_of("trailing arm", sensor, values[t_s > SETTLED_S], alone, observed, std)
        for sensor, values, alone, observed, std in zip(
            read,
            truth,
            found["alone"][::2],
            found["observed"][::2],
            found["observed"][1::2],
            strict=True,
        )
    ]


@cache
def rows(duration_s=12.0, seed=1):
    """Rows of all benches."""
    return (
        *on_can(
            "quarter_car_road",
            "quarter car on a road",
            40.0,
            ON_A_ROAD,
            (0.0, 0.0),
            duration_s,
            seed,
        ),
        *on_can("four_post", "car on four posts", 30.0, ON_POSTS, SEAT, duration_s, seed),
        *on_arm(15.0, duration_s, seed),
    )


TEXT = """
Virtual sensors are compared with simulated benches that have equations of their own. Suspensions,
or the strut of the arm, have 30 % too little stiffness and damping in the model; everything else in
it is right. *Model alone*: no observers, the model is driven by its inputs (road, posts, force)
alone. *With virtual forces*: the suspensions have noise-aware observers; tyres follow their laws,
and their measured heights are used (`kind: none` with `noise_std_m`). All heights and positions
have 5 µm of white noise. Errors are RMS values in per cent of the deviation of the true signal; a
model whose springs are too weak also sags, which its positions and angles show.
"""


def percent(share):
    """Per cent with two digits, and no exponent."""
    return f"{float(f'{100 * share:.2g}'):g}"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add_page_option(parser)
    parser.add_argument("--seed", type=int, default=1, help="of the sensors' noise")
    arguments = parser.parse_args()
    found = rows(seed=arguments.seed)
    heads = ("bench", "virtual sensor", "model alone", "with virtual forces", "95 % intervals hold")
    cells = [
        (it.bench, it.sensor, *(f"{percent(x)} %" for x in it[2:4]), f"{100 * it.within:.1f} %")
        for it in found
    ]
    print(table(heads, cells))
    if arguments.page:
        title = "Errors of virtual sensors"
        page = table(heads, cells)
        write_evidence("virtual-sensors", title, TEXT, [page], command_line(), with_load=False)


if __name__ == "__main__":
    main()
