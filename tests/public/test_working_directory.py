"""A run in somebody's folder is not changed by the settings of libraries that lie there."""

import json
import subprocess
import sys

import pytest

SCRIPT = """
import json, os
before = os.getcwd()
import rig.diagnosis.numerics.smoother, rig.simulated_bench.compilation
import rig.guide.reference, rig.pages.fleet_page, rig.pages.timing_picture
import matplotlib, numba
jit = numba.njit(lambda x: x)
jit(1.0)  # numba looks for its settings at every compilation
print(json.dumps({
    "compiled": len(jit.signatures),
    "cache": numba.config.CACHE_DIR,
    "font size": matplotlib.rcParams["font.size"],
    "folder": os.getcwd() == before,
}))
"""


def found(folder):
    command = [sys.executable, "-c", SCRIPT]
    shown = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert shown.stderr == ""
    return json.loads(shown.stdout)


@pytest.mark.long
def test_no_library_takes_settings_from_it(tmp_path):
    expected = found(tmp_path)
    (tmp_path / ".numba_config.yaml").write_text("disable_jit: 1\ncache_dir: /elsewhere\n")
    (tmp_path / "matplotlibrc").write_text("font.size: 99\nno.such: 1\n")
    assert found(tmp_path) == expected
    assert expected["folder"]
    assert expected["compiled"] == 1
