"""Benches whose base is moved as measured: a mass on a shaker, a quarter car, a car on posts.

They are simulated benches of `rig.simulated_bench`, which shares no code with the model, with one
to three undeclared effects in their suspensions. The model file is rough in springs, dampers and
wheels; the mass of the body sets the scale of all forces, and is right. Every height and every
position of the base has white noise. Unlike the cases of `tests.truth` a case has several struts.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dart_model.spec import MODELS, ModelSpec, dump_model, load_model
from rig.plan.config import CONFIGS
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig, StrutMotion, UndeclaredEffect
from rig.simulated_bench.trajectory import BenchTrajectory, simulate

KINDS = ("moving_shaker", "moving_quarter_car", "moving_posts")
RATE_HZ = 250
NOISE_M = {"moving_shaker": 1e-5, "moving_quarter_car": 1e-5, "moving_posts": 5e-6}
TRAIN_S, HELD_OUT_S = 10.0, 6.0
FREE_M = {"moving_shaker": 0.5, "moving_quarter_car": 0.5, "moving_posts": 0.6}
FAMILIES = {
    "friction": "friction",
    "cubic_stiffness": "nonlinear_stiffness",
    "bump_stop": "stop",
    "quadratic_damping": "nonlinear_damping",
}
PARAMETERS = {
    "friction": {"coulomb_force_n": (60.0, 250.0)},
    "cubic_stiffness": {"stiffness_n_per_m3": (3.0e6, 1.0e7)},
    "quadratic_damping": {"damping_n_s2_per_m2": (800.0, 3.0e3)},
    "bump_stop": {
        "contact_height_m": (0.0, 0.0),
        "contact_stiffness_n_per_m1_5": (1.0e6, 4.0e6),
        "dissipation_s_per_m": (0.0, 0.3),
    },
}
ROUGH_STIFFNESS, ROUGH_DAMPING, ROUGH_WHEEL = 0.1, 0.3, 0.05
STOP_AT = (1.0, 6.0)
"""Percentiles of the height without effects between which a stop begins."""


@dataclass(frozen=True)
class MovingCase:
    """A bench whose base is moved, and what is planted in it.

    Attributes:
        name: Unique in a benchmark.
        kind: One of `KINDS`.
        families: Families of the planted effects.
        effects: The effects, as the bench names them.
        bench: The bench with them.
        model: The model file, rough and without them.
        seed: From which all of it follows.
    """

    name: str
    kind: str
    families: tuple[str, ...]
    effects: tuple[UndeclaredEffect, ...]
    bench: BenchConfig
    model: ModelSpec
    seed: int


def make_moving(seed: int, kind: str) -> MovingCase:
    """Draw a case; equal seeds and kinds give equal cases."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    bench, spec = nominal_bench(kind), nominal_model(kind)
    struts = [strut.name for strut in spec.struts if strut.name.startswith("suspension")]
    names = rng.choice(list(FAMILIES), size=rng.choice([1, 1, 2, 3]), replace=False).tolist()
    where = [str(rng.choice(struts))] * len(names)
    still = moved_otherwise(bench, seed)
    heights = _simulated(still, TRAIN_S).height_m
    columns = {strut.name: index for index, strut in enumerate(bench.struts)}
    effects = tuple(
        _effect(rng, name, strut, heights[:, columns[strut]])
        for name, strut in zip(names, where, strict=True)
    )
    bench = bench.model_copy(update={"undeclared_effects": effects})
    families = tuple(FAMILIES[name] for name in names)
    return MovingCase(f"{kind}-{seed}", kind, families, effects, bench, _rough(rng, spec), seed)


def _effect(rng, name: str, strut: str, heights_m) -> UndeclaredEffect:
    values = {key: float(rng.uniform(*ends)) for key, ends in PARAMETERS[name].items()}
    if "contact_height_m" in values:
        values["contact_height_m"] = float(np.percentile(heights_m, rng.uniform(*STOP_AT)))
    return UndeclaredEffect(name=name, strut=strut, parameters=values)


def nominal_bench(kind: str) -> BenchConfig:
    if kind == "moving_posts":
        return load_bench_config(CONFIGS / "four_post_bench.yaml")
    bench = load_bench_config(CONFIGS / "quarter_car_road_bench.yaml")
    if kind == "moving_quarter_car":
        return bench
    content = bench.model_dump(mode="python")
    platform, _, body = content["masses"]
    shaker, _, suspension = content["struts"]
    (motion,) = content["prescribed_motion"]
    suspension = {**suspension, "between": (platform["name"], body["name"])}
    # The wheel no longer takes what the suspension is too soft for.
    motion["components"][0]["high_hz"] = 8.0
    content |= {
        "masses": [platform, body],
        "struts": [shaker, suspension],
        "transmissions": content["transmissions"][1:],
        "prescribed_motion": [motion],
    }
    return BenchConfig.model_validate(content)


def nominal_model(kind: str) -> ModelSpec:
    if kind == "moving_posts":
        return load_model(MODELS / "four_post.yaml")
    spec = load_model(MODELS / "quarter_car_road.yaml")
    if kind == "moving_quarter_car":
        return spec
    platform, _, body = spec.skeleton.bodies
    skeleton = spec.skeleton.model_copy(update={"bodies": (platform, body)})
    suspension = spec.struts[1].model_copy(update={"between": (platform.name, body.name)})
    return spec.model_copy(update={"skeleton": skeleton, "struts": (suspension,)})


def _rough(rng, spec: ModelSpec) -> ModelSpec:
    """The model with other springs and dampers of its suspensions, and other wheels."""

    def factor(reach: float) -> float:
        return 1.0 + reach * float(rng.uniform(-1.0, 1.0))

    bodies = tuple(
        body.model_copy(update={"mass_kg": body.mass_kg * factor(ROUGH_WHEEL)})
        if body.name.startswith("wheel")
        else body
        for body in spec.skeleton.bodies
    )
    struts = tuple(
        strut.model_copy(
            update={
                "stiffness_n_per_m": strut.stiffness_n_per_m * factor(ROUGH_STIFFNESS),
                "damping_n_s_per_m": strut.damping_n_s_per_m * factor(ROUGH_DAMPING),
            }
        )
        if strut.name.startswith("suspension")
        else strut
        for strut in spec.struts
    )
    skeleton = spec.skeleton.model_copy(update={"bodies": bodies})
    return spec.model_copy(update={"skeleton": skeleton, "struts": struts})


def moved_otherwise(bench: BenchConfig, seed: int) -> BenchConfig:
    """The bench with motions of its own, from a seed."""
    motions: list[StrutMotion] = []
    for place, motion in enumerate(bench.prescribed_motion):
        components = tuple(
            it.model_copy(update={"seed": 10 * seed + place}) for it in motion.components
        )
        motions.append(motion.model_copy(update={"components": components}))
    return bench.model_copy(update={"prescribed_motion": tuple(motions), "seed": seed})


def _simulated(bench: BenchConfig, duration_s: float) -> BenchTrajectory:
    return simulate(bench, round(duration_s * 1e9), round(1e9 / RATE_HZ))


def write_moving(case: MovingCase, folder: Path) -> None:
    """Write ``model.yaml``, ``train.csv`` and ``test.csv`` into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.yaml").write_text(dump_model(case.model), encoding="utf-8")
    for file, duration_s, seed in (
        ("train.csv", TRAIN_S, 2 * case.seed + 1),
        ("test.csv", HELD_OUT_S, 2 * case.seed + 2),
    ):
        columns = dict(_columns(case, duration_s, seed))
        np.savetxt(
            folder / file,
            np.column_stack(list(columns.values())),
            fmt="%.8f",
            delimiter=",",
            header=",".join(columns),
            comments="",
        )


def _columns(case: MovingCase, duration_s: float, seed: int) -> Iterator[tuple[str, np.ndarray]]:
    course = _simulated(moved_otherwise(case.bench, seed), duration_s)
    rng = np.random.default_rng(seed)
    heights = course.height_m + NOISE_M[case.kind] * rng.standard_normal(course.height_m.shape)
    names = [strut.name for strut in case.bench.struts]
    yield "t_s", course.t_ns * 1e-9
    moved = [motion.strut for motion in case.bench.prescribed_motion]
    for base, name in zip(moved, case.model.inputs, strict=True):
        yield f"motion_m:{name}", heights[:, names.index(base)]
    alone = len(case.model.struts) == 1
    for strut in case.model.struts:
        yield "height_m" if alone else f"height_m:{strut.name}", heights[:, names.index(strut.name)]


def moving_ratios(case: MovingCase) -> tuple[float, ...]:
    """RMS force of each effect in the run that is diagnosed, over that of the noise."""
    course = _simulated(moved_otherwise(case.bench, 2 * case.seed + 1), TRAIN_S)
    columns = {strut.name: index for index, strut in enumerate(case.bench.struts)}
    floor_n = force_noise_floor_n(case)
    found: list[float] = []
    for effect in case.effects:
        column = columns[effect.strut]
        height, velocity = course.height_m[:, column], course.velocity_m_per_s[:, column]
        force_n = _force_n(effect, height - FREE_M[case.kind], height, velocity)
        found.append(float(np.sqrt(np.mean(force_n**2))) / floor_n)
    return tuple(found)


def _force_n(effect: UndeclaredEffect, travel_m, height_m, velocity_m_per_s):
    """Force of an effect along a motion, without its sign."""
    values = effect.parameters
    match effect.name:
        case "friction":
            return np.full_like(height_m, values["coulomb_force_n"])
        case "cubic_stiffness":
            return values["stiffness_n_per_m3"] * travel_m**3
        case "quadratic_damping":
            return values["damping_n_s2_per_m2"] * velocity_m_per_s**2
        case _:
            depth_m = np.maximum(values["contact_height_m"] - height_m, 0.0)
            return values["contact_stiffness_n_per_m1_5"] * depth_m**1.5


def force_noise_floor_n(case: MovingCase) -> float:
    """RMS of the force that white noise of the heights seems to be below 25 Hz, in N.

    Twice differentiated, noise of a standard deviation sigma at a rate f has the RMS
    sigma (2 pi b)² sqrt(2 b / (5 f)) below a frequency b.
    """
    band_hz = 25.0
    noise = (2.0 * np.pi * band_hz) ** 2 * np.sqrt(2.0 * band_hz / (5.0 * RATE_HZ))
    return _moved_kg(case) * NOISE_M[case.kind] * float(noise)


def _moved_kg(case: MovingCase) -> float:
    """What a suspension's force moves: its wheel, and its share of the body."""
    masses = {body.name: body.mass_kg for body in case.bench.masses}
    share = masses["body"] / sum(it.name.startswith("suspension") for it in case.model.struts)
    wheels = [mass for name, mass in masses.items() if name.startswith("wheel")]
    return share if not wheels else 1.0 / (1.0 / share + 1.0 / wheels[0])
