"""What the machine did to a run stands in its record, and nothing where it did nothing."""

import json
import time

import pytest
import yaml

from rig.bus.link import LinkFigures
from rig.log.file_names import EVENTS_FILE, RUN_FILE
from rig.machine.clock import VirtualClock
from rig.machine.machine_state import ClockOffset, MachineReader
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.logged_run import Endpoint, run_with_log
from rig.run.loop import RunControl
from rig.run.machine_events import MachineEvents
from tests.run.listed import ListPort, bench_frames

S = 1_000_000_000
MS = 1_000_000


class Machine:
    """A machine with two cores, whose clocks and files do what they are told to."""

    def __init__(self, folder):
        self.folder = folder
        self.monotonic_ns, self.suspended_ns, self.wall_ns = 1000 * S, 0, 1_700_000_000 * S
        self.reading_ns = 300
        """What passes from one reading of a clock to the next."""

    def clock_ns(self, clock):
        self.monotonic_ns += self.reading_ns
        return self.monotonic_ns + {
            time.CLOCK_MONOTONIC: 0,
            time.CLOCK_BOOTTIME: self.suspended_ns,
            time.CLOCK_REALTIME: self.suspended_ns + self.wall_ns,
        }.get(clock)

    def write(self, name, text):
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")

    def reader(self, *cpus):
        return MachineReader(cpus or (0, 1), self.folder, self.clock_ns)


@pytest.fixture
def machine(tmp_path):
    return Machine(tmp_path / "cpu")


@pytest.fixture
def with_cpufreq(machine):
    for cpu in (0, 1):
        machine.write(f"cpu{cpu}/cpufreq/scaling_governor", "performance")
        machine.write(f"cpu{cpu}/cpufreq/scaling_max_freq", 3_600_000)
    machine.write("cpufreq/boost", 1)
    machine.write("intel_pstate/no_turbo", 0)
    return machine


FREQUENCY = {
    "governor": "performance",
    "max_frequency_khz": "3600000",
    "boost": "1",
    "no_turbo": "0",
}


def events_of(machine, *cpus):
    return MachineEvents(machine.reader(*cpus), lambda: 5 * S)


def look(events):
    return [json.loads(line) for line in events.look()]


def test_nothing_is_said_where_nothing_happened_and_nothing_is_known(machine):
    events = events_of(machine)
    machine.monotonic_ns += 3600 * S
    assert look(events) == []
    assert events.summary() == {"suspended_s": 0.0, "clock_steps": 0, "clock_stepped_s": 0.0}


def test_a_suspended_machine(machine):
    events = events_of(machine)
    machine.suspended_ns += 90 * S
    (line,) = look(events)
    assert line == {"t_s": 5.0, "machine": "suspended", "duration_s": pytest.approx(90.0)}
    assert look(events) == []
    machine.suspended_ns += 30 * S
    assert look(events)[0]["duration_s"] == pytest.approx(30.0)
    assert events.summary()["suspended_s"] == pytest.approx(120.0)
    assert events.summary()["clock_steps"] == 0


@pytest.mark.parametrize("step_s", [3600, -3600, 0.01])
def test_a_clock_that_is_set(machine, step_s):
    events = events_of(machine)
    machine.wall_ns += round(step_s * S)
    (line,) = look(events)
    assert line == {"t_s": 5.0, "machine": "clock_set", "step_s": pytest.approx(step_s)}
    assert look(events) == []
    summary = events.summary()
    assert (summary["clock_steps"], summary["suspended_s"]) == (1, 0.0)
    assert summary["clock_stepped_s"] == pytest.approx(step_s)


def test_a_thread_that_lost_its_core_between_two_clocks_sees_no_step_and_hides_none(machine):
    events = events_of(machine)
    machine.reading_ns = 500 * MS
    assert look(events) == []
    machine.wall_ns += 100 * MS
    assert look(events) == []  # it may have been the reading
    machine.reading_ns = 300
    assert look(events)[0]["step_s"] == pytest.approx(0.1)


def test_bounds_that_touch_have_not_moved():
    assert ClockOffset(5, 7).shift_ns(ClockOffset(7, 9)) == 0
    assert ClockOffset(5, 7).shift_ns(ClockOffset(8, 10)) == -3


@pytest.mark.parametrize(
    ("name", "text", "key", "now"),
    [
        ("cpu1/cpufreq/scaling_governor", "powersave", "governor", "performance, powersave"),
        ("cpu0/cpufreq/scaling_max_freq", 800_000, "max_frequency_khz", "3600000, 800000"),
        ("cpufreq/boost", 0, "boost", "0"),
        ("intel_pstate/no_turbo", 1, "no_turbo", "1"),
    ],
)
def test_slower_cores(with_cpufreq, name, text, key, now):
    events = events_of(with_cpufreq)
    assert look(events) == []
    assert events.summary()["frequency"] == {"begin": FREQUENCY, "end": FREQUENCY}
    with_cpufreq.write(name, text)
    changed = FREQUENCY | {key: now}
    assert look(events) == [
        {"t_s": 5.0, "machine": "frequency", "before": FREQUENCY, "now": changed}
    ]
    assert look(events) == []
    assert events.summary()["frequency"] == {"begin": FREQUENCY, "end": changed}


def test_a_core_that_the_loop_does_not_run_on_does_not_matter(with_cpufreq):
    events = events_of(with_cpufreq, 0)
    with_cpufreq.write("cpu1/cpufreq/scaling_governor", "powersave")
    assert look(events) == []


def test_cores_that_are_slowed_again_and_again_do_not_fill_the_disk(with_cpufreq, monkeypatch):
    monkeypatch.setattr("rig.run.machine_events._MOST_EVENTS", 3)
    events = events_of(with_cpufreq)
    lines = []
    for number in range(10):
        with_cpufreq.write("cpu0/cpufreq/scaling_max_freq", number)
        lines += look(events)
    assert len(lines) == 3
    assert events.summary()["frequency"]["end"]["max_frequency_khz"] == "3600000, 9"


def recorded(machine, folder, happening):
    """Events and ending of a run during which something happens to the machine."""
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=0.1)
    port = ListPort(bench_frames(ready, 100, {}), {})
    reader = None if machine is None else machine.reader()
    endpoint = Endpoint(port, VirtualClock(), LinkFigures(), begin=happening, machine=reader)
    run_with_log(ready, build_bridge(ready), endpoint, folder, RunControl())
    lines = [json.loads(line) for line in (folder / EVENTS_FILE).read_text().splitlines()]
    return lines, yaml.safe_load((folder / RUN_FILE).read_text())["ending"]["machine"]


def test_it_stands_in_the_record_of_a_run(with_cpufreq, tmp_path):
    def happening():
        with_cpufreq.suspended_ns += 90 * S
        with_cpufreq.write("cpufreq/boost", 0)

    lines, ending = recorded(with_cpufreq, tmp_path / "run", happening)
    found = [line for line in lines if "machine" in line]
    assert [line["machine"] for line in found] == ["suspended", "frequency"]
    assert ending["suspended_s"] == pytest.approx(90.0)
    assert ending["frequency"]["begin"]["boost"] == "1"
    assert ending["frequency"]["end"]["boost"] == "0"


def test_a_simulated_run_says_nothing_of_the_machine(tmp_path):
    lines, ending = recorded(None, tmp_path / "run", lambda: None)
    assert all("machine" not in line for line in lines)
    assert ending is None


def test_this_machine_is_read():
    state = MachineReader((0,)).read()
    assert state.suspended.low_ns <= state.suspended.high_ns
    assert state.suspended.high_ns >= 0
    wall_ns = time.time_ns() - time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    assert state.wall.low_ns == pytest.approx(wall_ns, abs=S)
