"""The same fleet on a Dask cluster, a worker of which is killed on the way."""

import psutil
import pytest

from can_dbc.errors import InputError
from rig.fleet.campaign import load_fleet_model, run_campaign
from rig.fleet.executors import dask, processes
from rig.fleet.sources import find_sources
from tests.fleet.cluster import cluster
from tests.fleet.population import write_fleet, write_model
from tests.fleet.study import PATTERN, content, scattered


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_processes_and_a_cluster_write_the_same_store(tmp_path):
    write_fleet(tmp_path / "runs", 12, 10, scattered)
    model = load_fleet_model(write_model(tmp_path))
    sources = find_sources([str(tmp_path / "runs")], PATTERN)
    with cluster(tmp_path, 4) as there:
        victim = psutil.Process(there.workers[0].pid)

        def kill(now):
            if now.done == 30:
                victim.kill()

        out = tmp_path / "by_dask"
        with dask(there.address) as engine:
            end = run_campaign(sources, model, out, engine.make, engine.window, progress=kill)
        assert not victim.is_running() or victim.status() == psutil.STATUS_ZOMBIE
        assert (end.done, end.failed) == (120, 0)
    engine = processes(2)
    run_campaign(sources, model, tmp_path / "by_processes", engine.make, engine.window)
    assert content(tmp_path / "by_dask") == content(tmp_path / "by_processes")


@pytest.mark.long
def test_a_scheduler_that_is_not_there_is_said():
    with pytest.raises(InputError, match="no scheduler there"), dask("tcp://127.0.0.1:9"):
        pass
