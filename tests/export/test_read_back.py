"""What `rig export` writes can be read back: a run's CSV is the recording that the run is."""

import numpy as np
import pytest

from rig.formats.export import export_run
from rig.recordings.read import read_recording
from rig.recordings.recording import RecordingError
from tests.run.test_runs import lockstep


@pytest.fixture(scope="module", params=["reference", "quarter_car", "dyno"])
def run(request, tmp_path_factory):
    return lockstep(tmp_path_factory.mktemp(request.param) / "run", request.param, 1.0)


def test_an_exported_csv_is_the_recording_of_its_run(run, tmp_path):
    export_run(run, "csv", tmp_path / "run.csv")
    own, read = read_recording(run), read_recording(tmp_path / "run.csv")
    assert len(read.t_s) > 0.95 * len(own.t_s)
    _, at_own, at_read = np.intersect1d(
        np.round(own.t_s * 1e9), np.round(read.t_s * 1e9), return_indices=True
    )
    assert len(at_read) > 0.95 * len(own.t_s)
    # A dyno's steps hold the filtered heights; a height of another strut may be of the tick before.
    assert read.heights_m[at_read] == pytest.approx(own.heights_m[at_own], abs=1e-4)
    for name in ("applied_force_n", "strut_forces_n"):
        mine, theirs = getattr(own, name), getattr(read, name)
        assert (mine is None) == (theirs is None)
        if mine is not None and name == "applied_force_n":
            assert theirs[at_read] == pytest.approx(mine[at_own], abs=1e-9)


def test_a_damaged_one_is_one_line(run, tmp_path):
    path = tmp_path / "run.csv"
    export_run(run, "csv", path)
    text = path.read_text().splitlines()
    path.write_text("\n".join([*text[:5], "1,2", *text[6:]]))
    with pytest.raises(RecordingError, match=r"run\.csv: is damaged, expected it as exported"):
        read_recording(path)
    named = [name.strip('"') for name in text[0].split(",")]
    wrong = next(index for index, name in enumerate(named) if name.endswith("measured_height_m"))
    cells = text[5].split(",")
    cells[wrong] = "high"
    path.write_text("\n".join([*text[:5], ",".join(cells), *text[6:]]) + "\n")
    with pytest.raises(RecordingError):
        read_recording(path)
    path.write_text(text[0] + "\n")
    with pytest.raises(RecordingError):
        read_recording(path)
