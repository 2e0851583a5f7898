"""A page's server and runs in every state, for the tests of this folder."""

import contextlib
import http.client
import json
import os
from urllib.parse import urlencode

import numpy as np

from rig.pages.view.server import ViewServer
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from tests.run.listed import ListPort, bench_frames, live

COUNT = 800


def make_run(folder, count=COUNT):
    """A run of the reference case, on a fake clock."""
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=count * 1e-3)
    live(ready, folder, ListPort(bench_frames(ready, count, {})))
    return folder


@contextlib.contextmanager
def serving(*folders, models=None, token=None):
    """A server on a free port."""
    server = ViewServer(folders, models or {}, 0, token)
    thread = server.start_thread()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def get(server, path, headers=None, **question):
    """Status, headers and body of an answer."""
    connection = http.client.HTTPConnection(*server.server_address, timeout=20)
    try:
        text = f"{path}?{urlencode(question)}" if question else path
        connection.request("GET", text, headers=headers or {})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def described(server):
    return json.loads(get(server, "/runs")[2])


def stretch(server, **question):
    status, _, body = get(server, "/stretch", **question)
    assert status == 200, body
    length = int.from_bytes(body[:4], "little")
    head = json.loads(body[4 : 4 + length])
    t_s = np.frombuffer(body, np.float64, head["count"], 4 + length)
    values = np.frombuffer(body, np.float32, offset=4 + length + 8 * head["count"])
    return head, t_s, values.reshape(-1, head["count"]) if head["count"] else values


def grown_old(folder):
    """Let nothing have been written for a minute."""
    for path in folder.iterdir():
        stamp = path.stat().st_mtime - 60.0
        os.utime(path, (stamp, stamp))
