"""Errors of virtual sensors: `python -m tests.observers.sensor_errors [--page]`.

Each bench has equations of its own. The struts under test are 30 % too weak in the model. The model
runs once without observers, driven by its inputs alone, and once with virtual forces.
"""

import argparse
import math
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from dart_model.virtual_sensors import VirtualSensor
from rig.bridge.mode_supervisor import Supervision
from rig.bridge.values import StepInput
from rig.bridge.virtual_sensors import SensorPlace, VirtualSensors
from rig.channels.channel import Sample
from rig.channels.measured_quantities import APPLIED_FORCE
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


def true_forces_n(name, duration_s, t_s):
    """Force of each strut of a shipped bench at times."""
    bench = load_bench_config(CONFIGS / f"{name}_bench.yaml")
    truth = simulate(bench, round(duration_s * 1e9), 500_000)
    return {
        strut.name: np.interp(t_s, truth.t_ns * 1e-9, truth.strut_force_n[:, index])
        for index, strut in enumerate(bench.struts)
    }


def known():
    return {"kind": "none", "noise_std_m": NOISE_M}


def kalman(bandwidth_hz):
    return {"kind": "kalman", "filter": {"bandwidth_hz": bandwidth_hz, "noise_std_m": NOISE_M}}


def on_can(name, title, bandwidth_hz, seat, duration_s, seed):
    """Rows of a bench over CAN: load of each tyre, and acceleration of a point of the body."""
    names = load_plan(CONFIGS / f"{name}.yaml").strut_names
    tyres = [it for it in names if it.startswith("tyre")]
    observers = {it: known() if it in tyres else kalman(bandwidth_hz) for it in names}
    sensors = {f"load_of_{it}": {"force_of": it} for it in tyres}
    sensors["seat"] = {"acceleration_of": "body", "at": [*seat, 0.0]}
    nothing = {it: {"kind": "none"} for it in names}
    t_s, alone = readings(name, nothing, sensors, duration_s, seed)
    _, observed = readings(name, observers, sensors, duration_s, seed)
    forces = true_forces_n(name, duration_s, t_s)
    rows = [
        row_of(
            title,
            f"load of {it.replace('_', ' ')}",
            forces[it],
            alone[f"load_of_{it}.force_n"],
            observed[f"load_of_{it}.force_n"],
            observed[f"{it}.force_std_n"],
        )
        for it in tyres
    ]
    column = "seat.acceleration_m_per_s2"
    truth = accelerations(name, forces)
    std = observed["seat.acceleration_std_m_per_s2"]
    rows.append(
        row_of(title, "acceleration of the seat", truth, alone[column], observed[column], std)
    )
    return rows


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
        """Times, heights and true reactions."""
        t_s, heights = self.heights(duration_s, rate_hz)
        angles = np.array([self._angle_of(height) for height in heights[:, 0].tolist()])
        rates = np.gradient(angles, t_s)
        reactions = [self.reaction_n(*it) for it in zip(t_s.tolist(), angles, rates, strict=True)]
        return t_s, heights, np.array(reactions)

    def _angle_of(self, height):
        along, up = (self.foot_m[i] - self.hinge_m[i] for i in (0, 2))
        reach, foot = self.attachment_m, math.hypot(along, up)
        cosine = (reach**2 + foot**2 - height**2) / (2.0 * reach * foot)
        return math.acos(cosine) + math.atan2(up, along)


def on_arm(bandwidth_hz, duration_s, seed):
    """Row of the arm's pivot, at 1 kHz."""
    arm, period_ns = PivotArm(), 1_000_000
    t_s, heights, truth = arm.motion(duration_s, 1000)
    noise = NOISE_M * np.random.default_rng(seed).standard_normal(len(t_s))
    with tempfile.TemporaryDirectory() as temporary:
        plant = wrong(arm.model(Path(temporary)), SHARE)
    sensor = {"pivot": VirtualSensor(reaction_of="hinge")}
    found = {}
    for kind, observer in (
        ("alone", NoObserver("none")),
        ("observed", KalmanObserver("kalman", ErrorFilter(bandwidth_hz, NOISE_M))),
    ):
        core = supervised(plant, (observer,), Supervision(), channels(1, interval_ns=period_ns))
        estimator = core.estimator
        sensors = VirtualSensors(
            [SensorPlace("reaction_of", -1, True)], estimator.read_model(sensor)
        )
        state, sensed, read = core.init(0), None, np.full((len(t_s), 2), np.nan)
        for tick, (height, t) in enumerate(zip(heights[:, 0] + noise, t_s.tolist(), strict=True)):
            t_ns = tick * period_ns
            drive = bench_sample(1, APPLIED_FORCE, arm.load_n(t), t_ns)
            given = StepInput(t_ns, (Sample(0, float(height), t_ns), drive))
            state, output, _ = core.step(state, given)
            model = estimator.model_of(state.estimator)
            if model is not None and output.struts:
                known_n2 = partial(estimator.force_covariance_n2, state.estimator)
                sensed, read[tick] = sensors.read(sensed, t_ns, model, output.struts, known_n2)
        found[kind] = read[t_s > SETTLED_S]
    true_n = truth[t_s > SETTLED_S]
    alone, (observed, std) = found["alone"][:, 0], found["observed"].T
    return row_of("trailing arm", "reaction in the pivot", true_n, alone, observed, std)


@cache
def rows(duration_s=12.0, seed=1):
    """Rows of all benches."""
    return (
        *on_can("quarter_car_road", "quarter car on a road", 40.0, (0.0, 0.0), duration_s, seed),
        *on_can("four_post", "car on four posts", 30.0, SEAT, duration_s, seed),
        on_arm(15.0, duration_s, seed),
    )


TEXT = """
Virtual sensors are compared with simulated benches that have equations of their own. Suspensions,
or the strut of the arm, have 30 % too little stiffness and damping in the model; everything else in
it is right. *Model alone*: no observers, the model is driven by its inputs (road, posts, force)
alone. *With virtual forces*: the suspensions have noise-aware observers; tyres follow their laws,
and their measured heights are used (`kind: none` with `noise_std_m`). All heights and positions
have 5 µm of white noise. Errors are RMS values in per cent of the deviation of the true signal.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    add_page_option(parser)
    parser.add_argument("--seed", type=int, default=1, help="of the sensors' noise")
    arguments = parser.parse_args()
    found = rows(seed=arguments.seed)
    heads = ("bench", "virtual sensor", "model alone", "with virtual forces", "95 % intervals hold")
    cells = [
        (it.bench, it.sensor, *(f"{100 * x:.2g} %" for x in it[2:4]), f"{100 * it.within:.1f} %")
        for it in found
    ]
    print(table(heads, cells))
    if arguments.page:
        title = "Errors of virtual sensors"
        page = table(heads, cells)
        write_evidence("virtual-sensors", title, TEXT, [page], command_line(), with_load=False)


if __name__ == "__main__":
    main()
