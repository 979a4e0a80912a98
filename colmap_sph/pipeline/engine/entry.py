"""What Dask calls in a worker process."""

import threading
from collections.abc import Mapping

from distributed import Worker, get_worker
from distributed.system import MEMORY_LIMIT

from colmap_sph.pipeline.engine.group import Answer, Group, RunSeen
from colmap_sph.pipeline.engine.worker import WorkerFacts, Workplace, budget_of, described

_workplaces: list[Workplace] = []
_lock = threading.Lock()


def work(group: Group[object]) -> Answer:
    """Make a group of tasks, see `Workplace.work`."""
    return _workplace(get_worker(), group.neighbours).work(group)


def describe(run: RunSeen, neighbours: Mapping[str, int], dask_worker: Worker) -> WorkerFacts:
    """Say what a run has to know of a worker."""
    return described(_workplace(dask_worker, neighbours), run)


def rest(run: RunSeen) -> None:
    """Let go of what is kept in memory for a run."""
    for each in _workplaces:
        each.rest(run)


def host_of(address: str) -> str:
    """Machine of a worker, from an address such as tcp://10.0.0.1:4711."""
    return address.rpartition(":")[0]


def _workplace(worker: Worker, neighbours: Mapping[str, int]) -> Workplace:
    """The process; what it may use, the engine's limits say."""
    with _lock:
        if not _workplaces:
            number = neighbours.get(host_of(worker.address), 1)
            budget = budget_of(worker.memory_manager.memory_limit, MEMORY_LIMIT, number)
            _workplaces.append(Workplace(budget, worker.state.nthreads))
        return _workplaces[0]
