"""A diagnosis that the page starts: by whom, of what, beside what, and how it ends."""

import http.client
import json
import shutil
import signal

import pytest
import yaml

from tests.view.serving import get, make_run, serving

TOKEN = {"X-Rig-Token": "secret"}


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("diagnosing") / "reference", 3000)


@pytest.fixture
def run(original, tmp_path):
    return shutil.copytree(original, tmp_path / "run <b>7")


def post(server, path, content="{}", headers=TOKEN):
    connection = http.client.HTTPConnection(*server.server_address, timeout=60)
    try:
        connection.request("POST", path, content, headers)
        answer = connection.getresponse()
        text = answer.read().decode()
        return json.loads(text) if answer.status == 200 else (answer.status, text)
    finally:
        connection.close()


def state(server, run=0):
    return json.loads(get(server, "/diagnosis", run=run)[2])


def ended(server):
    """The state after the process has ended."""
    server.diagnoses[0].wait()
    return state(server)


@pytest.mark.long
def test_it_stands_beside_the_run_and_its_report_reads_nothing_of_the_page(run):
    with serving(run, token="secret") as server:
        assert state(server) == {"state": "none"}
        assert get(server, "/report", run=0)[0] == 400
        assert post(server, "/diagnose?run=0")["state"] == "running"
        assert post(server, "/diagnose?run=0")["state"] == "running"  # the same one
        found = ended(server)
        assert found["state"] == "done"
        content = json.loads((run.with_name("run <b>7-diagnosis") / "diagnosis.json").read_text())
        assert found["verdict"] == content["verdict"].replace("_", " ")
        assert found["folder"] == str(run.with_name("run <b>7-diagnosis"))
        status, headers, content = get(server, "/report", run=0)
        assert status == 200
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("sandbox allow-scripts")
        assert "allow-same-origin" not in policy
        assert b'id="finding"' in content
    # Another server finds it again, and a second one stands beside the first.
    with serving(run, token="secret") as server:
        assert state(server)["state"] == "done"
        post(server, "/diagnose?run=0")
        assert post(server, "/cancel?run=0")["state"] in ("running", "cancelled")
        assert ended(server) == {"state": "cancelled"}
    assert not run.with_name("run <b>7-diagnosis-2").exists()


def test_the_end_of_the_server_ends_it(run):
    with serving(run, token="secret") as server:
        post(server, "/diagnose?run=0")
        job = server.diagnoses[0]
    assert job.wait() == -signal.SIGTERM


@pytest.mark.slow
def test_what_fails_says_why(tmp_path):
    with serving(make_run(tmp_path / "short", 30), token="secret") as server:
        post(server, "/diagnose?run=0")
        found = ended(server)
    assert found["state"] == "failed"
    assert "expected at least" in found["why"]


@pytest.mark.slow
def test_it_imports_no_module_of_the_working_directory(foreign_modules, tmp_path):
    with serving(make_run(tmp_path / "short", 30), token="secret") as server:
        post(server, "/diagnose?run=0")
        found = ended(server)
    assert foreign_modules.imported == []
    assert "expected at least" in found["why"]  # it is the diagnosis that refuses


def test_nobody_starts_one_without_the_token(run):
    with serving(run, token="secret") as server:
        for path in ("/diagnose?run=0", "/cancel?run=0"):
            assert post(server, path, headers={})[0] == 403
        assert post(server, "/delete?run=0")[0] == 404
        assert state(server) == {"state": "none"}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ('{"held_out": [5]}', "run: 5: expected 0 to 0"),
        ('{"held_out": 5}', "not iterable"),
        ('{"held_out": ["x"]}', "run: 'x'"),
        ('{"model": "/etc/passwd"}', "expected one that `rig view` was given"),
        ("[1]", "convert"),
    ],
)
def test_a_wrong_question_starts_nothing(run, content, says):
    with serving(run, token="secret") as server:
        answer = post(server, "/diagnose?run=0", content)
        assert says in (answer["error"] if isinstance(answer, dict) else answer[1])
        assert state(server) == {"state": "none"}


def test_it_waits_until_no_run_goes_on(run, tmp_path):
    live = shutil.copytree(run, tmp_path / "live")
    header = yaml.safe_load((live / "run.yaml").read_text())
    del header["ending"]
    (live / "run.yaml").write_text(yaml.safe_dump(header))
    (tmp_path / "none").mkdir()
    with serving(run, live, tmp_path / "none", token="secret") as server:
        assert "a run is live" in post(server, "/diagnose?run=0")["error"]
        assert "is live, expected a run that has ended" in post(server, "/diagnose?run=1")["error"]
        assert "is absent" in post(server, "/diagnose?run=2")["error"]
