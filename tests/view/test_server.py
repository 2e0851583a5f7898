"""What the page's server answers, and to whom."""

import contextlib
import copy
import http.client
import json
import re
import shutil
import socket
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from can_dbc.errors import InputError
from dart_model.spec import MODELS, load_model
from rig.bridge.values import Mode
from rig.formats.run_arrays import open_run
from rig.log.follower import RunFollower
from rig.pages.view import visible_stretch as closely
from rig.pages.view.server import _MOST_CONNECTIONS, HOST, ViewServer
from tests.view.serving import COUNT, described, get, grown_old, make_run, serving, stretch
from tests.view.states import make_state

STRUT = "strut"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("view") / "reference")


@pytest.fixture(scope="module")
def server(run):
    with serving(run, models={"corrected": load_model(MODELS / "reference.yaml")}) as made:
        yield made


def test_the_page_is_whole_and_needs_no_other_host(server):
    status, headers, page = get(server, "/")
    assert status == 200
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "unsafe" not in headers["Content-Security-Policy"]
    assert b"http://" not in page
    assert b"https://" not in page
    scripts = ("uPlot.iife.js", "charts.js", "glance.js", "arrange.js", "page.js")
    for name in (*scripts, "uPlot.min.css", "page.css"):
        assert name.encode() in page
        assert get(server, f"/{name}")[0] == 200 or name == "charts.css"


def test_the_columns_of_its_plots_are_the_log_s(server):
    _, _, page = get(server, "/")
    table = json.loads(re.search(r'id="table">(.*?)</script>', page.decode())[1])
    names = [
        f"{STRUT}.{curve['column']}" if curve["is_of_strut"] else curve["column"]
        for curve in table["curves"]
    ]
    # A bench that sends no force of a load cell has no such column.
    plotted = {*names, *table["band"]["columns"]} - {"strut_force_n", "force_error_n"}
    assert plotted <= set(described(server)[0]["columns"])


def test_it_listens_on_loopback_only(server):
    assert server.server_address[0] == HOST == "127.0.0.1"


@pytest.mark.parametrize("host", ["rebound.example:80", "127.0.0.1", "localhost:1"])
def test_a_page_of_another_host_learns_nothing(server, host):
    status, _, body = get(server, "/runs", headers={"Host": host})
    assert status == 403
    assert b"reference" not in body


@pytest.mark.parametrize("path", ["/../run.yaml", "/page.py", "/closely.py", "/%2e%2e/x"])
def test_nothing_but_the_page_is_served(server, path):
    assert get(server, path)[0] == 404


@pytest.mark.parametrize(
    ("question", "expected"),
    [
        ({"run": 1}, "run: 1: expected 0 to 0"),
        ({"run": "x"}, "run: 'x': expected a number"),
        ({"run": 0.5}, "expected 0 to 0"),
        ({"begin": 5, "end": 5}, "expected less than end"),
        ({"begin": "nan"}, "expected a number"),
        ({"end": "1e999"}, "expected a number"),
        ({"points": ""}, "points: '': expected a number"),
    ],
)
def test_a_wrong_question_is_answered_with_one_line(server, question, expected):
    given = {"run": 0, "begin": 0, "end": 1, "points": 100, "columns": "mode", **question}
    status, _, body = get(server, "/stretch", **given)
    assert status == 400
    assert expected in body.decode()
    assert b"\n" not in body


def test_a_stretch_is_what_the_log_says(server, run):
    names = [f"{STRUT}.height_m", f"{STRUT}.force_n", "mode", "no_such_column"]
    head, t_s, values = stretch(
        server, run=0, begin=0.2, end=0.6, points=4000, columns=",".join(names)
    )
    logged = open_run(run)
    sight = (logged.t_s >= 0.2 - 1e-9) & (logged.t_s <= 0.6 + 1e-9)
    assert head["steps"] == head["count"] == sight.sum()
    np.testing.assert_array_equal(t_s, logged.t_s[sight])
    for name, found in zip(names[:3], values, strict=False):
        np.testing.assert_array_equal(found, logged[name][sight].astype(np.float32))
    assert np.isnan(values[3]).all()


def test_following_ends_with_the_newest_step(server):
    head, t_s, _ = stretch(server, run=0, begin=0, end=0.1, points=500, columns="mode", follow="1")
    assert t_s[-1] == head["end_s"] == pytest.approx((COUNT - 1) * 1e-3)
    assert head["begin_s"] == pytest.approx(head["end_s"] - 0.1)


def test_what_is_in_sight_is_looked_at_closely(server, run):
    status, _, body = get(server, "/closely", run=0, begin=0, end=1, strut=STRUT)
    assert status == 200
    found = json.loads(body)
    logged = open_run(run)
    velocities, forces = found["planes"]["velocity_m_per_s:estimated"]
    drawn = set(zip(velocities, forces, strict=True))
    both = zip(logged[f"{STRUT}.velocity_m_per_s"], logged[f"{STRUT}.force_n"], strict=True)
    assert drawn <= {(float(f"{v:.6g}"), float(f"{f:.6g}")) for v, f in both}
    # The reference model is 500 N/m and 100 N s/m about 0.5 m.
    for law in (found["laws"]["model"], found["laws"]["corrected"]):
        heights, over_height = map(np.array, law["height_m"])
        np.testing.assert_allclose(over_height, -500.0 * (heights - 0.5), atol=2e-3)
        _, over_velocity = law["velocity_m_per_s"]
        slope = np.diff(over_velocity) / np.diff(law["velocity_m_per_s"][0])
        np.testing.assert_allclose(slope, -100.0, rtol=2e-3)
    # One measurement in and an estimate and kinematics out a tick, and what comes less often.
    assert 2900 < found["bus"]["frames_per_s"] < 3400
    assert 0.3 < found["bus"]["load"] < 0.5


@pytest.fixture
def states(tmp_path, run):
    """Folders in every state that a run's can be in."""
    copied = ("live", "killed", "empty", "schema", "odd")
    folders = {name: tmp_path / name for name in (*copied, "no_run")}
    for name in copied:
        shutil.copytree(run, folders[name])
    for name in ("live", "killed"):
        header = yaml.safe_load((run / "run.yaml").read_text())
        del header["ending"]
        (folders[name] / "run.yaml").write_text(yaml.safe_dump(header))
        steps = (run / "steps.arrow").read_bytes()
        (folders[name] / "steps.arrow").write_bytes(steps[: len(steps) * 2 // 3])
    grown_old(folders["killed"])
    (folders["live"] / "frames.log").touch()
    (folders["empty"] / "steps.arrow").write_bytes(b"")
    text = (run / "run.yaml").read_text().replace("schema: 3", "schema: 1")
    (folders["schema"] / "run.yaml").write_text(text)
    header = yaml.safe_load((run / "run.yaml").read_text()) | {"config": None, "ending": "done"}
    (folders["odd"] / "run.yaml").write_text(yaml.safe_dump(header))
    folders["no_run"].mkdir()
    folders["file"] = tmp_path / "file"
    folders["file"].write_text("x")
    folders["absent"] = tmp_path / "absent"
    return folders


def test_the_page_says_what_a_folder_is(states):
    with serving(*states.values()) as server:
        found = dict(zip(states, described(server), strict=True))
    assert {name: item["state"] for name, item in found.items()} == {
        "live": "live",
        "killed": "killed",
        "empty": "empty",
        "schema": "unreadable",
        "odd": "unreadable",
        "no_run": "absent",
        "file": "unreadable",
        "absent": "absent",
    }
    assert "schema 1: expected 3" in found["schema"]["words"]
    assert "rig replay" in found["killed"]["words"]
    assert 0 < found["killed"]["steps"] < COUNT
    assert found["live"]["steps"] > 0


def test_a_run_that_comes_later_is_shown(tmp_path, run):
    with serving(tmp_path / "later") as server:
        assert described(server)[0]["state"] == "absent"
        shutil.copytree(run, tmp_path / "later")
        assert described(server)[0]["state"] == "done"
        assert described(server)[0]["steps"] == COUNT


def test_a_port_that_is_taken_is_one_line(run):
    wrong = pytest.raises(InputError, match=r"--port \d+: .*expected a port that is free")
    with socket.create_server((HOST, 0)) as taken, wrong:
        ViewServer([run], {}, taken.getsockname()[1])


def post(server, content, headers):
    connection = http.client.HTTPConnection(*server.server_address, timeout=20)
    try:
        connection.request("POST", "/set?run=0", content, headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


def test_without_control_nothing_is_changed(server):
    for token in ("", "None", "x"):
        assert post(server, "{}", {"X-Rig-Token": token})[0] == 403


def test_only_a_page_that_knows_the_token_changes_a_run(run):
    right = {"X-Rig-Token": "secret"}
    with serving(run, token="secret") as server:
        assert post(server, "{}", {})[0] == 403
        assert post(server, "{}", {"X-Rig-Token": "secreT"})[0] == 403
        assert post(server, "{}", {**right, "Host": "other.example"})[0] == 403
        assert post(server, "no json", right)[0] == 400
        assert post(server, "[" * 20_000, right)[0] == 400
        status, text = post(server, '{"set": {"observers.strut.kind": 1}}', right)
    assert status == 200
    assert "the run has ended" in json.loads(text)["error"]


def test_what_stands_in_a_refused_question_is_no_question(server):
    """A page of another host could hide a question with the right host in the body of one."""
    port = server.server_address[1]
    hidden = f"GET /runs HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n"
    text = f"POST /x HTTP/1.1\r\nHost: other.example\r\nContent-Length: {len(hidden)}\r\n\r\n"
    with socket.create_connection(server.server_address, timeout=10) as asking:
        asking.sendall((text + hidden).encode())
        answer = b""
        while piece := asking.recv(4096):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 403")
    assert answer.count(b"HTTP/1.1") == 1


def test_a_page_of_another_site_is_refused(server):
    assert get(server, "/runs", headers={"Sec-Fetch-Site": "cross-site"})[0] == 403
    assert get(server, "/runs", headers={"Sec-Fetch-Site": "same-origin"})[0] == 200


def test_a_folder_that_is_run_again_shows_the_new_run(tmp_path, run):
    folder = tmp_path / "again"
    shutil.copytree(run, folder)
    with serving(folder) as server:
        assert described(server)[0]["steps"] == COUNT
        shutil.rmtree(folder)
        assert described(server)[0]["words"]
        make_run(folder, 300)
        assert described(server)[0]["steps"] == 300


def test_a_law_with_internal_states_behind_another_one_is_drawn(tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(make_run(tmp_path / "plain", 50), folder)
    friction = {
        "name": "maxwell",
        "parameters": {"stiffness_n_per_m": 800.0, "relaxation_time_s": 0.03},
    }
    model = yaml.safe_load((MODELS / "quarter_car.yaml").read_text())
    for strut in model["struts"]:
        strut["effects"] = [copy.deepcopy(friction)]
    path = tmp_path / "two.yaml"
    path.write_text(yaml.safe_dump(model))
    spec = load_model(path)
    rows = np.zeros((80, 3))
    rows[:, 1], rows[:, 2] = np.linspace(0.3, 0.4, 80), np.linspace(-1.0, 1.0, 80)
    name = spec.struts[-1].name
    follower = SimpleNamespace(columns=("t_ns", f"{name}.height_m", f"{name}.velocity_m_per_s"))
    drawn = closely.laws({"two": spec}, follower, rows, name)["two"]
    assert len(drawn["height_m"][1]) == len(drawn["velocity_m_per_s"][1]) > 10


def test_a_stalled_browser_delays_no_other(server):
    stalled = socket.create_connection(server.server_address)
    stalled.sendall(b"GET /stretch?run=0&begin=0")  # and not a byte more
    try:
        for _ in range(5):
            assert stretch(server, run=0, begin=0, end=1, points=50, columns="mode")[0]["count"]
    finally:
        stalled.close()


def connect(server, begun=b""):
    connection = socket.create_connection(server.server_address, timeout=20)
    connection.sendall(begun)
    return connection


def received(connection):
    """All that a connection still gets before the server closes it."""
    answer = b""
    with contextlib.suppress(ConnectionError):
        while piece := connection.recv(4096):
            answer += piece
    return answer


def test_no_more_connections_are_served_than_pages_need(run):
    before = threading.active_count()
    with serving(run) as server, contextlib.ExitStack() as open_ones:
        begun = [
            open_ones.enter_context(connect(server, b"GET /runs HTTP/1.1\r\n")) for _ in range(100)
        ]
        for refused in begun[_MOST_CONNECTIONS:]:
            assert received(refused).startswith(b"HTTP/1.1 503 ")
        # One serves, and one for each connection.
        assert threading.active_count() - before <= _MOST_CONNECTIONS + 1
        # Those that were let in are answered as soon as they have asked.
        rest = f"Host: {HOST}:{server.server_address[1]}\r\nConnection: close\r\n\r\n".encode()
        for taken in begun[:_MOST_CONNECTIONS]:
            taken.sendall(rest)
            assert received(taken).startswith(b"HTTP/1.1 200 ")
        # A thread gives its place back after its connection was closed.
        while (status := get(server, "/runs")[0]) == 503:
            pass
        assert status == 200


def dripped(server, begun, drip):
    """What a connection gets whose request comes byte by byte and to no end."""
    with connect(server, begun) as slow:
        slow.settimeout(0.02)
        for _ in range(1000):
            try:
                slow.sendall(drip)
                return slow.recv(4096)
            except TimeoutError:
                continue
            except ConnectionError:
                return b""
    return pytest.fail("the connection was never closed")


def test_a_request_that_takes_too_long_is_given_up(run, monkeypatch):
    monkeypatch.setattr("rig.pages.view.server._REQUEST_S", 0.2, raising=False)
    with serving(run, token="secret") as server:
        port = server.server_address[1]
        head = f"POST /set?run=0 HTTP/1.1\r\nHost: {HOST}:{port}\r\nX-Rig-Token: secret\r\n"
        assert dripped(server, b"GET /", b"x") == b""
        assert dripped(server, f"{head}X: ".encode(), b"x") == b""
        body = f"{head}Content-Length: 9000\r\n\r\n".encode()
        assert dripped(server, body, b" ").startswith(b"HTTP/1.1 400 ")


def test_a_connection_answers_one_request_after_another_until_it_is_left_idle(run, monkeypatch):
    monkeypatch.setattr("rig.pages.view.server._REQUEST_S", 0.5, raising=False)
    with serving(run) as server:
        asking = http.client.HTTPConnection(*server.server_address, timeout=20)
        for _ in range(5):
            asking.request("GET", "/runs")
            assert len(json.loads(asking.getresponse().read())) == 1
        assert asking.sock.recv(1) == b""
        asking.close()


@pytest.mark.parametrize("length", ["9" * 5000, "-1", "", "1e3", "10001", "\xb2", "+5"])
def test_a_wrong_length_of_a_request_is_refused(run, capfd, length):
    with serving(run, token="secret") as server:
        text = (
            f"POST /set?run=0 HTTP/1.1\r\nHost: {HOST}:{server.server_address[1]}\r\n"
            f"X-Rig-Token: secret\r\nContent-Length: {length}\r\n\r\n"
        )
        with connect(server, text.encode("latin-1")) as asking:
            answer = received(asking)
    assert answer.startswith(b"HTTP/1.1 400 ")
    assert answer.endswith(b"Content-Length: expected a number up to 10000")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "head",
    [
        *(f"Content-Length: {length}" for length in ("5", "9" * 5000, "-1", "", "x", "\xb2")),
        "Content-Length: 0\r\nContent-Length: 5",
        "Transfer-Encoding: chunked",
    ],
)
@pytest.mark.parametrize(("method", "status"), [("GET", 400), ("HEAD", 501)])
def test_what_follows_a_request_that_has_no_body_is_not_the_next_request(
    server, capfd, method, status, head
):
    host = f"Host: {HOST}:{server.server_address[1]}"
    request = f"{method} /runs HTTP/1.1\r\n{host}\r\n{head}\r\n\r\n"
    body = f"GET /page.css HTTP/1.1\r\n{host}\r\n\r\n"
    with connect(server, (request + body).encode("latin-1")) as asking:
        answer = received(asking)  # to the end of the connection
    assert answer.startswith(f"HTTP/1.1 {status} ".encode())
    assert answer.count(b"HTTP/1.1 ") == 1
    assert capfd.readouterr().err == ""


def test_a_request_that_says_that_it_has_no_body_is_answered(server):
    assert get(server, "/runs", headers={"Content-Length": "0"})[0] == 200


def test_a_request_for_no_address_is_one_for_nothing(server, capfd):
    with connect(server) as asking:
        host = f"{HOST}:{server.server_address[1]}"
        asking.sendall(f"GET http://[ HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        assert received(asking).startswith(b"HTTP/1.1 404 ")
    assert capfd.readouterr().err == ""


def test_a_load_cell_is_drawn_only_where_it_can_be_one_struts():
    modes = np.full(80, float(Mode.RUNNING))
    modes[70:] = float(Mode.SAFE)  # the model stands still: its motion is not that of the bench
    rows = np.column_stack([np.arange(80.0), *(np.linspace(0.1, 0.9, 80),) * 4, modes])
    names = ("a.height_m", "a.velocity_m_per_s", "a.force_n", "strut_force_n", "mode")
    follower = SimpleNamespace(columns=("t_ns", *names))
    alone = closely.planes(follower, rows, "a", with_cell=True)
    beside = closely.planes(follower, rows, "a", with_cell=False)
    assert len(alone["height_m:measured"][0]) == 70
    assert beside["height_m:measured"] == [[], []]
    assert beside["height_m:estimated"] == alone["height_m:estimated"]


def test_last_values_belong_to_one_time(tmp_path):
    """The force error is that of the force and the load cell beside it, whenever the cell sends."""
    run = make_state(tmp_path / "running", "running")
    follower = RunFollower(run)
    follower.update(100_000)
    names = ["strut.force_n", "strut_force_n", "force_error_n", "strut.innovation_m"]
    found = closely.last_values(follower, names, follower.span_s[1])
    error_n = found["strut.force_n"] - found["strut_force_n"]
    assert found["force_error_n"] == pytest.approx(error_n, abs=1e-9)
    assert "strut.innovation_m" in found


def test_a_height_error_says_nothing_while_no_height_arrives(tmp_path):
    run = make_state(tmp_path / "safe_silent", "safe_silent")
    follower = RunFollower(run)
    follower.update(100_000)
    window = follower.window(["mode", "strut.innovation_m"], 0.0, 6.0, 10_000)
    mode, innovation_m = window.values
    is_apart = np.isin(mode, [Mode.WAITING, Mode.HOLD, Mode.SAFE])
    assert np.any(is_apart)
    assert not np.any(np.isfinite(innovation_m[is_apart]))
    assert np.all(np.isfinite(innovation_m[mode == Mode.RUNNING]))
