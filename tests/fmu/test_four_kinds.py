"""FMI 2.0 and 3.0, Model Exchange and Co-Simulation, under FMPy, against the plant."""

import itertools
import math

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from can_dbc.errors import InputError
from dart_model.effects import CATALOGUE
from dart_model.plant import DartPlant, PrescribedStrut
from dart_model.plant.equations_of_motion import count_steps
from dart_model.spec import MODELS, EffectSpec, load_model
from dart_model.virtual_sensors import VirtualSensor
from rig.fmu.component import bench_component, strut_component
from tests.fmu.driver import simulated, stepped, written
from tests.fmu.specimens import DISPLACED_M, with_effects, worth

KINDS = list(itertools.product(("2.0", "3.0"), ("CoSimulation", "ModelExchange")))
DURATION_S, STEP_S, SHORT_S = 1.0, 1e-3, 2e-5
"""Steps of a master, and those that are short enough where a law switches within one."""

QUICK = {"backlash", "bouc_wen"}
LAWS = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.long)
    for name in sorted(CATALOGUE)
]


def let_go(spec, longest_s):
    """Heights at every millisecond of a mass that is let go, in equal steps."""
    plant = DartPlant(spec)
    step_s = STEP_S / count_steps(STEP_S, min(longest_s, plant.step_s))
    state = plant.init([DISPLACED_M])
    heights = [DISPLACED_M]
    every = round(STEP_S / step_s)
    for k in range(round(DURATION_S / step_s)):
        state = plant.step(plant.load(state, (0.0,), (0.0,), 20.0), step_s, (0.0,))
        if (k + 1) % every == 0:
            heights.append(state.struts[0][0])
    return np.array(heights)


def fmu_let_go(folder, spec, version, kind):
    path = written(folder, bench_component(spec), version, spec)
    assert validate_fmu(str(path)) == []
    starts = {"strut.height_m": DISPLACED_M}
    return simulated(path, kind, starts, "strut.height_m", DURATION_S, STEP_S)


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_every_law_on_a_bench_moves_it_as_the_plant_does(tmp_path, name):
    """Co-Simulation has the plant's own integrator, whose shortest steps it takes throughout; CVode
    is beyond both, so that the plant is given steps that are short beside its switches."""
    spec = with_effects(name)
    heights = {"CoSimulation": let_go(spec, STEP_S), "ModelExchange": let_go(spec, SHORT_S)}
    amplitude = np.ptp(heights["CoSimulation"])
    assert amplitude > 1e-3
    for version, kind in KINDS:
        ours, _ = fmu_let_go(tmp_path, spec, version, kind)
        reach = 1e-10 if kind == "CoSimulation" else 1e-6
        assert np.abs(ours - heights[kind]).max() < reach * amplitude, (version, kind)


BRISTLES = {"elastoplastic_friction", "lugre_friction", "presliding_friction"}
"""Laws that turn within a few µm: within 20 µs at the speed of the motion below."""


@pytest.mark.slow
@pytest.mark.parametrize("name", LAWS)
def test_every_law_as_a_strut_gives_the_force_of_the_plant(tmp_path, name):
    """Under a motion that is prescribed; in steps that are short, since both round the sine off."""
    spec = with_effects(name)
    (strut,) = spec.struts
    t_s = np.arange(0.0, 0.11, 2e-5)
    height, speed = np.array([sine(at_s) for at_s in t_s]).T
    theirs = prescribed_force(spec, t_s)
    reach = 1e-4 if name in BRISTLES else 1e-6 if CATALOGUE[name].state_size else 1e-12
    for version in ("2.0", "3.0"):
        path = written(tmp_path, strut_component(spec, strut), version, spec)
        assert validate_fmu(str(path)) == []
        inputs = {"height_m": height, "velocity_m_per_s": speed}
        ours = stepped(path, t_s, inputs, ["force_n"])["force_n"]
        assert np.abs(ours - theirs).max() < reach * np.ptp(theirs), version


def sine(t_s):
    return 0.3 + 0.06 * math.sin(60.0 * t_s), 3.6 * math.cos(60.0 * t_s)


def prescribed_force(spec, t_s):
    strut = PrescribedStrut(spec)
    state = strut.init(0.0)
    forces = []
    for before_s, at_s in itertools.pairwise([0.0, *t_s]):
        for k in range(10):
            begin_s = before_s + (at_s - before_s) * k / 10
            state = strut.step(state, begin_s + (at_s - before_s) / 10, sine, 20.0)
        forces.append(strut.force_n(state, *sine(at_s), 20.0))
    return np.array(forces)


def corrected_quarter_car():
    """The quarter car with the laws that a diagnosis finds on its bench."""
    spec = load_model(MODELS / "quarter_car.yaml")
    tyre, suspension = spec.struts
    law = CATALOGUE["digressive_damping"]
    found = (
        EffectSpec(name="progressive_stiffness", parameters={"force_n": 30.0, "length_m": 0.04}),
        EffectSpec(name=law.name, parameters=law.named(worth(law))),
    )
    suspension = suspension.model_copy(update={"effects": found})
    return spec.model_copy(update={"name": "corrected", "struts": (tyre, suspension)})


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_strut_of_a_quarter_car_gives_its_force(tmp_path, version):
    """Height and velocity as they are in the vehicle, on a wavy road of force."""
    spec = corrected_quarter_car()
    plant = DartPlant(spec)
    state = plant.init([float("nan")] * 2)
    t_s = np.arange(1000) * 1e-3
    rows = []
    for at_s in t_s:
        loaded = plant.load(state, (0.0, 0.0), (40.0 * np.sin(9.0 * at_s),), 20.0)
        rows.append((*state.struts[1], loaded.forces_n[1]))
        state = plant.step(loaded, 1e-3, (40.0 * np.sin(9.0 * (at_s + 1e-3)),))
    height, speed, force = np.array(rows).T
    path = written(tmp_path, strut_component(spec, spec.strut("suspension")), version, spec)
    assert validate_fmu(str(path)) == []
    inputs = {"height_m": height, "velocity_m_per_s": speed}
    made = stepped(path, t_s, inputs, ["force_n", "spring.part_n", "damper.part_n"])
    assert np.abs(made["force_n"] - force).max() < 1e-12 * np.ptp(force)
    assert np.ptp(made["spring.part_n"] + made["damper.part_n"] - force) > 1.0


@pytest.mark.parametrize(("version", "kind"), KINDS)
def test_fmpy_simulates_a_strut_under_a_signal(tmp_path, version, kind):
    """As a user would who knows no more of FMPy than `simulate_fmu`."""
    spec = corrected_quarter_car()
    path = written(tmp_path, strut_component(spec, spec.strut("suspension")), version, spec)
    signal = np.zeros(201, dtype=[("time", float), ("velocity_m_per_s", float)])
    signal["time"] = np.arange(201) * 1e-3
    signal["velocity_m_per_s"] = 0.3 * np.sin(30.0 * signal["time"])
    result = fmpy.simulate_fmu(
        str(path),
        validate=True,
        fmi_type=kind,
        input=signal,
        output=["velocity_m_per_s", "damper.part_n"],
        stop_time=0.2,
        output_interval=1e-3,
    )
    part = -120.0 * result["velocity_m_per_s"]
    assert result["damper.part_n"] == pytest.approx(part, abs=1e-9)
    assert np.ptp(result["velocity_m_per_s"]) == pytest.approx(0.6, rel=1e-3)


def test_an_applied_force_that_rises_and_falls(tmp_path):
    """FMI 2.0 is told the slopes of its inputs, as the plant is; FMI 3.0 holds them over a step."""
    spec = with_effects("cubic_stiffness", "bouc_wen")
    t_s = np.arange(2001) * 1e-3
    force = 60.0 * np.sin(8.0 * t_s) + 20.0 * np.sin(31.0 * t_s)
    plant = DartPlant(spec)
    state = plant.init([float("nan")])
    theirs = [state.struts[0][0]]
    for k in range(len(t_s) - 1):
        state = plant.step(plant.load(state, (0.0,), (force[k],), 20.0), 1e-3, (force[k + 1],))
        theirs.append(state.struts[0][0])
    for version, reach in (("2.0", 1e-10), ("3.0", 2e-5)):
        path = written(tmp_path, bench_component(spec), version, spec)
        ours = stepped(path, t_s, {"applied_force_n": force}, ["strut.height_m"])["strut.height_m"]
        assert np.abs(ours - theirs).max() < reach * np.ptp(theirs), version


@pytest.mark.slow
@pytest.mark.parametrize("version", ["2.0", "3.0"])
@pytest.mark.parametrize(
    ("laws", "most"),
    [
        pytest.param(("end_stops",), 2, id="a contact begins and ends"),
        pytest.param(("elastoplastic_friction",), 50, id="sticking friction"),
        pytest.param(("end_stops", "presliding_friction"), 50, id="both"),
    ],
)
def test_a_law_switches_at_events_without_chatter(tmp_path, version, laws, most):
    """Chatter would be an event at every step, of which there are a thousand."""
    spec = with_effects(*laws)
    heights, events = fmu_let_go(tmp_path, spec, version, "ModelExchange")
    assert np.abs(heights - let_go(spec, SHORT_S)).max() < 2e-6 * np.ptp(heights)
    assert 0 < events <= most


SENSORS = {
    "seat": VirtualSensor(acceleration_of="body"),
    "place": VirtualSensor(position_of="body", at=(0.0, 0.0, 0.1)),
    "speed": VirtualSensor(velocity_of="body", axis=(0.0, 0.0, -2.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize(("version", "kind"), KINDS)
def test_virtual_sensors_are_outputs_and_read_what_the_plant_reads(tmp_path, version, kind):
    spec = with_effects("cubic_stiffness")
    path = written(tmp_path, bench_component(spec, SENSORS), version, spec)
    assert validate_fmu(str(path)) == []
    plant = DartPlant(spec)
    reader, state, expected = plant.virtual_sensors(SENSORS), plant.init([DISPLACED_M]), []
    for _ in range(301):
        loaded = plant.load(state, (0.0,), (0.0,), 20.0)
        expected.append(reader.read(loaded, (0.0,)))
        state = plant.step(loaded, STEP_S, (0.0,))
    starts = {"strut.height_m": DISPLACED_M}
    for index, name in enumerate(
        ("seat.acceleration_m_per_s2", "place.position_m", "speed.velocity_m_per_s")
    ):
        found, _ = simulated(path, kind, starts, name, 0.3, STEP_S)
        assert found == pytest.approx(np.array(expected)[:, index], rel=1e-5, abs=1e-6)


def test_a_sensor_of_a_strut_is_refused_for_an_fmu_that_has_its_outputs():
    spec = with_effects("none")
    with pytest.raises(InputError, match="has outputs of the struts already"):
        bench_component(spec, {"power": VirtualSensor(power_of="strut")})
