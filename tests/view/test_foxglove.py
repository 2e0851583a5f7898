"""Runs in Foxglove's protocol: what a client hears, and that it changes nothing."""

import shutil
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest
import yaml

from can_dbc.errors import InputError
from rig.formats.run_arrays import open_run
from rig.log.file_names import CHANGES_FILE
from rig.pages.view import foxglove
from rig.pages.view.foxglove import FoxgloveView, Playback
from rig.run.changed_settings import change_line
from tests.bridge.cores import FIRST
from tests.view.browser import browser, needs_chromium, until
from tests.view.serving import COUNT, make_run

pytest.importorskip("foxglove", reason="no foxglove-sdk: pip install -e '.[foxglove]'")

CLIENT = """
address => {
  window.heard = [];
  window.steps = [];
  window.socket = new WebSocket(address, ["foxglove.sdk.v1"]);
  socket.binaryType = "arraybuffer";
  window.say = (content) => socket.send(JSON.stringify(content));
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") {
      heard.push(JSON.parse(data));
      return;
    }
    const view = new DataView(data);
    if (view.getUint8(0) !== 1) {
      heard.push({ opcode: view.getUint8(0), status: view.getUint8(1) });
      return;
    }
    const text = new TextDecoder().decode(new Uint8Array(data, 13));
    steps.push([String(view.getBigUint64(5, true)), JSON.parse(text)]);
  };
}
"""
SUBSCRIBE = """
() => {
  const { channels } = heard.find((item) => item.op === "advertise");
  say({ op: "subscribe", subscriptions: channels.map(({ id }, i) => ({ id: i, channelId: id })) });
}
"""


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("foxglove") / "reference")


class Blank(BaseHTTPRequestHandler):
    """An empty page on loopback: Chromium lets no page of elsewhere connect to it unasked."""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def client():
    with HTTPServer(("127.0.0.1", 0), Blank) as blank, browser() as made:
        thread = threading.Thread(target=blank.serve_forever, args=(0.05,))
        thread.start()
        opened = made.new_page()
        opened.blank = f"http://127.0.0.1:{blank.server_port}/"
        yield opened
        blank.shutdown()
        thread.join()


def connected(client, view):
    client.goto(client.blank)
    client.evaluate(CLIENT, view.address)
    until(client, "heard.some((item) => item.op === 'advertise')")
    return client


def publishing(view, client, holds, now_ns=0, step_ns=20_000_000):
    """Publish in simulated time until the client has heard something."""
    for _ in range(2000):
        view.publish(now_ns)
        now_ns += step_ns
        if client.evaluate(holds):
            return now_ns
        client.wait_for_timeout(5)
    pytest.fail(f"never so: {holds}")


@pytest.fixture
def published():
    views = []

    def make(*folders):
        views.append(FoxgloveView(folders, 0))
        return views[-1]

    yield make
    for view in views:
        view.close()


@pytest.mark.slow
@needs_chromium
def test_a_finished_run_is_played_whole(original, client, published):
    view = published(original)
    connected(client, view)
    [info] = client.evaluate("heard.filter((item) => item.op === 'serverInfo')")
    assert set(info["capabilities"]) >= {"parameters", "playbackControl"}
    client.evaluate(SUBSCRIBE)
    publishing(view, client, f"steps.length >= {COUNT}")
    steps = client.evaluate("steps")
    run = open_run(original)
    epoch_ns = yaml.safe_load((original / "run.yaml").read_text())["epoch_ns"]
    t_ns = np.array([int(t) for t, _ in steps]) - epoch_ns
    assert np.array_equal(t_ns * 1e-9, run.t_s)
    # A step without a model has no height.
    heights = [step["strut"].get("height_m", np.nan) for _, step in steps]
    assert np.array_equal(heights, run["strut.height_m"], equal_nan=True)
    assert np.isfinite(heights).sum() == COUNT - FIRST + 1
    assert client.evaluate("heard.some((item) => item.opcode !== undefined)")  # it says it ended


@needs_chromium
def test_a_client_pauses_seeks_and_goes_on(original, client, published):
    view = published(original)
    connected(client, view)
    client.evaluate(SUBSCRIBE)
    now_ns = publishing(view, client, "steps.length >= 100")
    epoch_ns = yaml.safe_load((original / "run.yaml").read_text())["epoch_ns"]
    control = """
    ([command, speed, seek]) => {
      const id = new TextEncoder().encode("one");
      const data = new DataView(new ArrayBuffer(19 + id.length));
      data.setUint8(0, 3); data.setUint8(1, command); data.setFloat32(2, speed, true);
      data.setUint8(6, seek === null ? 0 : 1); data.setBigUint64(7, BigInt(seek ?? 0), true);
      data.setUint32(15, id.length, true);
      new Uint8Array(data.buffer, 19).set(id);
      socket.send(data.buffer);
    }
    """
    client.evaluate(control, [1, 1.0, None])
    for _ in range(200):
        client.wait_for_timeout(5)
        view.publish(now_ns)
        if not view._playback.is_playing:
            break
    assert not view._playback.is_playing
    count = client.evaluate("steps.length")
    for _ in range(5):
        now_ns += 1_000_000_000
        view.publish(now_ns)
    assert client.evaluate("steps.length") == count
    client.evaluate("() => { steps.length = 0; }")
    client.evaluate(control, [0, 2.0, str(epoch_ns + 700_000_000)])
    publishing(view, client, f"steps.length >= {COUNT - 700}", now_ns)
    times = client.evaluate("steps.map(([t]) => t)")
    assert [int(t) - epoch_ns for t in times] == [*range(700_000_000, COUNT * 1_000_000, 1_000_000)]


@needs_chromium
def test_a_run_is_followed_while_it_is_written_and_nobody_changes_it(
    original, client, published, tmp_path
):
    live = shutil.copytree(original, tmp_path / "live")
    header = yaml.safe_load((live / "run.yaml").read_text())
    del header["ending"]
    (live / "run.yaml").write_text(yaml.safe_dump(header))
    content = (live / "steps.arrow").read_bytes()
    (live / "steps.arrow").write_bytes(content[: len(content) // 2])
    view = published(live)
    connected(client, view)
    client.evaluate(SUBSCRIBE)
    [topic] = view._topics
    for _ in range(200):
        view.publish(0)
        if topic.is_subscribed:
            break
        client.wait_for_timeout(5)
    (live / "steps.arrow").write_bytes(content)
    publishing(view, client, f"steps.some(([, step]) => step.t_ns === {(COUNT - 1) * 1_000_000})")
    first = client.evaluate("steps[0][1].t_ns")
    assert first > 0  # what was there before anybody asked is not sent again
    gain = "live.observers.strut.proportional_n_per_m"
    client.evaluate(
        "name => say({ op: 'setParameters', id: 'set', parameters: [{ name, value: 7 }] })", gain
    )
    client.evaluate("name => say({ op: 'getParameters', id: 'x', parameterNames: [name] })", gain)
    until(client, "heard.some((item) => item.op === 'parameterValues' && item.id === 'x')")
    answers = client.evaluate("heard.filter((item) => item.op === 'parameterValues')")
    assert {p["value"] for answer in answers for p in answer["parameters"]} == {1e5}
    assert not list(live.glob("requests/*"))
    client.evaluate(
        "name => say({ op: 'subscribeParameterUpdates', parameterNames: [name] })", gain
    )
    client.wait_for_timeout(50)
    (live / CHANGES_FILE).write_text(change_line(5, {"observers.strut.proportional_n_per_m": 5e4}))
    told = "heard.some(({ parameters }) => parameters?.some(({ value }) => value === 5e4))"
    publishing(view, client, told, step_ns=1_100_000_000)


def test_a_playback_stops_at_its_end():
    playing = Playback(0, 100, speed=2.0, is_playing=True)
    assert playing.at(110, 1000) == Playback(20, 110, 2.0, is_playing=True)
    assert playing.at(700, 1000) == Playback(1000, 700, 2.0, is_playing=False)
    assert playing._replace(is_playing=False).at(700, 1000).position_ns == 0


def test_a_wrong_folder_and_a_taken_port_are_said(original, tmp_path, published):
    (tmp_path / "file").write_text("no run")
    with pytest.raises(InputError, match="is no folder, expected a run"):
        published(tmp_path / "file")
    port = int(published(original).address.rpartition(":")[2])
    with pytest.raises(InputError, match=rf"--port {port}: .*expected a port that is free"):
        FoxgloveView([original], port)


def test_without_the_sdk_it_says_what_to_install(original, monkeypatch):
    def missing(_name):
        raise ImportError

    monkeypatch.setattr(foxglove.importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"pip install -e '\.\[foxglove\]'"):
        FoxgloveView([original], 0)


def test_two_runs_of_one_name_have_two_topics(original):
    view = FoxgloveView([original, original], 0)
    view.close()
    assert [topic.name for topic in view._topics] == ["reference", "reference-2"]
