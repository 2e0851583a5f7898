"""The report of a run: whole, small, harmless, and true to the log."""

import base64
import json
import re
import shutil

import numpy as np
import pytest
import yaml

from can_dbc.errors import InputError
from rig.formats.run_arrays import open_run
from rig.pages import browser_print
from rig.pages.run_report import write_run_report
from rig.run.changed_settings import change_line
from tests.view.serving import make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("report") / "reference")


def written(run, tmp_path):
    path = tmp_path / "report.html"
    write_run_report(run, path)
    return path.read_text("utf-8")


def panels(text, key):
    (found,) = re.findall(rf'data-plot="{key}">(.*?)</script>', text)
    return json.loads(found)


def test_it_is_one_small_file_without_a_network(run, tmp_path):
    text = written(run, tmp_path)
    assert len(text) < 2_000_000
    assert not re.search(r'(?:src|href)="http', text)
    assert "Ended in order" in text
    assert "0.8 s at 1000 Hz; no faults" in text


def test_its_curves_are_the_log_s(run, tmp_path):
    (height, *_) = panels(written(run, tmp_path), "run-0")
    logged = open_run(run)
    drawn = np.frombuffer(base64.b64decode(height["values"][1]), np.float32)
    expected = logged["strut.height_m"] * 1e3
    np.testing.assert_array_equal(drawn, expected.astype(np.float32))


def test_what_was_changed_stands_in_it(run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    (folder / "changes.jsonl").write_text(change_line(250_000_000, {"observers.strut.x": 5e4}))
    text = written(folder, tmp_path)
    assert "0.250 s" in text
    assert "observers.strut.x" in text


def test_a_name_is_text_and_nothing_else(run, tmp_path):
    bad = "<script>alert(1)</script>"
    folder = tmp_path / "run"
    shutil.copytree(run, folder)
    header = yaml.safe_load((folder / "run.yaml").read_text())
    header["config_source"] = bad
    header["ending"]["counts"] = {bad: 7}
    (folder / "run.yaml").write_text(yaml.safe_dump(header))
    text = written(folder, tmp_path)
    assert bad not in text
    assert text.count("&lt;script&gt;alert(1)") >= 2


@pytest.mark.parametrize("what", ["absent", "empty"])
def test_what_is_no_run_is_one_line(run, tmp_path, what):
    folder = tmp_path / "run"
    if what == "empty":
        shutil.copytree(run, folder)
        (folder / "steps.arrow").write_bytes(b"")
    with pytest.raises(InputError) as caught:
        write_run_report(folder, tmp_path / "report.html")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "report.html").exists()


def test_without_a_browser_nothing_is_printed(tmp_path, monkeypatch):
    monkeypatch.setattr(browser_print.shutil, "which", lambda _name: None)
    with pytest.raises(InputError, match="expected Chromium, Chrome or Edge"):
        browser_print.print_page(tmp_path / "page.html", tmp_path / "page.pdf")


def test_a_browser_prints_it(run, tmp_path):
    if not any(shutil.which(name) for name in browser_print._BROWSERS):
        pytest.skip("no Chromium, Chrome or Edge on this machine")
    written(run, tmp_path)
    browser_print.print_page(tmp_path / "report.html", tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF-")
