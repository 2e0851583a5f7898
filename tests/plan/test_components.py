"""A second engine and a second observer: one file and one line each, the core untouched.

Both are made in a process of their own, because the tables are read when the program begins.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOY = '''
"""A body on a spring and damper in Python, and an observer that is proportional alone."""
import json, sys
from pathlib import Path
from typing import Literal, NamedTuple

from msgspec import Struct
from pydantic.dataclasses import dataclass
from rig.observers.protocol import Remark

class State(Struct, frozen=True):
    height_m: float
    velocity_m_per_s: float

    @property
    def struts(self):
        return [(self.height_m, self.velocity_m_per_s)]

class Loaded(Struct, frozen=True):
    state: State
    virtual_n: float
    forces_n: list[float]
    accelerations_m_per_s2: list[float]
    inputs: tuple[float, ...]
    temperature_c: float

class ToyPlant:
    """Semi-implicit Euler in tenths of a step: enough to be followed by an observer."""
    struts = 1
    inputs = 1
    internal_states = 0
    is_constant = True

    def __init__(self, spec):
        (self.strut,), (body,) = spec.struts, spec.skeleton.bodies
        self.mass_kg, self.gravity = body.mass_kg, spec.gravity_m_per_s2

    def init(self, heights_m, velocities_m_per_s=None, t_s=0.0, inputs=None):
        return State(heights_m[0], (velocities_m_per_s or [0.0])[0])

    def force_n(self, state):
        s = self.strut
        return s.stiffness_n_per_m * (s.free_length_m - state.height_m) - (
            s.damping_n_s_per_m * state.velocity_m_per_s)

    def load(self, state, virtual_forces_n, inputs, temperature_c):
        force_n = self.force_n(state)
        a = (force_n + virtual_forces_n[0] + inputs[0]) / self.mass_kg - self.gravity
        return Loaded(state, virtual_forces_n[0], [force_n], [a], inputs, temperature_c)

    def step(self, loaded, dt_s, inputs_end):
        state, h = loaded.state, dt_s / 10
        for k in range(10):
            (begin_n,), (end_n,) = loaded.inputs, inputs_end
            applied_n = begin_n + (k + 0.5) / 10 * (end_n - begin_n)
            at = self.load(state, [loaded.virtual_n], (applied_n,), 20.0)
            v = state.velocity_m_per_s + h * at.accelerations_m_per_s2[0]
            state = State(state.height_m + h * v, v)
        return state

    def slopes(self, _state, _applied_force_n, _temperature_c):
        return None

    def numbers(self, state):
        return state.height_m, state.velocity_m_per_s

    def state_of(self, numbers, _t_s=0.0, _inputs=None):
        return State(*numbers)

class Held(NamedTuple):
    innovation_m: float
    virtual_force_n: float
    measured_ns: int
    force_std_n: float = float("nan")
    left_out: tuple = ()
    is_disturbed: bool = False

    @property
    def residual_force_n(self):
        return self.virtual_force_n

@dataclass(frozen=True)
class Proportional:
    kind: Literal["proportional"] = "proportional"
    gain_n_per_m: float = 1e5

    measurements_to_start = 1
    requires_height = estimates_force = True
    fuses_sensors = knows_std = is_joinable = False
    height_std_m = force_filter = None
    force_limit_n = 1e4

    def init(self, start):
        return Held(0.0, 0.0, start.t_ns)

    steady_state = init

    def step(self, state, t_ns, innovation):
        if innovation is None:
            return state
        force_n = self.gain_n_per_m * innovation.value
        return Held(innovation.value, force_n, innovation.t_ns)

    def longest_gap_ns(self, interval_ns):
        return 10 * interval_ns

    def settling_ns(self, decay_ns):
        return decay_ns

    def restart(self, state, start):
        return self.init(start)

    def numbers(self, state):
        return (state.virtual_force_n,)

    def with_numbers(self, state, numbers):
        return Held(0.0, numbers[0], 0)

    def can_continue(self, other):
        return type(other) is type(self)

    def remark_on_step(self, step):
        return Remark("", False)

    def remark_on_rate(self, rate_hz):
        return None

import rig.observers as observers
observers.OBSERVERS = {**observers.OBSERVERS, "proportional": Proportional}
import rig.plan.build as build
build.ENGINES = {**build.ENGINES, "toy": ToyPlant}

from rig.simulated_bench.config import load_bench_config
from rig.log.reader import read_run
from rig.plan.preflight_checks import check
from rig.plan.config import CONFIGS
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.plan.load import load_plan

folder = Path(sys.argv[1])
text = (CONFIGS / "reference.yaml").read_text()
text = text[: text.index("observers:")] if "observers:" in text else text
(folder / "toy.yaml").write_text(
    text + "\\nengine: toy\\nobservers: {strut: {kind: proportional, gain_n_per_m: 5.0e4}}\\n")
ready = load_plan(folder / "toy.yaml", duration_s=1.0)
with_bench(ready, load_bench_config(CONFIGS / "reference_bench.yaml"), folder / "run",
           lockstep=True)
steps = read_run(folder / "run").steps
found = replay(folder / "run")
print(json.dumps({
    "different": found.different, "ticks": found.logged,
    "innovation_m": max(map(abs, steps.column("strut.innovation_m").to_pylist()[500:])),
    "poles": {item.what: item.severity.value for item in check(ready)}["poles"],
    "dart": "dartpy" in sys.modules}))
'''


@pytest.mark.slow
def test_another_engine_and_another_observer_run_replay_and_are_checked(tmp_path: Path) -> None:
    script = tmp_path / "toy.py"
    script.write_text(TOY)
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert (found["ticks"], found["different"]) == (1000, 0)
    # The bench's force is a few hundred newtons; proportional control leaves that over the gain.
    assert found["innovation_m"] < 0.01
    assert found["poles"] in ("ok", "warning")


QUANTITY = '''
"""A further measured quantity: the pressure of the gas."""
import json, re, sys
from pathlib import Path

import rig.channels.measured_quantities as quantities
from can_dbc.units import Dimension
GAS = quantities.Quantity("humidity", "humidity", Dimension.NUMBER, "relative humidity")
quantities.BENCH_QUANTITIES = (*quantities.BENCH_QUANTITIES, GAS)

from can_dbc.database import DEFAULT_DATABASE
from rig.simulated_bench.config import load_bench_config
from rig.formats.export import export_run
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.plan.load import load_plan

folder = Path(sys.argv[1])
# The auxiliary message's temperature without a unit stands for it.
dbc = DEFAULT_DATABASE.read_text().replace('"degC" RIG', '"" RIG')
(folder / "my.dbc").write_text(dbc)
text = (CONFIGS / "reference.yaml").read_text().replace("temperature:", "humidity:")
(folder / "my.yaml").write_text(text + "\\ndbc: my.dbc\\n")
ready = load_plan(folder / "my.yaml", duration_s=0.5)
bench = load_bench_config(CONFIGS / "reference_bench.yaml")
bench = bench.model_copy(update={"transmissions": bench.transmissions[:1]})
with_bench(ready, bench, folder / "run", lockstep=True)
export_run(folder / "run", "csv", folder / "run.csv")
print(json.dumps({
    "columns": read_run(folder / "run").steps.schema.names,
    "csv": (folder / "run.csv").read_text().splitlines()[0],
    "different": replay(folder / "run").different}))
'''


@pytest.mark.slow
def test_a_further_quantity_reaches_configuration_log_replay_and_csv(tmp_path: Path) -> None:
    script = tmp_path / "quantity.py"
    script.write_text(QUANTITY)
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert "humidity" in found["columns"]
    assert "strut_force_n" in found["columns"]
    assert '"humidity"' in found["csv"]
    assert found["different"] == 0
