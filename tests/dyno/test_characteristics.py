"""Figures of dampers with known truth, from one step to a whole test, and what cannot be read."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from can_dbc.errors import InputError
from rig.cli.main import app
from rig.dyno.characterise import ForceRecord, characterise, characterise_record
from rig.dyno.request import FigureRequest
from rig.dyno.strokes import find_blocks, find_holds, find_strokes
from tests.dyno.__main__ import coverage, study
from tests.dyno.dynos import Dyno, drawn

RATE_HZ = 500.0


@pytest.mark.long
def test_intervals_hold_the_truth():
    hits = study(60, seed=3)
    for name in dict.fromkeys(name for name, _ in hits):
        # Of 60 dynos 57 are to be expected; nine too few come once in a thousand.
        assert coverage(hits, name) > 0.85, name


def test_without_noise_the_closed_forms_are_met():
    dyno = Dyno("friction", 1.3, 0.02, 120.0, 6.4, 1e-6, 1e-12, 0.4)
    [step] = characterise_record(ForceRecord("exact", *dyno.record(np.random.default_rng(0)))).steps
    truth = dyno.truth()
    assert step.rebound.peak_velocity_m_per_s.value == pytest.approx(dyno.speed, rel=1e-5)
    assert step.energy_per_cycle_j.value == pytest.approx(truth["energy"], rel=1e-4)
    assert step.compression.force_at_peak_velocity_n.value == pytest.approx(
        truth["force at peak velocity"][0], rel=1e-4
    )
    assert step.spring_rate_n_per_m.value == pytest.approx(truth["spring rate"], rel=1e-4)
    assert step.hysteresis_at_zero_n.value == pytest.approx(70.0, abs=0.05)
    assert step.frequency_hz == pytest.approx(1.3, rel=1e-6)
    assert step.cycles == pytest.approx(6.0, abs=0.5)


# --- A whole test: warm-up, a slow cycle, five speeds, a rest; the oil warms ------------------

KNEE, FRICTION_N, GAS_N, RATE = 0.12, 18.0, 220.0, 2500.0
PER_KELVIN = -0.004


def law(x_m, v, temperature_c):
    speed = np.abs(v)
    damping = np.where(speed < KNEE, 2600.0 * speed, 2600.0 * KNEE + 500.0 * (speed - KNEE))
    damping *= 1.0 + PER_KELVIN * (temperature_c - 25.0)
    side = np.where(v > 0.0, 1.4, 1.0)
    return GAS_N - RATE * x_m - np.sign(v) * side * damping - FRICTION_N * np.tanh(v / 3e-5)


def whole_test(seed=1, noise_n=2.0):
    """Times, heights, forces and temperatures of a test in one record."""
    rng = np.random.default_rng(seed)
    parts = [(0.5, 0.025, 40), (0.012, 0.02, 2)]  # warm-up; 1.5 mm/s
    parts += [(speed / (2.0 * math.pi * 0.025), 0.025, 8) for speed in (0.05, 0.1, 0.2, 0.4, 0.6)]
    parts += [(0.5, 0.025, 8)]  # the warm-up's speed once more, warm
    x, v = [np.zeros(round(1.5 * RATE_HZ))], [np.zeros(round(1.5 * RATE_HZ))]
    for frequency, amplitude, cycles in parts:
        t = np.arange(round(cycles / frequency * RATE_HZ)) / RATE_HZ
        angle = 2.0 * math.pi * frequency * t
        x.append(amplitude * np.sin(angle))
        v.append(2.0 * math.pi * frequency * amplitude * np.cos(angle))
    x_m, rate = np.concatenate(x), np.concatenate(v)
    t_s = np.arange(len(x_m)) / RATE_HZ
    temperature_c = 25.0 + 15.0 * (1.0 - np.exp(-t_s / 40.0))
    force = law(x_m, rate, temperature_c) + noise_n * rng.standard_normal(len(x_m))
    return t_s, 0.3 + x_m + 2e-6 * rng.standard_normal(len(x_m)), force, temperature_c


@pytest.fixture(scope="module")
def tested():
    # It has one rest: a drift, which two would show, is taken for none.
    requested = FigureRequest(zero=False)
    return characterise_record(ForceRecord("whole", *whole_test()), requested)


@pytest.mark.slow
def test_a_whole_test_is_divided_into_its_parts(tested):
    kinds = ["warm_up", "quasi_static", *["velocity_step"] * 6]
    assert [step.kind for step in tested.steps] == kinds
    speeds = [step.peak_speed_m_per_s for step in tested.steps]
    expected = (0.0785, 0.00151, 0.05, 0.1, 0.2, 0.4, 0.6, 0.0785)
    assert speeds == pytest.approx(expected, rel=0.01)
    [rest] = tested.holds
    assert rest.force_n.low <= GAS_N <= rest.force_n.high
    assert rest.end_s == pytest.approx(1.5, abs=0.05)


def test_friction_and_gas_are_those_of_the_slow_cycle(tested):
    damper = tested.damper
    # At 1.5 mm/s the valves damp with 3 to 5 N, which are not friction.
    assert damper.friction_n.low <= FRICTION_N <= damper.friction_n.high
    assert damper.gas_force_n.low <= GAS_N <= damper.gas_force_n.high
    assert damper.gas_rate_n_per_m.low <= RATE <= damper.gas_rate_n_per_m.high
    assert damper.friction_n.high - damper.friction_n.low < 4.0


def test_knee_asymmetry_and_temperature(tested):
    damper = tested.damper
    for side in ("compression", "rebound"):
        knee = damper.knee_m_per_s[side]
        assert knee.low <= KNEE <= knee.high
        assert knee.high - knee.low < 0.15
    # At one speed the damping falls by 0.4 % per kelvin of what it is at 25 degrees.
    damping = 2600.0 * 0.0785
    for side, factor, sign in (("compression", 1.0, 1.0), ("rebound", 1.4, -1.0)):
        figure, true = damper.force_per_kelvin_n_per_k[side], sign * factor * PER_KELVIN * damping
        assert figure.low <= true <= figure.high
        assert abs(figure.high - figure.low) < 0.4 * abs(true)
    top = 2600.0 * KNEE + 500.0 * (0.6 - KNEE)
    warm = 1.0 + PER_KELVIN * (tested.steps[6].temperature_c - 25.0)
    true = (1.4 * top * warm + FRICTION_N) / (top * warm + FRICTION_N)
    assert damper.asymmetry.low <= true <= damper.asymmetry.high


def test_a_straight_damper_has_no_knee_and_a_cold_one_no_slope():
    dyno = Dyno("linear", 1.0, 0.02, 100.0, 8.0, 2.0, 2e-6, 0.0)
    found = characterise_record(ForceRecord("straight", *dyno.record(np.random.default_rng(2))))
    assert found.damper.knee_m_per_s == {"compression": None, "rebound": None}
    assert found.damper.force_per_kelvin_n_per_k == {"compression": None, "rebound": None}
    assert found.damper.friction_n is None
    assert any("no knee" in note for note in found.damper.notes)


# --- Motions -----------------------------------------------------------------------------------


def test_noise_at_rest_is_no_stroke():
    rng = np.random.default_rng(4)
    t_s = np.arange(5000) / RATE_HZ
    assert find_strokes(t_s, 0.3 + 1e-5 * rng.standard_normal(5000)) == []
    assert find_strokes(t_s, np.full(5000, 0.3)) == []


def test_strokes_of_a_triangle():
    """Constant speed: no series of few harmonics, and its energy is that of a rectangle."""
    t_s = np.arange(6000) / RATE_HZ
    x = 0.02 * (2.0 / np.pi) * np.arcsin(np.sin(2.0 * np.pi * 0.5 * t_s))
    v = np.where(np.cos(2.0 * np.pi * 0.5 * t_s) > 0.0, 0.04, -0.04)
    rng = np.random.default_rng(5)
    force = 150.0 - 2000.0 * v + rng.standard_normal(6000)
    [step] = characterise_record(
        ForceRecord("triangle", t_s, 0.3 + x + 1e-6 * rng.standard_normal(6000), force)
    ).steps
    assert step.frequency_hz is None
    assert step.rebound.force_window_n.value == pytest.approx(70.0, abs=1.0)
    assert step.energy_per_cycle_j.value == pytest.approx(2.0 * 80.0 * 0.04, rel=0.01)


def test_a_middle_that_wanders_does_not_bend_the_figures():
    t_s = np.arange(6000) / RATE_HZ
    angle = 2.0 * math.pi * 1.0 * t_s
    x = 0.02 * np.sin(angle) + 2e-3 * t_s
    v = 0.02 * 2.0 * math.pi * np.cos(angle) + 2e-3
    rng = np.random.default_rng(11)
    force = 150.0 - 1000.0 * v + rng.standard_normal(6000)
    found = characterise_record(
        ForceRecord("wanders", t_s, 0.3 + x + 1e-6 * rng.standard_normal(6000), force)
    )
    [step] = found.steps
    assert step.peak_speed_m_per_s == pytest.approx(0.1277, rel=0.01)
    assert step.amplitude_m == pytest.approx(0.02, rel=0.02)
    assert step.rebound.force_at_peak_velocity_n.value == pytest.approx(150.0 - 127.7, abs=2.0)
    assert step.energy_per_cycle_j.value == pytest.approx(
        1000.0 * math.pi * 2.0 * math.pi * 0.02**2, rel=0.02
    )


def test_a_gap_is_no_rest():
    rng = np.random.default_rng(12)
    t_s, x, force = Dyno("linear", 1.0, 0.02, 200.0, 12.0, 1.0, 1e-6, 0.1).record(rng)
    keep = (t_s < 4.2) | (t_s > 6.5)
    assert characterise_record(ForceRecord("gap", t_s[keep], x[keep], force[keep])).holds == ()


def test_two_amplitudes_are_two_steps():
    rng = np.random.default_rng(6)
    first = Dyno("linear", 1.0, 0.02, 100.0, 5.0, 1.0, 1e-6, 0.0).record(rng)
    later = Dyno("linear", 1.0, 0.01, 100.0, 5.0, 1.0, 1e-6, 0.0).record(rng, begin_s=5.0)
    t_s, x, _ = (np.concatenate(pair) for pair in zip(first, later, strict=True))
    blocks = find_blocks(t_s, x, find_strokes(t_s, x))
    assert [round(1e3 * abs(block.strokes[1].rise_m)) for block in blocks] == [40, 20]
    assert find_holds(t_s, x, blocks) == []


# --- What may mislead ---------------------------------------------------------------------------


def test_a_good_record_is_not_accused(tested):
    assert tested.quality == ()


def test_gaps_few_samples_and_coarse_forces_are_said():
    rng = np.random.default_rng(9)
    t_s, x, force = Dyno("linear", 2.0, 0.02, 12.0, 12.0, 0.0, 1e-6, 0.1).record(rng)
    t_s = t_s.copy()
    t_s[60:] += 0.5  # twelve samples a cycle: half a second is a cycle, the motion goes on
    said = characterise_record(ForceRecord("bad", t_s, x, 50.0 * np.round(force / 50.0))).quality
    assert any("gaps between samples, the longest 0.542 s at" in text for text in said)
    assert any("12.0 samples a cycle" in text for text in said)


@pytest.mark.slow
def test_a_cell_that_drifts_is_said():
    t_s, x, force, _ = whole_test()
    rest = np.full(1000, 0.3)
    last_s = t_s[-1] + np.arange(1, 1001) / RATE_HZ
    noise = 2.0 * np.random.default_rng(10).standard_normal(1000)
    said = characterise_record(
        ForceRecord(
            "drift",
            np.concatenate([t_s, last_s]),
            np.concatenate([x, rest]),
            np.concatenate([force, GAS_N - 25.0 + noise]),
        )
    ).quality
    assert len(said) == 1
    assert "changed by -2" in said[0]


# --- The command -------------------------------------------------------------------------------


def written(path, columns, header="t_s,height_m,strut_force_n"):
    rows = [",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_the_command_writes_figures_and_a_page(tmp_path):
    rng = np.random.default_rng(7)
    files = [
        written(tmp_path / f"{law}.csv", drawn_of(law).record(rng)) for law in ("linear", "gas")
    ]
    out = tmp_path / "found"
    ended = CliRunner().invoke(app, ["characterise", *map(str, files), "--out", str(out), "--json"])
    assert ended.exit_code == 0, ended.output
    content = json.loads((out / "characteristics.json").read_text())
    assert json.loads(ended.stdout) == content
    assert [record["record"] for record in content["records"]] == ["linear.csv", "gas.csv"]
    [step] = content["records"][0]["steps"]
    assert step["compression"]["force_at_peak_velocity_n"]["value"] > 0.0
    assert step["rebound"]["force_at_peak_velocity_n"]["value"] < 0.0
    page = (out / "report.html").read_text()
    assert "data:image/svg+xml;base64," in page
    assert "linear.csv" in page
    assert 'src="http' not in page


def drawn_of(law_name):
    return Dyno(law_name, 1.2, 0.02, 80.0, 6.0, 5.0, 1e-6, 0.2)


def test_what_does_not_repeat_is_one_line(tmp_path):
    t_s = np.arange(2000) / RATE_HZ
    path = written(tmp_path / "ramp.csv", (t_s, 0.3 + 0.01 * t_s, 10.0 + 0.1 * t_s))
    with pytest.raises(InputError, match="expected a test that repeats its cycles"):
        characterise(path)
    rng = np.random.default_rng(8)
    no_cell = written(
        tmp_path / "free.csv", drawn_of("linear").record(rng), "t_s,height_m,applied_force_n"
    )
    with pytest.raises(InputError, match="has no strut_force_n"):
        characterise(no_cell)


@pytest.mark.parametrize("seed", range(8))
def test_hostile_records_end_in_figures_or_one_line(seed):
    """Steps, spikes, plateaus and few samples: never a traceback, never a figure without bounds."""
    rng = np.random.default_rng(seed)
    t_s, x, force = drawn(rng).record(rng)
    for _ in range(6):
        first = int(rng.integers(0, len(x) - 2))
        last = int(rng.integers(first + 1, len(x)))
        match int(rng.integers(0, 4)):
            case 0:
                x[first:last] = x[first]
            case 1:
                x[first:last] += 0.01
            case 2:
                force[first:last] = 0.0
            case _:
                x[first] += 0.1
    try:
        found = characterise_record(ForceRecord("hostile", t_s, x, force))
    except InputError as error:
        assert "\n" not in str(error)  # noqa: PT017 - one of two good ends
        return
    for step in found.steps:
        assert math.isfinite(step.energy_per_cycle_j.value)


DATA = Path(__file__).parents[2].parent / "shared" / "data" / "mr_damper"


@pytest.mark.skipif(not DATA.is_dir(), reason="the measured MR damper is not here")
@pytest.mark.parametrize(("name", "peak_n"), [("5mm3Hz0A", 190.0), ("5mm3Hz1A", 1530.0)])
def test_a_measured_damper(name, peak_n):
    """The mean stroke beside the extremes of the record itself, which noise makes larger."""
    t_s, x_mm, v_mm_per_s, force = np.loadtxt(DATA / f"{name}.txt").T[:4]
    t_s = np.linspace(t_s[0], t_s[-1], len(t_s))
    found = characterise_record(ForceRecord(name, t_s, 0.3 + 1e-3 * x_mm, -force))
    [step] = found.steps
    largest = 1e-3 * float(np.percentile(np.abs(v_mm_per_s), 99.5))
    assert step.peak_speed_m_per_s == pytest.approx(largest, rel=0.01)
    assert -step.rebound.peak_force_n.value == pytest.approx(peak_n, rel=0.03)


def sine(frequency_hz, seconds, amplitude_m=0.02, rate_hz=500.0):
    t_s = np.arange(round(seconds * rate_hz)) / rate_hz
    angle = 2.0 * math.pi * frequency_hz * t_s
    return (
        t_s,
        amplitude_m * np.sin(angle),
        2.0 * math.pi * frequency_hz * amplitude_m * np.cos(angle),
    )


def test_strokes_that_ramp_up_and_down_are_of_no_step():
    """A damper's record whose first and last stroke are shorter: the cycles between are a sine."""
    t_s, x_m, _v = sine(1.0, 12.0)
    swell = np.interp(t_s, (0.0, 1.0, 1.5, 10.5, 11.0, 12.0), (0.0, 0.7, 1.0, 1.0, 0.7, 0.0))
    height_m = 0.3 + swell * x_m
    force_n = 200.0 - 1500.0 * np.gradient(height_m, t_s)
    (step,) = characterise_record(ForceRecord("ramped", t_s, height_m, force_n)).steps
    assert step.frequency_hz == pytest.approx(1.0, rel=1e-3)
    assert step.amplitude_m == pytest.approx(0.02, rel=1e-3)
    energy_j = math.pi * 1500.0 * 2.0 * math.pi * 0.02**2
    assert step.energy_per_cycle_j.value == pytest.approx(energy_j, rel=2e-3)


def test_a_motion_that_does_not_repeat_is_refused():
    accepted = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        t_s = np.arange(15_000) / 500.0
        smooth = np.exp(-0.5 * (np.arange(-600, 601) / 80.0) ** 2)
        x_m = np.convolve(rng.standard_normal(len(t_s) + 1200), smooth, "valid")
        height_m = 0.3 + 0.02 * x_m / np.std(x_m)
        force_n = -1500.0 * np.gradient(height_m, t_s)
        try:
            said = characterise_record(ForceRecord("random", t_s, height_m, force_n)).quality
            accepted += 1
            assert any("gave no step" in text for text in said)
        except InputError as error:
            assert "expected a test that repeats its cycles" in str(error)  # noqa: PT017
    assert accepted <= 2


def test_a_speed_that_is_constant_has_its_force_at_mid_stroke():
    t_s = np.arange(20_000) / 1000.0
    place = 0.1 * t_s / 0.1 % 1.0  # strokes of 50 mm at 0.1 m/s, one a cycle of a second
    x_m = 0.025 * (1.0 - 4.0 * np.abs(place - 0.5))
    v = np.where(place < 0.5, 0.1, -0.1)
    rng = np.random.default_rng(1)
    force_n = 200.0 - 2000.0 * x_m - 2000.0 * v - 20.0 * np.sign(v) + rng.normal(0.0, 2.0, len(v))
    height_m = 0.3 + x_m + 1e-6 * rng.standard_normal(len(v))
    tested = characterise_record(ForceRecord("triangle", t_s, height_m, force_n))
    (step,) = tested.steps
    for side, truth_n in ((step.compression, 420.0), (step.rebound, -20.0)):
        force = side.force_at_peak_velocity_n
        assert force.low <= truth_n <= force.high
        assert side.peak_velocity_m_per_s.value == pytest.approx(0.1, rel=0.01)
    assert not any(tested.damper.knee_m_per_s.values())
    assert any("single speed" in note for note in tested.damper.notes)


@pytest.mark.slow
def test_a_slow_stroke_is_no_rest():
    rest = np.full(1000, 0.0)
    slow, fast = (sine(f, s) for f, s in ((0.004, 625.0), (2.4, 4.0)))
    x_m = np.concatenate([rest, slow[1], rest, fast[1], rest])
    t_s = np.arange(len(x_m)) / 500.0
    v = np.gradient(x_m, t_s)
    tested = characterise_record(
        ForceRecord("slow", t_s, 0.3 + x_m, 200.0 - 2000.0 * x_m - 1500.0 * v)
    )
    assert [hold.height_m for hold in tested.holds] == pytest.approx([0.3] * 3, abs=2e-5)
    assert tested.holds[0].end_s == pytest.approx(2.0, abs=0.1)


def test_a_strut_that_gives_energy_is_said():
    t_s, x_m, v = sine(2.0, 5.0)
    said = characterise_record(
        ForceRecord("wrong sign", t_s, 0.3 + x_m, 1500.0 * v + 10.0 * np.cos(40.0 * t_s))
    ).quality
    assert "gives energy" in said[0]


def test_forces_that_no_machine_reaches_are_refused():
    t_s, x_m, v = sine(2.0, 5.0)
    with pytest.raises(InputError, match="expected at most 1e"):
        characterise_record(ForceRecord("huge", t_s, 0.3 + x_m, -1e155 * v))


def test_a_force_that_is_cut_off_is_said():
    t_s, x_m, v = sine(2.0, 5.0)
    force_n = -1500.0 * v
    said = characterise_record(
        ForceRecord("clipped", t_s, 0.3 + x_m, np.clip(force_n, -1e9, 250.0))
    ).quality
    assert "never leaves its highest level of 250 N" in " ".join(said)
    coarse = np.round(force_n / 20.0) * 20.0  # flat tops of a step are none
    assert "stays" not in " ".join(
        characterise_record(ForceRecord("coarse", t_s, 0.3 + x_m, coarse)).quality
    )
