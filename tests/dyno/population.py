"""How often a fault of a damper is named right, over simulated dampers that scatter.

    python -m tests.dyno.population --dampers 300 --seed 2

The dampers' equations are their own: a polytropic gas column, a law of damping with a sharp knee,
oil whose stiffness rises with pressure, an eye with play as a contact.
"""

import argparse
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from rig.dyno.characterise import ForceRecord, characterise_record
from rig.dyno.faults import name_faults
from rig.dyno.master import master_of
from rig.dyno.request import FigureRequest
from tests.evidence import add_page_option, command_line, table, write_evidence

RATE_HZ, AMPLITUDE_M, MIDDLE_M = 250.0, 0.025, 0.35
STEPS = ((0.004, 2.6), (0.05, 6.0), (0.1, 6.0), (0.2, 6.0), (0.4, 8.0), (0.8, 10.0))
"""Speed and cycles."""

FINER = 8
"""Steps of the simulation in a sample."""

SCATTER = 0.03
NOISE_N, NOISE_M = 3.0, 2e-6
PROPERTIES = ("gas_n", "friction_n", "below", "above", "opens", "below_up", "above_up", "opens_up")


@dataclass(frozen=True)
class Damper:
    """One damper; compression, and with `_up` rebound."""

    gas_n: float = 220.0
    column_m: float = 0.11
    friction_n: float = 18.0
    below: float = 3200.0
    above: float = 650.0
    opens: float = 0.12
    below_up: float = 5200.0
    above_up: float = 1100.0
    opens_up: float = 0.15
    give_m_per_n: float = 0.0
    play_m: float = 0.0

    def scattered(self, rng):
        factors = 1.0 + SCATTER * rng.standard_normal(len(PROPERTIES))
        changed = {
            name: getattr(self, name) * factor
            for name, factor in zip(PROPERTIES, factors, strict=True)
        }
        return replace(self, **changed)


FAULTS = {
    "good": lambda d, _rng: d,
    "gas pressure": lambda d, rng: replace(d, gas_n=d.gas_n * (1.0 - rng.uniform(0.2, 0.8))),
    "seal friction": lambda d, rng: replace(d, friction_n=d.friction_n + rng.uniform(15.0, 80.0)),
    "air in the oil": lambda d, rng: replace(d, give_m_per_n=rng.uniform(0.2e-6, 1.0e-6)),
    "play": lambda d, rng: replace(d, play_m=rng.uniform(0.2e-3, 1.0e-3)),
    "changed damping": lambda d, rng: weaker(d, rng.uniform(0.2, 0.5), int(rng.integers(3))),
    "early blow-off": lambda d, rng: early(d, rng.uniform(0.25, 0.6), int(rng.integers(3))),
}


def early(damper, share, which):
    """Compression, rebound or both."""
    down = damper.opens * (1.0 - share if which != 1 else 1.0)
    up = damper.opens_up * (1.0 - share if which != 0 else 1.0)
    return replace(damper, opens=down, opens_up=up)


def weaker(damper, share, which):
    """Compression, rebound or both, at all speeds."""
    down, up = (1.0 - share * (which != side) for side in (1, 0))
    return replace(
        damper,
        below=damper.below * down,
        above=damper.above * down,
        below_up=damper.below_up * up,
        above_up=damper.above_up * up,
    )


def record(damper, rng):
    """Times, measured heights and forces of a test."""
    x, force = [], []
    for speed, cycles in STEPS:
        omega = speed / AMPLITUDE_M
        count = round(cycles * 2.0 * np.pi / omega * RATE_HZ)
        t = np.arange(count * FINER) / (RATE_HZ * FINER)
        place, rate = AMPLITUDE_M * np.sin(omega * t), speed * np.cos(omega * t)
        x.append(place[::FINER])
        force.append(forces(damper, place, rate, 1.0 / (RATE_HZ * FINER))[::FINER])
    x_m, force_n = np.concatenate(x), np.concatenate(force)
    t_s = np.arange(len(x_m)) / RATE_HZ
    heights = MIDDLE_M + x_m + NOISE_M * rng.standard_normal(len(x_m))
    return t_s, heights, force_n + NOISE_N * rng.standard_normal(len(x_m))


def law(damper, v):
    """Damping: a line below the knee, a flatter one above."""
    down = v < 0.0
    below = np.where(down, damper.below, damper.below_up)
    above = np.where(down, damper.above, damper.above_up)
    opens = np.where(down, damper.opens, damper.opens_up)
    speed = np.abs(v)
    return -np.sign(v) * np.where(
        speed < opens, below * speed, below * opens + above * (speed - opens)
    )


def gas(damper, x):
    return damper.gas_n * (1.0 + x / damper.column_m) ** -1.3


def forces(damper, x, v, dt):
    """Forces of a motion."""
    if damper.play_m:
        return with_play(damper, x, v, dt)
    rubbing = -damper.friction_n * np.tanh(v / 1e-4)
    hydraulic = with_air(damper, v, dt) if damper.give_m_per_n else law(damper, v)
    return gas(damper, x) + rubbing + hydraulic


def with_air(damper, v, dt):
    """Bubbles give way at low pressure and hardly any more under load; implicit Euler."""
    found = np.empty_like(v)
    force = float(law(damper, v[:1])[0])
    down, up = (
        (damper.below, damper.above, damper.opens),
        (
            damper.below_up,
            damper.above_up,
            damper.opens_up,
        ),
    )
    for place, rate in enumerate(v.tolist()):
        stiffness = (1.0 + abs(force) / 600.0) / damper.give_m_per_n
        gained = stiffness * dt
        wanted = force - gained * rate
        below, above, opens = down if wanted > 0.0 else up
        size = abs(wanted)
        if size < opens * (below + gained):
            size = size / (1.0 + gained / below)
        else:
            size = (size - gained * (opens - below * opens / above)) / (1.0 + gained / above)
        force = size if wanted > 0.0 else -size
        found[place] = force
    return found


def with_play(damper, x, v, dt):
    """A contact on either side of a gap; the gas moves the piston where nothing holds it."""
    pushes = gas(damper, x)
    held = pushes - damper.friction_n * np.tanh(v / 1e-4) + law(damper, v)
    over = np.maximum(pushes - damper.friction_n, 0.0)
    bent = damper.below_up * damper.opens_up
    free = np.where(
        over < bent, over / damper.below_up, damper.opens_up + (over - bent) / damper.above_up
    )
    found = np.zeros_like(x)
    gap = 0.0
    for place, (force, rate, out) in enumerate(
        zip(held.tolist(), v.tolist(), free.tolist(), strict=True)
    ):
        if (gap <= 0.0 and force >= 0.0) or (gap >= damper.play_m and force <= 0.0):
            found[place] = force
        else:
            gap = min(max(gap + (rate - out) * dt, 0.0), damper.play_m)
    return found


def characterised(damper, seed):
    return characterise_record(
        ForceRecord(f"damper {seed}", *record(damper, np.random.default_rng(seed))),
        FigureRequest(lag_s=0.0),  # as beside a master whose load cell does not lag
    )


def one(job):
    """What a damper with a fault is named."""
    fault, seed = job
    rng = np.random.default_rng(seed)
    damper = FAULTS[fault](Damper().scattered(rng), rng)
    naming = name_faults(characterised(damper, seed), MASTER, SCATTER)
    return fault, [item.name for item in naming.named], naming, damper


TEXT = """
`rig characterise --master` compares a damper with a good one in the same test, and names its fault.
Here the dampers are simulated with equations other than those of the evaluation: a polytropic gas
column, a damping law with a sharp knee and, for the faults *air in the oil* and *play*, aerated
oil whose stiffness rises with pressure and free play as a contact.

Gas force and friction, and, independently in rebound and compression, the damping below and above
the knee and the speed of the knee scatter by {scatter:g} % (standard deviation) from damper to
damper; the master is the nominal damper. As many dampers are good as have a fault (`--dampers` is
the number of each); a fault is of a random size. No faults other than those in the table were
tested. A damper counts as named correctly if the kind of fault is right; the direction in the name
(compression, rebound or both) is not compared. The last column covers only these dampers: it counts
those whose 95 % interval contains the true size of the fault. It is empty where there is no single
true size: the compliance of the simulated aerated oil depends on the force, and a changed damping
has slightly different changes below and above the knee, because both scatter independently.
"""

PLANTED = {
    "good": "none (good damper)",
    "gas pressure": "gas pressure, a loss of 20 to 80 %",
    "seal friction": "seal friction, an increase of 15 to 80 N",
    "air in the oil": "air in the oil, 0.2 to 1 mm/kN at low pressure",
    "play": "play, 0.2 to 1 mm",
    "changed damping": "damping, a loss of 20 to 50 % at all speeds, in one direction or both",
    "early blow-off": "blow-off at a speed 25 to 60 % lower, in one direction or both",
}
"""What `FAULTS` draws."""

MASTER = None


def start():
    global MASTER  # noqa: PLW0603 - made once in each process
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    MASTER = master_of(characterised(Damper(), 0))


def jobs(dampers: int, seed: int) -> Iterator[tuple[str, int]]:
    """As many good ones as faulty ones."""
    faults = [name for name in FAULTS if name != "good"]
    for number in range(dampers):
        yield "good", 10_000_000 * seed + 2 * number
        yield faults[number % len(faults)], 10_000_000 * seed + 2 * number + 1


def short(names: list[str], is_good: bool) -> str:
    """What a damper was named, without the side."""
    if not names:
        return "good" if is_good else "without a name"
    return " + ".join(
        sorted({name.partition(" in compression")[0].partition(" in rebound")[0] for name in names})
    )


def true_sizes(fault, damper) -> list[float]:
    """Size of a fault against the master; none where its equations have no such size."""
    good = Damper()
    if fault == "gas pressure":
        return [1.0 - damper.gas_n / good.gas_n]
    if fault == "seal friction":
        return [damper.friction_n - good.friction_n]
    if fault == "play":
        return [1e3 * damper.play_m]
    if fault == "early blow-off":
        shares = [1.0 - damper.opens / good.opens, 1.0 - damper.opens_up / good.opens_up]
        return [share for share in shares if share > 0.2]
    return []


def study(dampers: int, seed: int, processes: int) -> Mapping[str, Counter[str]]:
    """What dampers were named, by what they are."""
    found: dict[str, Counter[str]] = {name: Counter() for name in FAULTS}
    with ProcessPoolExecutor(processes, initializer=start) as pool:
        for fault, names, naming, damper in pool.map(one, jobs(dampers, seed), chunksize=4):
            found[fault][short(names, naming.is_good)] += 1
            if short(names, naming.is_good) == fault:
                held = [
                    naming.named[0].size.low <= size <= naming.named[0].size.high
                    for size in true_sizes(fault, damper)
                ]
                found[fault]["(size held)"] += bool(held) and all(held)
            else:
                sizes = [f"{item.words()}, {item.evidence:.0f}" for item in naming.named]
                print(f"{fault}: {sizes or 'good'}, explained {naming.explained:.2f}, {damper}")
    return found


def row_of(fault: str, counts: Counter[str]) -> tuple[object, ...]:
    """A row of the page."""
    named = {name: count for name, count in counts.items() if name != "(size held)"}
    right, number = named.pop(fault, 0), sum(named.values())
    others = ", ".join(f"{count} {name}" for name, count in sorted(named.items()))
    has_size = bool(true_sizes(fault, FAULTS[fault](Damper(), np.random.default_rng(0))))
    held = f"{counts['(size held)']} of {right}" if has_size else ""
    return PLANTED[fault], right + number, right, others, held


def write_page(found: Mapping[str, Counter[str]]) -> None:
    """Write the guide's page."""
    heads = ("fault", "dampers", "named correctly", "named otherwise", "interval contains the size")
    write_evidence(
        "dyno-faults",
        "How often a damper's fault is named correctly",
        TEXT.format(scatter=100 * SCATTER),
        [table(heads, [row_of(*item) for item in found.items()])],
        command_line(),
        with_load=False,
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--dampers", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2)
    add_page_option(parser)
    given = parser.parse_args()
    found = study(given.dampers, given.seed, given.processes)
    for fault, counts in found.items():
        print(f"{fault:16} {dict(counts.most_common())}")
    if given.page:
        write_page(found)


if __name__ == "__main__":
    main()
