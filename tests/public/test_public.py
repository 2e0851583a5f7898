"""What a script or a notebook uses, and the reference that is made from the code."""

import subprocess
import sys

import numpy as np
import pytest

import rig
from can_dbc.errors import InputError
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from tests.bridge.cores import FIRST
from tests.public.bench import heights
from tests.run.listed import ListPort, bench_frames, live


def test_importing_it_loads_nothing_slow():
    script = "import sys, rig; print(*sys.modules)"
    shown = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert not {"numpy", "dartpy", "numba", "pyarrow"}.intersection(shown.stdout.split())


def test_a_model_comes_by_name():
    by_name = rig.load_model("reference")
    assert by_name.struts[0].stiffness_n_per_m == 500.0
    with pytest.raises(InputError, match="model 'nosuch'"):
        rig.load_model("nosuch")


def test_a_run_is_arrays_by_column(tmp_path):
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=0.3)
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 300, {})))
    run = rig.open_run(tmp_path / "run")
    assert run.t_s.tolist() == pytest.approx(np.arange(300) * 1e-3)
    assert run["strut.height_m"].shape == run["applied_force_n"].shape == (300,)
    started = FIRST - 1
    assert np.isnan(run["strut.force_n"][:started]).all()
    assert np.isfinite(run["strut.force_n"][started:]).all()
    assert run.header["schema"] == 3
    with pytest.raises(KeyError, match=r"nosuch: expected one of .*strut\.height_m"):
        run["nosuch"]


@pytest.mark.slow
def test_a_diagnosis_shows_itself_and_is_written(tmp_path):
    """A bench of the plant's own model with friction that the nominal one lacks."""
    t_s = np.arange(0.0, 12.0, 2e-3)
    rng = np.random.default_rng(5)
    paths = []
    for name, phase in (("train", 0.0), ("test", 1.0)):
        applied, height = heights(t_s, phase)
        path = tmp_path / f"{name}.csv"
        noisy = height + 2e-6 * rng.standard_normal(len(height))
        rows = "\n".join(
            f"{a:.4f},{b:.8f},{c:.5f}" for a, b, c in zip(t_s, noisy, applied, strict=True)
        )
        path.write_text("t_s,height_m,applied_force_n\n" + rows + "\n")
        paths.append(path)
    shares = []
    outcome = rig.diagnose(
        [rig.read_csv(paths[0])], "reference", [paths[1]], lambda _what, share: shares.append(share)
    )
    assert outcome.diagnosis.verdict == "explained"
    assert [effect.family for effect in outcome.diagnosis.effects] == ["nonlinear_stiffness"]
    assert str(outcome).startswith("explained: ")
    html = outcome._repr_html_()
    assert "<table>" in html
    assert "cubic_stiffness" in html
    outcome.write(tmp_path / "found")
    assert {path.name for path in (tmp_path / "found").iterdir()} == {
        "diagnosis.json", "corrected.yaml", "report.html"
    }  # fmt: skip
    assert shares[-1] == 1.0
