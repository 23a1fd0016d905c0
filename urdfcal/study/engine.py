"""Run one function over many tasks on joblib's engines: processes of this machine, a Dask cluster, or Ray."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from os import cpu_count
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

from urdfcal.errors import UrdfcalError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

Engine: TypeAlias = Literal["processes", "dask", "ray"]
T = TypeVar("T")
R = TypeVar("R")

# Tasks for each process that may have been at work when one of them was killed: joblib hands out one ahead.
_SUSPECTS = 2
# Tasks that Ray is handed at a time: a run that is killed loses these.
_PORTION = 64


def each(
    function: Callable[[T], R],
    tasks: Sequence[T],
    killed: Callable[[T], R],
    engine: Engine = "processes",
    *,
    processes: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, R]]:
    """Call a function of a module for each task, in whatever order they end.

    Where a worker is killed, what it and its neighbours were at is done again, one at a time.

    Args:
        function: of one task; what it raises ends the run.
        tasks: to do.
        killed: the result of a task whose worker is killed although it has the machine to itself.
        engine: what runs them.
        processes: how many at a time; one for each core by default. A cluster decides itself.
        scheduler: address of a Dask scheduler; a local cluster by default.

    Yields:
        A task's index and its result, as soon as it is there.

    Raises:
        UrdfcalError: the engine is not installed, or cannot be reached.
    """
    left = dict(enumerate(tasks))
    with _engine(engine, scheduler) as dead:
        while left:
            try:
                for k, result in _results(function, left, engine, processes or -1):
                    del left[k]
                    yield k, result
            except dead:
                for k in list(left)[: _SUSPECTS * (processes or cpu_count() or 1)]:
                    try:
                        result = next(_results(function, {k: left[k]}, engine, 2))[1]
                    except dead:
                        result = killed(left[k])
                    del left[k]
                    yield k, result


def _results(function: Callable[[T], R], tasks: Mapping[int, T], engine: Engine, count: int) -> Iterator[tuple[int, R]]:
    from joblib import Parallel, delayed

    calls = [delayed(_numbered)(function, k, task) for k, task in tasks.items()]
    if engine != "ray":
        yield from Parallel(n_jobs=count if engine == "processes" else -1, return_as="generator_unordered")(calls)
        return
    for first in range(0, len(calls), _PORTION):  # its backend hands out results when the last one is there
        yield from Parallel(n_jobs=-1)(calls[first : first + _PORTION])


def _numbered(function: Callable[[T], R], k: int, task: T) -> tuple[int, R]:
    from urdfcal.arrays import one_blas_thread

    with one_blas_thread():
        return k, function(task)


@contextmanager
def _engine(engine: Engine, scheduler: str | None) -> Iterator[tuple[type[BaseException], ...]]:
    """Choose joblib's backend; yield what it raises when workers die."""
    from joblib import parallel_config
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    dead: tuple[type[BaseException], ...] = (TerminatedWorkerError,)
    backend: str = "loky"
    options: dict[str, Any] = {"inner_max_num_threads": 1}
    with ExitStack() as stack:
        if engine == "dask":
            distributed = _installed("distributed", engine)
            try:
                # A cluster of its own is this machine's alone: no dashboard, which would listen to all.
                local = {"dashboard_address": None, "threads_per_worker": 1}
                client = distributed.Client(scheduler) if scheduler else distributed.Client(**local)
                stack.enter_context(client)
            except (OSError, ValueError) as error:
                what = f"no scheduler answers: {error}"
                raise UrdfcalError(what, where=scheduler or "dask", remedy="Name one: tcp://host:8786.") from error
            backend, options, dead = "dask", {}, (distributed.scheduler.KilledWorker,)
        elif engine == "ray":
            _installed("ray.util.joblib", engine).register_ray()
            backend, options, dead = "ray", {}, (_installed("ray.exceptions", engine).RayError,)
        stack.enter_context(parallel_config(backend=backend, **options))
        yield dead


def _installed(module: str, engine: str) -> Any:
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError as error:
        remedy = f"Install it: pip install 'urdfcal[{engine}]'."
        raise UrdfcalError(f"{engine} is not installed", where=f"engine {engine}", remedy=remedy) from error
