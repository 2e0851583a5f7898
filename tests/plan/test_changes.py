"""Gains and limits are changed while a run goes on, and its replay changes with it."""

import json
import threading

import pytest

from can_dbc.errors import InputError
from rig.log.file_names import CHANGES_FILE
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.change_requests import Requests, ask
from rig.run.changed_settings import (
    assign,
    bridge_with_settings,
    change_line,
    parse_assignments,
    read_changes,
)
from rig.run.replay import replay
from tests.view.serving import make_run

GAIN = "observers.strut.proportional_n_per_m"


@pytest.fixture(scope="module")
def ready():
    return load_plan(CONFIGS / "reference.yaml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"{GAIN}=-1", "expected 0 or more"),
        (f"{GAIN}=fast", "fast"),
        ("observers.strut.gain=1", "no 'gain', expected one of kind, proportional_n_per_m"),
        ("observers.wheel.kind=pi", "no 'wheel', expected one of strut"),
        ("observers.strut=1", "expected"),
        ("rate_hz=10", "cannot be changed in a run"),
        ("model=other", "cannot be changed in a run"),
        ("supervision.safe_after_s=0.001", "expected at least stale_after_s"),
        ("supervision.stale_after_s.x=1", "no 'x'"),
    ],
)
def test_a_change_is_checked_as_the_configuration_is(ready, text, expected):
    with pytest.raises(InputError) as caught:
        assign(ready, parse_assignments([text]), "set")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "x", "=1", "x="])
def test_what_is_no_assignment_is_one_line(text):
    with pytest.raises(InputError, match="expected KEY=VALUE"):
        parse_assignments([text])


def served(folder, ready, lines, events=None):
    note = ([] if events is None else events).append
    return Requests(folder, ready, build_bridge(ready), lambda: None, lines.append, note, 0)


def test_a_request_is_taken_at_a_tick_and_answered_with_its_time(tmp_path, ready):
    run = make_run(tmp_path / "run", 100)
    header = (run / "run.yaml").read_text()
    (run / "run.yaml").write_text(header[: header.index("ending:")])
    lines, answers = [], []
    requests = served(run, ready, lines)
    with requests.serve():
        asking = threading.Thread(target=lambda: answers.append(ask(run, {"set": {GAIN: 5e4}})))
        asking.start()
        bridge = None
        while bridge is None and asking.is_alive():  # ticks, until there is something to take
            bridge = requests.changes(42_000_000)
        asking.join()
        assert requests.changes(43_000_000) is None
        with pytest.raises(InputError, match="expected 0 or more"):
            ask(run, {"set": {GAIN: -5}})
        with pytest.raises(InputError, match="is not a valid request"):
            ask(run, {"sett": 1})
    assert answers == [{"t_ns": 42_000_000}]
    assert lines == [change_line(42_000_000, {GAIN: 5e4})]
    assert bridge.supervisor.estimator.observers[0].proportional_n_per_m == 5e4
    assert not (run / "requests").exists()


def test_what_the_check_refuses_is_not_set_without_force(tmp_path):
    run = make_run(tmp_path / "run", 20)
    header = (run / "run.yaml").read_text()
    (run / "run.yaml").write_text(header[: header.index("ending:")])
    with pytest.raises(InputError, match=r"unstable.*--force sets it all the same"):
        ask(run, {"set": {GAIN: 1e8}})
    with pytest.raises(InputError, match="does not accept requests"):
        ask(run, {"set": {GAIN: 1e8}}, force=True)


def test_what_nobody_waits_for_any_more_is_not_done(tmp_path, ready):
    lines, path = [], tmp_path / "1.request"
    path.write_text(json.dumps({"set": {GAIN: 5e4}}))
    requests, answers = served(tmp_path, ready, lines), []
    thread = threading.Thread(target=lambda: answers.append(requests._answer(path)))
    thread.start()
    while requests._waiting is None:
        pass
    path.unlink()
    thread.join()
    assert requests.changes(5) is None
    assert lines == []
    assert "withdrawn" in answers[0]["error"]


def test_a_marker_is_an_event_at_the_next_tick(tmp_path, ready):
    path, events = tmp_path / "1.request", []
    requests = served(tmp_path, ready, [], events)
    path.write_text(json.dumps({"mark": " valve opened ", "by": "anna"}))
    assert requests._answer(path) == {"marked": "valve opened"}
    assert requests.changes(42_000_000) is None
    assert requests.changes(43_000_000) is None
    (line,) = events
    assert json.loads(line) == {"t_s": 0.042, "mark": "valve opened", "by": "anna"}
    path.write_text(json.dumps({"mark": "  ", "by": "anna"}))
    assert "expected a text" in requests._answer(path)["error"]


@pytest.mark.parametrize("content", ['{"set": [[1, 2]]}', "[" * 50_000, "{", '{"set": {"": 1}}'])
def test_no_request_ends_the_reading_of_requests(tmp_path, ready, content):
    path = tmp_path / "1.request"
    path.write_text(content)
    assert "error" in served(tmp_path, ready, [])._answer(path)


def test_a_limit_goes_by_the_number_of_its_row(ready):
    content = ready.config.model_dump(mode="json")
    content["supervision"]["limits"] = [{"value": "force_n", "high": 900.0, "action": "hold"}]
    limited = ready.with_config(type(ready.config).model_validate(content))
    found = assign(limited, {"supervision.limits.0.high": 700.0}, "set")
    assert found.config.supervision.limits[0].high == 700.0
    with pytest.raises(InputError, match=r"limits.1.high: no '1', expected one of 0"):
        assign(limited, {"supervision.limits.1.high": 700.0}, "set")
    with pytest.raises(InputError, match=r"limits.0: expected one of supervision.limits.0.strut"):
        assign(limited, {"supervision.limits.0": 700.0}, "set")


def test_a_filter_is_not_changed_in_a_run(ready):
    added = {"observers.strut.filter": {"bandwidth_hz": 20.0, "noise_std_m": 1e-5}}
    with pytest.raises(InputError, match="filter: cannot be changed in a run"):
        assign(ready, added, "set")
    content = ready.config.model_dump(mode="json")
    content["observers"]["strut"]["filter"] = added["observers.strut.filter"]
    filtered = ready.with_config(type(ready.config).model_validate(content))
    with pytest.raises(InputError, match="filter: cannot be changed in a run"):
        assign(filtered, {"observers.strut.filter.bandwidth_hz": 25.0}, "set")
    found = assign(filtered, {"observers.strut.force_limit_n": 700.0}, "set")
    assert found.config.observers["strut"].force_limit_n == 700.0


def test_a_group_of_values_is_not_replaced(ready):
    with pytest.raises(InputError, match=r"observers.strut: expected one of observers.strut.kind"):
        assign(ready, {"observers.strut": {"proportional_n_per_m": 5e4}}, "set")


def test_a_run_that_has_ended_takes_no_request(tmp_path):
    with pytest.raises(InputError, match="the run has ended"):
        ask(make_run(tmp_path / "run", 20), {"request": "acknowledge", "by": "a user"})


def test_a_replay_changes_where_the_run_did(tmp_path):
    run = make_run(tmp_path / "run", 400)
    assert replay(run).different == 0
    (run / CHANGES_FILE).write_text(
        change_line(200_000_000, {GAIN: 2e4}) + change_line(300_000_000, {GAIN: 1e5})
    )
    changed = replay(run)
    # From the changed tick on, and not before it, another force is computed.
    assert changed.first_different_ns == 200_000_000
    other = replay(run, plan=load_plan(CONFIGS / "reference.yaml"))
    assert other.different == 0


def test_a_line_that_a_kill_cut_is_passed_over_and_a_wrong_one_is_not(tmp_path):
    path = tmp_path / CHANGES_FILE
    whole = change_line(5, {GAIN: 1.0})
    path.write_text(whole + whole[:10])
    assert read_changes(tmp_path) == [(5, {GAIN: 1.0})]
    path.write_text("nothing\n" + whole)
    with pytest.raises(InputError, match="line 1: 'nothing': expected a change"):
        read_changes(tmp_path)
    path.write_text(json.dumps([1, 2]) + "\n")
    with pytest.raises(InputError, match="expected a change"):
        read_changes(tmp_path)


@pytest.mark.parametrize("key", ["safe_after_s", "settling_s", "stale_after_s"])
def test_a_time_that_no_integer_holds_is_refused_and_the_next_request_is_answered(
    tmp_path, ready, key
):
    requests = served(tmp_path, ready, [])
    path = tmp_path / "1.request"
    path.write_text(json.dumps({"set": {f"supervision.{key}": 1e300}}))
    assert "expected 1e+09 or less" in requests._answer(path)["error"]


@pytest.mark.parametrize("line", ['{"t_ns": 1e999, "set": {}}', "[" * 100_000])
def test_a_change_that_cannot_be_read_is_one_line(tmp_path, line):
    (tmp_path / CHANGES_FILE).write_text(line + "\n")
    with pytest.raises(InputError, match=r"line 1: .*expected a change such as"):
        read_changes(tmp_path)


def test_another_settling_time_is_taken_over(ready):
    plan = assign(ready, {"supervision.settling_s": 0.25}, "set")
    bridge = bridge_with_settings(build_bridge(ready), plan)
    assert bridge.supervisor.estimator._settling_ns == (250_000_000,)
    back = bridge_with_settings(bridge, assign(plan, {"supervision.settling_s": None}, "set"))
    assert back.supervisor.estimator._settling_ns[0] > 1_000_000_000
