"""Late channels are found along with effects, and separated from them where motion allows it."""

import random
from dataclasses import dataclass, replace

import numpy as np
import pytest

from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.numerics.delay_step import ForceOverTime, delay_step
from rig.diagnosis.problem.channel_delays import known_share, late_columns, late_reader
from rig.diagnosis.problem.delay_estimate import _about, search_delays_beyond
from rig.diagnosis.problem.problem import Candidate, LinearParameter
from rig.diagnosis.search.fit import linear_bounds
from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis import test_planted_effects as driven
from tests.diagnosis import test_prescribed as prescribed
from tests.diagnosis.answers import LINEAR_FAMILIES
from tests.diagnosis.late_channels import bench_run, dyno_run, sine


def force_along(frequencies_hz, delay_s, noise_n=0.0):
    """A strut with friction along sines, seen a time later, and the derivative by the delay."""
    t = np.arange(6000) / 500.0

    def motion(at):
        angles = [2.0 * np.pi * hz * at for hz in frequencies_hz]
        z = sum(0.01 / hz * np.sin(a) for hz, a in zip(frequencies_hz, angles, strict=True))
        v = sum(0.02 * np.pi * np.cos(a) for a in angles)
        return z, v

    def force(at):
        z, v = motion(at)
        return -9000.0 * z - 2e6 * z**3 - 800.0 * v - 30.0 * np.tanh(v / 0.003)

    step_s = 1e-4
    slope = (force(t - delay_s + step_s) - force(t - delay_s - step_s)) / (2.0 * step_s)
    noise = noise_n * np.random.default_rng(1).standard_normal(len(t))
    shown = force(t - delay_s) + noise
    nothing, alone = np.zeros((len(t), 0)), np.ones((len(t), 1))
    return ForceOverTime(*motion(t), shown, slope[:, np.newaxis], nothing, alone)


def test_a_step_finds_the_delay_of_a_force():
    """To second order in the delay, so to a hundredth of a small one; with noise, within it."""
    step = delay_step([force_along((0.7, 1.9, 4.3), 2e-4)])
    assert step.steps_s[0] == pytest.approx(2e-4, rel=0.05)
    noisy = delay_step([force_along((0.7, 1.9, 4.3), 0.0, noise_n=2.0)])
    assert abs(noisy.steps_s[0]) < 4.0 * noisy.stds_s[0] < 1e-4


def test_a_single_sine_determines_no_delay():
    step = delay_step([force_along((1.9,), 2e-4, noise_n=2.0)])
    assert not np.isfinite(step.stds_s).any()
    assert step.steps_s.tolist() == [0.0]


@pytest.mark.parametrize(
    ("value_s", "ends_s"),
    [(9.6e-3, (7.6e-3, 11.6e-3)), (10.6e-3, (9.6e-3, 11.6e-3)), (11.6e-3, (9.6e-3, 13.6e-3))],
)
def test_a_delay_that_a_fit_left_at_an_end_is_searched_for_beyond_it(value_s, ends_s):
    late = LinearParameter(
        0, "delay", 0.0, 2e-3, 9.6e-3, channel="height_m:strut", most=11.6e-3, expected=10.6e-3
    )
    problem = LinearPart(linear=(late, late._replace(kind="mass")))
    found, mass = search_delays_beyond(problem, np.array([value_s, value_s])).linear
    assert (found.least, found.most) == pytest.approx(ends_s)
    assert found.expected == late.expected
    assert (mass.least, mass.most) == (late.least, late.most)


@dataclass(frozen=True)
class LinearPart:
    """The linear parameters of a problem."""

    linear: tuple[LinearParameter, ...]


def pair(*forces, delays):
    """Struts of which each shows its own force, with its own delay or that of a number."""
    made = []
    for strut, force in enumerate(forces):
        by_delays = np.zeros((len(force.force_n), max(delays) + 1))
        by_delays[:, [delays[strut]]] = force.by_delays
        shares = np.tile(np.eye(len(forces))[strut], (len(force.force_n), 1))
        made.append(force._replace(by_delays=by_delays, shares=shares))
    return made


@pytest.mark.parametrize("noise_n", [0.0, 1e-7, 1e-3])
def test_a_strut_that_is_known_better_changes_nothing_for_another(noise_n):
    late = force_along((0.7, 1.9, 4.3), 2e-4, noise_n=1.0)
    exact = force_along((0.7, 1.9, 4.3), 0.0, noise_n=noise_n)
    alone, both = delay_step([late]), delay_step(pair(late, exact, delays=(0, 1)))
    assert both.steps_s[0] == pytest.approx(alone.steps_s[0], abs=0.2 * alone.stds_s[0])
    assert both.stds_s[0] == pytest.approx(alone.stds_s[0], rel=0.3)


def test_delays_of_channels_that_move_alike_are_not_determined():
    force = force_along((0.7, 1.9, 4.3), 2e-4, noise_n=1.0)
    noise = 1e-4 * np.random.default_rng(2).standard_normal((len(force.force_n), 1))
    alike = np.column_stack([force.by_delays, force.by_delays * (1.0 + noise)])
    step = delay_step([force._replace(by_delays=alike)])
    assert not np.isfinite(step.stds_s).any()


def test_without_a_known_force_no_delay_is_determined():
    force = force_along((0.7, 1.9, 4.3), 2e-4)
    step = delay_step([force._replace(force_n=np.full_like(force.force_n, np.nan))])
    assert step.steps_s.tolist() == [0.0]
    assert not np.isfinite(step.stds_s).any()


def test_late_columns_and_their_reader_are_exact_for_a_cubic():
    t = np.linspace(0.0, 2.0, 41)
    values = np.column_stack([t**3 - t, 2.0 * t**2])
    rates = np.column_stack([3.0 * t**2 - 1.0, 4.0 * t])
    delays_s = np.array([0.13, -0.07])
    inner = slice(5, -5)
    expected = np.column_stack([(t - 0.13) ** 3 - (t - 0.13), 2.0 * (t + 0.07) ** 2])
    for found in (
        late_columns(t, values, rates, delays_s),
        late_columns(t, values, None, delays_s),
    ):
        np.testing.assert_allclose(found[inner], expected[inner], atol=1e-12)
    read = (late_reader(t, t[::2], delays_s) @ values.ravel()).reshape(-1, 2)
    np.testing.assert_allclose(read[3:-3], expected[::2][3:-3], atol=1e-12)
    nothing = np.zeros(2)
    assert late_columns(t, values, rates, nothing) is values
    same = late_reader(t, t[::2], nothing) @ values.ravel()
    np.testing.assert_array_equal(same, values[::2].ravel())


def test_what_a_delay_asks_for_beyond_a_recording_has_no_weight():
    t = np.linspace(0.0, 1.0, 101)
    weights = known_share(t, np.array([0.0, 0.025, -0.025]))
    assert np.all(weights[:, 0] == 1.0)
    np.testing.assert_allclose(weights[:5, 1], [0.0, 0.0, 0.5, 1.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(weights[:, 2], weights[::-1, 1], atol=1e-9)


def laws(diagnosis):
    return {effect.family for effect in diagnosis.effects} - LINEAR_FAMILIES - {"delay"}


@pytest.mark.parametrize("late_ms", [3.0, -1.7])
def test_a_late_load_cell_is_no_law(late_ms):
    delay_s = 1e-3 * late_ms
    runs = [dyno_run(prescribed.Friction(), delay_s, seed) for seed in (1, 2)]
    found = diagnose(dyno.model(damping=0.8 * dyno.DAMPING), runs[:1], runs[1:]).diagnosis
    assert found.verdict == "explained"
    assert laws(found) == {"friction"}
    (channel,) = found.channels
    assert (channel.channel, channel.parameter, channel.nominal) == (
        "strut_force_n:strut", "delay_s", 0.0,
    )  # fmt: skip
    assert channel.total.value == pytest.approx(delay_s, abs=5e-5)
    assert channel.total.low <= delay_s <= channel.total.high
    delay = next(effect for effect in found.effects if effect.family == "delay")
    assert delay.parameters["delay_s"].value == pytest.approx(delay_s, abs=5e-5)


def test_a_late_height_is_no_law():
    runs = [bench_run(driven.Orifice, 4e-3, seed) for seed in (1, 2)]
    found = diagnose(bench.model(mass=1.03 * bench.MASS), runs[:1], runs[1:]).diagnosis
    assert (found.verdict, laws(found)) == ("explained", {"nonlinear_damping"})
    (channel,) = found.channels
    assert channel.channel == "height_m:strut"
    assert channel.total.value == pytest.approx(4e-3, abs=5e-5)
    assert channel.total.low <= 4e-3 <= channel.total.high
    assert found.held_out.height_rmse_m.after < 1.1 * found.noise_floor.height_rmse_m


def test_a_relaxing_spring_and_a_late_cell_are_told_apart_by_several_frequencies():
    runs = [dyno_run(prescribed.Relaxing(), 2.7e-3, seed) for seed in (1, 2)]
    found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
    assert (found.verdict, laws(found)) == ("explained", {"hysteresis"})
    total = found.channels[0].total
    assert total.value == pytest.approx(2.7e-3, abs=1e-4)
    assert total.low <= 2.7e-3 <= total.high


class Rubber(dyno.Nothing):
    """Four springs with a damper in series each, which no single law of the catalogue is."""

    size = 4

    def force(self, t, z, v, state, warm):
        return -4000.0 * sum(z - dyno.MIDDLE - travel for travel in state)

    def rate(self, t, z, v, state):
        per_s = 3.0, 12.0, 50.0, 200.0
        return tuple(r * (z - dyno.MIDDLE - s) for r, s in zip(per_s, state, strict=True))


def test_a_memory_that_is_explained_in_part_is_no_delay():
    """The load cell is not late; without a law the memory looks like 2 ms."""
    runs = [dyno_run(Rubber(), 0.0, seed) for seed in (1, 2)]
    found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
    assert (found.verdict, laws(found)) == ("partly_explained", {"hysteresis"})
    assert not found.channels
    assert "delay" not in {effect.family for effect in found.effects}


def bounds_ms(law, least_ms, most_ms):
    expected_s = 0.5e-3 * (least_ms + most_ms)
    delay = LinearParameter(
        0, "delay", 0.0, 2e-3, 1e-3 * least_ms, -1, "height_m:strut", 1e-3 * most_ms, expected_s
    )
    low, high = linear_bounds(delay, Candidate((), ((0, law),)))
    return 1e3 * low, 1e3 * high


def test_beside_a_law_with_memory_any_delay_of_usual_channels_is_possible_and_no_longer_one():
    assert bounds_ms("dahl", 1.0, 3.0) == pytest.approx((-8.0, 8.0))
    assert bounds_ms("dahl", 19.0, 21.0) == pytest.approx((-8.0, 21.0))
    assert bounds_ms("coulomb_friction", 1.0, 3.0) == pytest.approx((1.0, 3.0))


def test_a_vague_estimate_leaves_zero_and_the_delays_of_usual_channels():
    delay = LinearParameter(0, "delay", 0.0, 2e-3, 0.0, -1, "strut_force_n:strut")
    known, vague = _about(delay, 20e-3, 0.01e-3), _about(delay, 12e-3, 2e-3)
    misled_by_tone = _about(delay, 11e-3, 0.16e-3)
    assert (misled_by_tone.least, misled_by_tone.most) == pytest.approx((-1e-3, 12e-3))
    assert (known.least, known.most) == pytest.approx((19e-3, 21e-3))
    assert (vague.least, vague.most) == pytest.approx((-1e-3, 20e-3))
    shown_by_nothing = _about(delay, 5e-3, 4e-3)
    assert (shown_by_nothing.least, shown_by_nothing.most) == pytest.approx((-8e-3, 8e-3))


@pytest.mark.parametrize(
    ("effect", "delay_s", "rivals"),
    [
        (dyno.Nothing, 3e-3, {"delay"}),
        (prescribed.Relaxing, 0.0, {"hysteresis", "delay"}),
        (prescribed.Relaxing, 3e-3, {"hysteresis", "delay"}),
    ],
)
def test_at_one_frequency_they_are_not(effect, delay_s, rivals):
    runs = [dyno_run(effect(), delay_s, seed, motion=sine, settled_s=1.0) for seed in (1, 2)]
    found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
    assert found.verdict == "ambiguous"
    assert set(found.ambiguous_with) == rivals
    assert not found.channels
    if effect is dyno.Nothing:
        # Spring and damper are known no better than the delay.
        for item in found.linear:
            assert item.total.low <= item.nominal <= item.total.high


def test_at_one_frequency_a_delay_that_no_bench_has_is_no_rival():
    runs = [dyno_run(dyno.Nothing(), 0.0, seed, motion=sine) for seed in (1, 2)]
    found = diagnose(dyno.model(damping=0.75 * dyno.DAMPING), runs[:1], runs[1:]).diagnosis
    assert (found.verdict, found.ambiguous_with) == ("explained", ())


@pytest.mark.slow
def test_simultaneous_channels_have_no_correction():
    for found in (
        diagnose(dyno.model(), [dyno.run(dyno.Nothing())]).diagnosis,
        diagnose(bench.model(), [bench.run(driven.Friction())]).diagnosis,
    ):
        assert not found.channels


DYNO = {
    "nothing": (dyno.Nothing, set()),
    "friction": (prescribed.Friction, {"friction"}),
    "orifice": (prescribed.Orifice, {"nonlinear_damping"}),
    "digressive": (prescribed.Digressive, {"nonlinear_damping"}),
    "stop": (prescribed.Stop, {"stop"}),
    "hardening": (prescribed.Hardening, {"nonlinear_stiffness"}),
    "relaxing": (prescribed.Relaxing, {"hysteresis"}),
    "yielding": (prescribed.Yielding, {"hysteresis"}),
}
DRIVEN = {
    "nothing": (bench.Nothing, set()),
    "friction": (driven.Friction, {"friction"}),
    "orifice": (driven.Orifice, {"nonlinear_damping"}),
    "stop": (driven.Stop, {"stop"}),
    "hardening": (driven.Hardening, {"nonlinear_stiffness"}),
    "play": (driven.Play, {"backlash"}),
    "yielding": (driven.Hysteresis, {"hysteresis"}),
}


@pytest.mark.long
def test_sixty_late_channels(capsys):
    """Up to 10 ms either way, beside rough models and an effect: no law is named for a delay."""
    rng, inside, wrong = random.Random(7), 0, []
    for number in range(60):
        on_dyno = number % 2 == 0
        name = rng.choice(list(DYNO if on_dyno else DRIVEN))
        effect, families = (DYNO if on_dyno else DRIVEN)[name]
        delay_s = rng.choice([0.0, rng.uniform(0.0, 1e-2), -rng.uniform(0.0, 1e-2)])
        stiffness, damping, mass = (
            1.0 + share * rng.uniform(-1.0, 1.0) for share in (0.1, 0.3, 0.04)
        )
        if on_dyno:
            model = dyno.model(stiffness=stiffness * dyno.STIFFNESS, damping=damping * dyno.DAMPING)
            runs = [dyno_run(effect(), delay_s, 2 * number + k) for k in (1, 2)]
        else:
            model = bench.model(
                mass=mass * bench.MASS,
                stiffness=stiffness * bench.STIFFNESS,
                damping=damping * bench.DAMPING,
            )
            runs = [bench_run(effect, delay_s, 2 * number + k) for k in (1, 2)]
        found = diagnose(model, runs[:1], runs[1:]).diagnosis
        low, high, value = 0.0, 0.0, 0.0
        if found.channels:
            total = found.channels[0].total
            low, high, value = total.low or -np.inf, total.high or np.inf, total.value
        inside += low <= delay_s <= high or (not found.channels and abs(delay_s) < 5e-5)
        if laws(found) != families or (abs(value - delay_s) > 1e-4 and np.isfinite(low)):
            wrong.append((number, name, delay_s, found.effects, found.channels))
    with capsys.disabled():
        print(f"\n{inside} of 60 intervals hold the delay, {len(wrong)} wrong: {wrong}")
    assert inside >= 57
    assert not wrong


@pytest.mark.parametrize(("late_ms", "known_ms"), [(0.0, 0.0), (6.0, 0.0), (6.0, 2.0)])
def test_a_late_load_cell_of_a_driven_bench_is_found_by_the_corrected_model(late_ms, known_ms):
    """The times of a recording may be free of a part of the delay already."""
    known_s = {"strut_force_n:strut": 1e-3 * known_ms} if known_ms else {}
    runs = []
    for seed in (1, 2):
        run = bench.run(driven.Orifice(), seed=seed)
        height_m = run.heights_m[:, 0]
        velocity = np.gradient(height_m, run.t_s)
        force_n = -bench.STIFFNESS * (height_m - bench.FREE) - bench.DAMPING * velocity
        force_n -= 60.0 * velocity * np.abs(velocity)
        noise_n = 0.3 * np.random.default_rng(seed).standard_normal(len(force_n))
        late_n = np.interp(run.t_s - 1e-3 * (late_ms - known_ms), run.t_s, force_n) + noise_n
        runs.append(replace(run, strut_forces_n=late_n[:, np.newaxis], delays_s=known_s))
    found = diagnose(bench.model(), runs[:1], runs[1:]).diagnosis
    assert laws(found) == {"nonlinear_damping"}
    assert found.held_out.strut_force_rmse_n.after < 0.6
    if not late_ms:
        assert not found.channels
        return
    (channel,) = found.channels
    assert channel.channel == "strut_force_n:strut"
    assert channel.nominal == pytest.approx(1e-3 * known_ms)
    assert channel.total.value == pytest.approx(1e-3 * late_ms, abs=1e-4)


def test_a_wrong_zero_and_a_wrong_gain_of_a_load_cell_are_pointed_out():
    def seen(seed, gain, zero_n):
        run = dyno.run(dyno.Nothing(), seed=seed)
        return replace(run, strut_forces_n=gain * run.strut_forces_n + zero_n)

    found = diagnose(dyno.model(), [seen(1, 1.0, 25.0)], [seen(2, 1.0, 25.0)]).diagnosis
    assert any("a wrong zero of the load cell" in note for note in found.notes)
    assert not any("gain" in note for note in found.notes)
    found = diagnose(dyno.model(), [seen(1, 1.06, 0.0)], [seen(2, 1.06, 0.0)]).diagnosis
    (note,) = [note for note in found.notes if "gain" in note]
    assert "differ by the same share (+6 %)" in note
