"""How often intervals of a whole test day hold: `python -m tests.dyno.many_days [--days N]`."""

import argparse
import math
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np

from can_dbc.errors import InputError
from rig.dyno.characterise import characterise_record
from rig.dyno.figures import SIDES, ForceRecord
from tests.dyno.days import Day, Step
from tests.dyno.population import Damper, gas, law
from tests.evidence import add_page_option, command_line, table, write_evidence

SPEEDS = (0.003, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.3)
RATES_HZ = (200.0, 500.0, 1000.0, 2000.0, 5000.0)
FAULTS = ("none", "lag", "drift", "clipping", "spikes")
FIGURES = ("force", "energy", "rate", "gas", "friction", "knee", "per kelvin")

TEXT = """
{days} test days are simulated, of dampers whose equations are not those of the evaluation: a
polytropic gas column, dry friction, and valves with a sharp knee whose damping may fall with
temperature. Drawn at random are all properties of the damper; one to eight of eight speeds from 3
mm/s to 1.3 m/s; amplitude (12.5 to 50 mm), cycles (4 to 12; 1 to 3 of the slow step) and rests (0
to 2 s); whether the machine builds up its amplitude over a cycle; the sampling rate (200 to 5 000
Hz, at least 20 samples a cycle); the noise of the force (0.1 to 1 % of its peak); and one of these
faults: a lag of the force of 1 to 10 ms, a drift of the zero by 5 to 20 % of the peak force,
clipping at 50 to 90 % of it, before or behind the noise, or up to five spikes.

The table gives the share of the 95 % intervals that contain the true value, and their number, for
each fault. Friction and gas force are those without damping where a second step is slow enough to
know it, else those at the speed of the slowest step. Without two rests, the zero is that at the
first cycle. A bound counts as right if the true value is beyond it. *Missing* is the share of steps
that are not reported, *ordinary* the share of clipped forces that are given as ordinary figures.
"""


def drawn(rng):
    """A day at random, and its fault."""
    factors = {
        name: getattr(Damper(), name) * float(rng.uniform(0.6, 1.6))
        for name in ("gas_n", "friction_n", "below", "above", "opens", "below_up", "above_up")
    }
    damper = replace(Damper(), **factors, opens_up=0.15 * float(rng.uniform(0.6, 1.6)))
    count = int(rng.integers(1, 9))
    speeds = sorted(rng.choice(SPEEDS, count, replace=False).tolist())
    if count > 2 and rng.random() < 0.5:
        speeds = [speeds[-2], *speeds]  # a speed of the end at the beginning as well
    amplitude_m = float(rng.choice([0.0125, 0.025, 0.05]))
    steps = tuple(
        Step(
            amplitude_m,
            speed,
            int(rng.integers(1, 4)) if speed < 0.01 else int(rng.integers(4, 13)),
            float(rng.choice([0.0, 0.2, 0.35, 0.5, 1.0, 2.0])),
        )
        for speed in speeds
    )
    fastest_hz = max(step.omega for step in steps) / (2.0 * math.pi)
    rates = [rate for rate in RATES_HZ if rate > 20.0 * fastest_hz]
    bare = Day(damper, steps)
    peak_n = max(np.abs(bare.truth(index)).max() for index in range(len(steps)))
    fault = str(rng.choice(FAULTS))
    return Day(
        damper,
        steps,
        rate_hz=float(rng.choice(rates)),
        noise_n=peak_n * float(rng.choice([0.001, 0.003, 0.01])),
        lag_s=float(rng.uniform(1e-3, 1e-2)) if fault == "lag" else 0.0,
        drift_n=peak_n * float(rng.uniform(0.05, 0.2)) if fault == "drift" else 0.0,
        clips_n=peak_n * float(rng.uniform(0.5, 0.9)) if fault == "clipping" else math.inf,
        clips_noise=bool(rng.integers(0, 2)),
        spikes=int(rng.integers(1, 6)) if fault == "spikes" else 0,
        ramp=bool(rng.integers(0, 2)),
        warms_k=float(rng.choice([0.0, 15.0])),
        per_kelvin=-float(rng.choice([0.0, 0.002])),
    ), fault


def rate_of(day):
    """Slope of the gas force over the inner 90 % of the stroke, by least squares."""
    inner = np.linspace(-0.9, 0.9, 2001) * day.steps[0].amplitude_m
    return -float(np.polyfit(inner, gas(day.damper, inner), 1)[0])


def energy_of(day, index):
    """Work of a cycle at the mean temperature of a step."""
    step = day.steps[index]
    warm_k = float(
        np.mean(day.warm_k(day.starts_s()[index] + np.linspace(0.0, step.length_s, 101)))
    )
    angle = np.linspace(0.0, 2.0 * math.pi, 20001)
    x, v = step.amplitude_m * np.sin(angle), step.speed_m_per_s * np.cos(angle)
    return -float(np.trapezoid(day.force(x, v, warm_k), x))


def one(seed):
    """Fault, hits by figure, how many steps are missing, and clipped forces by what is given."""
    day, fault = drawn(np.random.default_rng(seed))
    record = ForceRecord("day", *day.record(seed[-1]), temperature_c=day.temperatures(seed[-1]))
    hits = defaultdict(list)
    try:
        found = characterise_record(record)
    except InputError:
        return fault, hits, (len(day.steps), len(day.steps)), (0, 0)
    # A zero that drifts is that of the time from which on it is known.
    drift = found.corrections.drift
    zero_n = 0.0 if drift is None else day.drift_n * drift.begin_s / day.length_s

    def add(name, figure, truth):
        if figure is not None:
            hits[name].append(figure.low <= truth <= figure.high)

    steps, forces = of_steps(day, found, zero_n, add)
    of_damper(day, found, zero_n, add)
    return fault, hits, steps, forces


def of_steps(day, found, zero_n, add):
    """Missing steps and all, clipped forces that are given as ordinary and all."""
    missing, ordinary, clipped = 0, 0, 0
    for index, begin_s in enumerate(day.starts_s()):
        end_s = begin_s + day.steps[index].length_s
        step = next((it for it in found.steps if begin_s < it.begin_s + 0.1 < end_s), None)
        if step is None:
            missing += 1
            continue
        truths_n = day.truth(index)
        for side, truth_n in zip((step.compression, step.rebound), truths_n, strict=True):
            figure = side.force_at_peak_velocity_n
            add("force", figure, truth_n + zero_n)
            if abs(truth_n) > 1.02 * day.clips_n:
                clipped += 1
                ordinary += figure.is_bounded
        add("energy", step.energy_per_cycle_j, energy_of(day, index))
        add("rate", step.spring_rate_n_per_m, rate_of(day))
    return (missing, len(day.steps)), (ordinary, clipped)


def of_damper(day, found, zero_n, add):
    """Figures over all steps."""
    true, damper = day.damper, found.damper
    gas_n, friction_n = true.gas_n, true.friction_n
    if any("with what bleeds there" in note for note in damper.notes):
        index = int(np.argmin([step.speed_m_per_s for step in day.steps]))
        down_n, up_n = day.truth(index)
        gas_n, friction_n = 0.5 * (down_n + up_n), 0.5 * (down_n - up_n)
    add("gas", damper.gas_force_n, gas_n + zero_n)
    add("friction", damper.friction_n, friction_n)
    for side, opens in zip(SIDES, (true.opens, true.opens_up), strict=True):
        add("knee", damper.knee_m_per_s[side], opens)
        slope = damper.force_per_kelvin_n_per_k[side]
        if slope is not None:
            speed = float(slope.method.split(" m/s")[0].split()[-1])
            sign = -1.0 if side == "compression" else 1.0
            add("per kelvin", slope, day.per_kelvin * float(law(true, np.array(sign * speed))))


def study(days, seed, each=map):
    """By fault: hits by figure, missing steps and all, clipped forces given as ordinary and all."""
    found = {fault: (defaultdict(list), [0, 0], [0, 0]) for fault in FAULTS}
    for fault, hits, steps, forces in each(one, [[seed, number] for number in range(days)]):
        for name, values in hits.items():
            found[fault][0][name] += values
        for sums, pair in ((found[fault][1], steps), (found[fault][2], forces)):
            sums[0] += pair[0]
            sums[1] += pair[1]
    return found


def rows_of(found):
    """A row for each fault, and one for all."""
    rows = []
    for fault, (hits, steps, forces) in found.items():
        cells = [
            f"{np.mean(hits[name]):.3f} ({len(hits[name])})" if hits[name] else "–"
            for name in FIGURES
        ]
        ordinary = f"{forces[0]} of {forces[1]}" if forces[1] else "–"
        rows.append((fault, *cells, f"{steps[0]} of {steps[1]}", ordinary))
    return rows


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--days", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    add_page_option(parser)
    given = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        found = study(given.days, given.seed, pool.map)
    heads = ("fault", *FIGURES, "missing", "ordinary")
    rows = rows_of(found)
    for row in (heads, *rows):
        print("  ".join(f"{cell!s:14}" for cell in row))
    if given.page:
        write_evidence(
            "dyno-days",
            "How often the figures of a whole test day are right",
            TEXT.format(days=given.days),
            [table(heads, rows)],
            command_line(),
            with_load=False,
        )


if __name__ == "__main__":
    main()
