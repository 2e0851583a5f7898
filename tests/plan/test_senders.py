"""A bus without CRCs: a counter, or the time of the sample, in the frames of a sensor."""

import json

import numpy as np
import pytest
import yaml

from can_dbc.codec import compile_decoder, compile_encoder
from can_dbc.database import load_database
from can_dbc.errors import InputError
from can_dbc.frame import Frame
from can_dbc.units import Dimension
from rig.bridge.values import Mode
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import Severity, check
from rig.recordings.run_folder import _samples
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate

MS = 1_000_000
DBC = """VERSION ""
NS_ :
BS_:
BU_: SENSOR CONTROL
BO_ 288 SENSOR_1: 8 SENSOR
 SG_ Travel : 0|20@1- (0.002,0) [0|0] "mm" CONTROL
 SG_ Actuator : 20|20@1- (0.01,0) [0|0] "N" CONTROL
 SG_ Alive : 40|4@1+ (1,0) [0|14] "" CONTROL
 SG_ Stamp : 44|16@1+ (20,0) [0|0] "us" CONTROL
 SG_ Mode : 60|1@1+ (1,0) [0|1] "" CONTROL
BO_ 400 CONTROL_1: 8 CONTROL
 SG_ EstimatedForce : 0|24@1- (0.01,0) [0|0] "N" SENSOR
 SG_ ForceOk : 24|1@1+ (1,0) [0|1] "" SENSOR
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 288 1;
"""


MODE = ' SG_ Mode : 60|1@1+ (1,0) [0|1] "" CONTROL'


def config_with(folder, height=None, applied=None):
    """The reference case on a bus without protection, with some keys of its two signals."""
    (folder / "my.dbc").write_text(DBC)
    config = {
        "model": "reference",
        "dbc": "my.dbc",
        "bus": {"interface": "virtual", "channel": "senders"},
        "signals": {
            "height": {"message": "SENSOR_1", "signal": "Travel"} | (height or {}),
            "applied_force": {"message": "SENSOR_1", "signal": "Actuator"}
            | ((height if applied is None else applied) or {}),
        },
        "publish": {
            "force": {"message": "CONTROL_1", "signal": "EstimatedForce"},
            "valid": {"message": "CONTROL_1", "signal": "ForceOk"},
        },
        "observers": {
            "strut": {"kind": "kalman", "filter": {"bandwidth_hz": 19.0, "noise_std_m": 2e-6}}
        },
    }
    path = folder / "my.yaml"
    path.write_text(json.dumps(config))  # YAML as well, and without aliases
    return path


def bench_with(folder, **sender):
    """The reference bench on that bus."""
    content = yaml.safe_load((CONFIGS / "reference_bench.yaml").read_text())
    content["transmissions"] = [
        {
            "message": "SENSOR_1",
            "height": {"signal": "Travel", "strut": content["struts"][0]["name"]},
            "applied_force": {"signal": "Actuator"},
            **sender,
        }
    ]
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(content))
    return SimulatedBench(load_bench_config(path), load_database(folder / "my.dbc"))


def run(bridge, bench, until_ms, arriving=lambda _ms, frames: frames):
    """Modes and forces of a run whose frames arrive as a function has it, its counts, frames."""
    state, ticks, every = bridge.init(0), [], []
    for ms in range(until_ms):
        frames = arriving(ms, bench.update(ms * MS)[0])
        every += frames
        state, result = bridge.tick(state, ms * MS, frames)
        ticks.append(result.output)
    return ticks, state.counts, every


def test_a_gateway_that_repeats_its_last_frame_is_noticed_by_the_counter(tmp_path):
    bridge = build_bridge(load_plan(config_with(tmp_path, {"counter": "Alive"})))
    bench, last = bench_with(tmp_path, counter="Alive"), []

    def arriving(ms, frames):
        last[:] = last if 1000 <= ms < 1100 else frames
        return [Frame(ms * MS, frame.arbitration_id, frame.data) for frame in last]

    ticks, counts, _ = run(bridge, bench, 1600, arriving)
    # Two more until a counter that has jumped is believable.
    assert (counts.repeated, counts.out_of_sequence, counts.refused) == (100, 2, 102)
    assert ticks[999].mode is ticks[-1].mode is Mode.RUNNING
    assert Mode.RUNNING not in {tick.mode for tick in ticks[1011:1100]}


@pytest.mark.parametrize("counter", [{}, {"counter": "Alive"}])
def test_frames_with_the_sensors_time_are_used_where_they_belong(tmp_path, counter):
    """A gateway holds them back for 8 ms, again and again, and their sampling is not even."""
    keys = {"time": "Stamp", **counter}
    plan = load_plan(config_with(tmp_path, keys))
    bench = bench_with(tmp_path, **keys)
    held = []

    def arriving(ms, frames):
        held.extend(frames)
        if ms > 600 and ms % 200 < 8:
            return []
        kept = [Frame(ms * MS, frame.arbitration_id, frame.data) for frame in held]
        held.clear()
        return kept

    ticks, counts, frames = run(build_bridge(plan), bench, 2600, arriving)
    truth_n = simulate(bench.config, 2600 * MS, MS).strut_force_n[:, 0]
    errors_n = np.array(
        [
            abs(tick.struts[0].force_n - truth)
            for tick, truth in zip(ticks, truth_n, strict=False)
            if tick.struts and tick.struts[0].valid
        ]
    )
    assert len(errors_n) > 2000
    assert errors_n.max() < 20.0  # of a peak of 429 N
    assert not counts.refused
    # And in the recording that a diagnosis reads.
    data = np.frombuffer(b"".join(frame.data for frame in frames), np.uint8).reshape(-1, 8)
    arrivals_ns = np.array([frame.t_ns for frame in frames])
    t_s, _ = _samples({"SENSOR_1": (arrivals_ns, data)}, plan.heights[0])
    assert np.diff(t_s[200:]) == pytest.approx(1e-3, abs=2e-6)


@pytest.mark.parametrize(
    ("height", "applied", "text"),
    [
        ({"counter": "Nothing"}, None, r"height\.strut\.counter: .*Nothing"),
        ({"counter": "Travel"}, None, r"height\.strut\.counter: Travel has the unit mm"),
        ({"counter": "Mode"}, None, r"counter: .*Mode: expected an unsigned integer of 2 to 32"),
        ({"time": "Nothing"}, None, r"height\.strut\.time: .*Nothing"),
        ({"time": "Travel"}, None, r"height\.strut\.time: .*mm"),
        ({"time": "Alive"}, None, r"height\.strut\.time: .*no unit"),
        ({"counter": "Alive"}, {}, r"applied_force\.counter: none, expected Alive, as for the"),
        ({"time": 5}, None, r"time"),
    ],
)
def test_what_cannot_be_a_counter_or_a_time_is_one_line(tmp_path, height, applied, text):
    with pytest.raises(InputError, match=text) as error:
        load_plan(config_with(tmp_path, height, applied))
    assert "\n" not in str(error.value)


def test_a_protected_message_has_its_counter_already(tmp_path):
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    config["signals"]["height"]["counter"] = "COUNTER"
    path = tmp_path / "my.yaml"
    path.write_text(yaml.safe_dump(config))
    with pytest.raises(InputError, match="BENCH_MEASUREMENT is protected, expected none: its"):
        load_plan(path)


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({}, "when their frames arrive: expected a time signal"),
        ({"counter": "Alive"}, "by counter and cycle time"),
        ({"counter": "Alive", "time": "Stamp"}, "by Stamp, whatever"),
    ],
)
def test_check_reports_which_one_is_in_use(tmp_path, keys, text):
    findings = check(load_plan(config_with(tmp_path, keys)))
    (found,) = [item for item in findings if item.what == "sample times of SENSOR_1"]
    assert text in found.text


@pytest.mark.parametrize("copies", [1, 7, 8, 16])
def test_a_frame_that_is_sent_again_and_again_is_not_fresh_by_its_time(tmp_path, copies):
    """As often as it takes for a constant delay, each tick."""
    bridge = build_bridge(load_plan(config_with(tmp_path, {"time": "Stamp"})))
    bench, last = bench_with(tmp_path, time="Stamp"), []

    def arriving(ms, frames):
        if ms < 1000:
            last[:] = frames
            return frames
        return [Frame(ms * MS, frame.arbitration_id, frame.data) for frame in last] * copies

    ticks, counts, _ = run(bridge, bench, 1400, arriving)
    assert ticks[999].mode is Mode.RUNNING
    assert Mode.RUNNING not in {tick.mode for tick in ticks[1011:]}
    assert counts.untimed >= 390 * copies


def with_signals(folder, replaced, **keys):
    """A plan of the bus with another time signal or counter."""
    path = config_with(folder, keys)
    (folder / "my.dbc").write_text(DBC.replace(*replaced))
    return load_plan(path)


STAMP = ' SG_ Stamp : 44|16@1+ (20,0) [0|0] "us" CONTROL'
ALIVE = ' SG_ Alive : 40|4@1+ (1,0) [0|14] "" CONTROL'


@pytest.mark.parametrize(
    ("key", "old", "new", "text"),
    [
        ("time", STAMP, STAMP.replace("[0|0]", "[0|1000]"), r"begins again after 0\.00102 s"),
        ("time", STAMP, STAMP.replace("44|16", "44|1"), "begins again after 4e-05 s"),
        ("time", STAMP, STAMP.replace("(20,0)", "(2000,0)"), r"steps of 0\.002 s, .* a cycle"),
        ("counter", ALIVE, ALIVE.replace("[0|14]", "[0|2]"), "maximum 2, expected at least 3"),
        ("counter", ALIVE, ALIVE.replace("[0|14]", "[-9|-5]"), "expected an unsigned integer"),
        ("counter", ALIVE, ALIVE.replace("[0|14]", "[0|0.5]"), r"maximum 0\.5"),
    ],
)
def test_a_time_or_counter_that_shows_nothing_is_one_line(tmp_path, key, old, new, text):
    name = {"time": "Stamp", "counter": "Alive"}[key]
    with pytest.raises(InputError, match=rf"{key}: .*{text}"):
        with_signals(tmp_path, (old, new), **{key: name})


@pytest.mark.parametrize("value", [2, -1, 0.5])
def test_a_valid_value_that_its_signal_cannot_hold_is_one_line(tmp_path, value):
    path = config_with(tmp_path, {"valid": {"signal": "Mode", "value": value}})
    text = rf"valid\.value: {value}, expected what Mode can hold, 0 to 1 in steps of 1"
    with pytest.raises(InputError, match=text):
        load_plan(path)


FLOAT = """ SG_ Mode : 32|32@1- (1,0) [0|0] "" CONTROL
SIG_VALTYPE_ 288 Mode : 1;"""


@pytest.mark.parametrize(
    "mode", [' SG_ Mode : 60|4@1+ (0.1,0) [0|1.5] "" CONTROL', FLOAT], ids=["steps", "float"]
)
def test_a_valid_value_is_met_as_its_signal_holds_it(tmp_path, mode):
    """Three steps of a tenth are not what a file writes as 0.3, nor is a float of 32 bits."""
    path = config_with(tmp_path, {"valid": {"signal": "Mode", "value": 0.3}})
    signal, *types = mode.splitlines()
    text = DBC.replace(MODE, signal).replace("20|20@1-", "20|12@1-") + "".join(
        f"{line}\n" for line in types
    )
    kept = [line for line in text.splitlines() if not types or line not in (ALIVE, STAMP)]
    (tmp_path / "my.dbc").write_text("\n".join(kept) + "\n")
    bridge = build_bridge(load_plan(path))
    encode = compile_encoder(
        load_database(tmp_path / "my.dbc").message("SENSOR_1"),
        ["Travel", "Actuator", "Mode"],
        [Dimension.LENGTH, Dimension.FORCE, Dimension.NUMBER],
    )
    for value, refused in ((0.3, 0), (0.2, 1)):
        frame = Frame(0, 288, encode([0.4, 0.0, value])[0])
        state, _ = bridge.tick(bridge.init(0), MS, [frame])
        assert state.counts.no_value == refused


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"counter": "Alive", "valid": {"signal": "Alive"}}, "counter: Alive is valid.signal"),
        ({"time": "Stamp", "valid": {"signal": "Travel"}}, "valid.signal: Travel"),
        ({"counter": "Travel"}, "counter: Travel"),
    ],
)
def test_a_signal_has_one_meaning_in_an_entry(tmp_path, keys, text):
    with pytest.raises(InputError, match=text):
        load_plan(config_with(tmp_path, keys, {}))


def test_a_load_cell_is_not_the_applied_force(tmp_path):
    path = config_with(tmp_path)
    config = json.loads(path.read_text())
    config["signals"]["load_cell_force"] = config["signals"]["applied_force"]
    path.write_text(json.dumps(config))
    with pytest.raises(InputError, match=r"SENSOR_1\.Actuator is .* already, expected another"):
        load_plan(path)


def test_a_truth_value_is_no_time(tmp_path):
    """`delay_s: yes` would be a second."""
    with pytest.raises(InputError, match="delay_s: True: expected a number"):
        load_plan(config_with(tmp_path, {"delay_s": True}, {}))


def test_a_counter_on_another_page_than_the_height_is_one_line(tmp_path):
    paged = ALIVE.replace("Alive :", "Alive m1 :"), ' SG_ Mode M : 60|1@1+ (1,0) [0|1] "" CONTROL'
    travel = " SG_ Travel : 0|20"
    path = config_with(tmp_path, {"counter": "Alive"})
    text = DBC.replace(ALIVE, paged[0]).replace(travel, " SG_ Travel m0 : 0|20")
    (tmp_path / "my.dbc").write_text(text.replace(MODE, paged[1]))
    with pytest.raises(InputError, match="are never in one frame"):
        build_bridge(load_plan(path))


def test_an_applied_force_without_a_cycle_time_is_warned_of(tmp_path):
    path = config_with(tmp_path)
    (tmp_path / "my.dbc").write_text(DBC.replace('BA_ "GenMsgCycleTime" BO_ 288 1;\n', ""))
    (found,) = [it for it in check(load_plan(path)) if it.what == "signals.applied_force"]
    assert found.severity is Severity.WARNING
    assert "missing after 10 ms: the DBC gives SENSOR_1 no cycle time" in found.text


@pytest.mark.parametrize("unit", ["(20,0)", "(-20,0)", "(20,5000)"])
def test_a_simulated_bench_states_its_time_whatever_the_range(tmp_path, unit):
    path = config_with(tmp_path, {"time": "Stamp"})
    (tmp_path / "my.dbc").write_text(DBC.replace(STAMP, STAMP.replace("(20,0)", unit)))
    bench = bench_with(tmp_path, time="Stamp")
    message = load_plan(path).database.message("SENSOR_1")
    decode = compile_decoder(message, ["Stamp"], [Dimension.TIME])
    frames = [frame for ms in range(50) for frame in bench.update(ms * MS)[0]]
    times_s = [decode(frame.data)[0] for frame in frames]
    assert np.diff(times_s) == pytest.approx(1e-3, abs=1e-9)
