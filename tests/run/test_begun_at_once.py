"""Of bridges that are started at once into one folder, one runs and the others say why not."""

import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from rig.cli.main import main
from rig.files.folders import claim
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.replay import replay
from tests.run.listed import ListPort, bench_frames, live

FOLDERS, PROGRAMS = 100, 4

CLAIMING = """
import sys
from pathlib import Path
from can_dbc.errors import InputError
from rig.files.folders import claim
print("ready", flush=True)
sys.stdin.readline()
for folder in sorted(Path(sys.argv[1]).iterdir()):
    try:
        with claim(folder):
            (folder / "run.yaml").open("x").close()
            print(folder.name)
    except InputError as error:
        assert "\\\\n" not in str(error)
"""


def test_every_folder_is_one_programs_alone(tmp_path):
    folders = [tmp_path / f"{number:03d}" for number in range(FOLDERS)]
    for folder in folders:
        folder.mkdir()
    command = [sys.executable, "-c", CLAIMING, str(tmp_path)]
    programs = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(PROGRAMS)
    ]
    for program in programs:
        assert program.stdout.readline() == "ready\n"
    for program in programs:
        program.stdin.write("go\n")
        program.stdin.flush()
    taken = [name for program in programs for name in program.communicate()[0].split()]
    assert [program.returncode for program in programs] == [0] * PROGRAMS
    assert sorted(taken) == [folder.name for folder in folders]
    assert all([path.name for path in folder.iterdir()] == ["run.yaml"] for folder in folders)


@pytest.mark.parametrize("is_prepared", [False, True])
def test_one_of_several_runs_is_written_and_the_others_write_nothing(
    tmp_path, monkeypatch, is_prepared
):
    folder = tmp_path / "run"
    if is_prepared:
        folder.mkdir()
    all_have_looked = threading.Barrier(PROGRAMS)
    waited, copied = threading.local(), []
    mkdir, copyfile = Path.mkdir, shutil.copyfile

    def mkdir_when_all_have_looked(path, *args, **kwargs):
        if path == folder and not hasattr(waited, "is_over"):
            waited.is_over = True
            all_have_looked.wait(30.0)
        mkdir(path, *args, **kwargs)

    def run(_):
        try:
            live(ready, folder, ListPort(bench_frames(ready, 100, {})))
        except InputError as error:
            return str(error)
        return None

    monkeypatch.setattr(Path, "mkdir", mkdir_when_all_have_looked)
    monkeypatch.setattr(shutil, "copyfile", lambda *way: copied.append(way) or copyfile(*way))
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=0.1)
    with ThreadPoolExecutor(PROGRAMS) as pool:
        refusals = [words for words in pool.map(run, range(PROGRAMS)) if words is not None]
    assert len(refusals) == PROGRAMS - 1
    assert all(words.startswith(f"{folder}: ") and "expected" in words for words in refusals)
    assert len(copied) == 1
    assert replay(folder).different == 0
    assert not list(folder.glob("*.tmp"))


def test_a_run_beside_one_that_is_beginning_is_refused_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv", ["rig", "run", str(CONFIGS / "reference.yaml"), "--out", str(tmp_path)]
    )
    with claim(tmp_path), pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"{tmp_path}: " in error


def test_a_folder_that_was_filled_since_the_first_look_is_refused(tmp_path, monkeypatch):
    touch = Path.touch

    def touch_after_another(path, **options):
        (tmp_path / "run.yaml").write_text("another run's")
        touch(path, **options)

    monkeypatch.setattr(Path, "touch", touch_after_another)
    with pytest.raises(InputError, match="is not empty"), claim(tmp_path):
        pytest.fail("was let in")
    assert [path.name for path in tmp_path.iterdir()] == ["run.yaml"]
