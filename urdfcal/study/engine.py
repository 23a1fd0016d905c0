"""Run one function over many tasks on joblib's engines: processes of this machine, a Dask cluster, or Ray."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

from urdfcal.errors import UrdfcalError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

Engine: TypeAlias = Literal["processes", "dask", "ray"]
T = TypeVar("T")
R = TypeVar("R")

# A worker that the system kills (memory) takes what the others are at with it: the rest is begun anew so often.
_DEATHS = 3
# Tasks that Ray is handed at a time: a run that is killed loses these.
_PORTION = 64


def each(
    function: Callable[[T], R],
    tasks: Sequence[T],
    engine: Engine = "processes",
    *,
    processes: int | None = None,
    scheduler: str | None = None,
) -> Iterator[tuple[int, R]]:
    """Call a function of a module for each task, in whatever order they end.

    Args:
        function: of one task; what it raises ends the run.
        tasks: to do.
        engine: what runs them.
        processes: how many at a time; one for each core by default. A cluster decides itself.
        scheduler: address of a Dask scheduler; a local cluster by default.

    Yields:
        A task's index and its result, as soon as it is there.

    Raises:
        UrdfcalError: the engine is not installed, cannot be reached, or its workers die again and again.
    """
    left = dict(enumerate(tasks))
    for death in range(_DEATHS + 1):
        with _engine(engine, scheduler) as dead:
            from joblib import delayed

            calls = [delayed(_numbered)(function, k, task) for k, task in left.items()]
            try:
                for k, result in _results(calls, engine, processes or -1):
                    del left[k]
                    yield k, result
            except dead as error:
                if death == _DEATHS:
                    what = f"its workers died {death + 1} times: {error}"
                    remedy = "Look at their memory, or take fewer processes."
                    raise UrdfcalError(what, where=f"engine {engine}", remedy=remedy) from error
        if not left:
            return


def _results(calls: Sequence[Any], engine: Engine, count: int) -> Iterator[tuple[int, Any]]:
    from joblib import Parallel

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
                stack.enter_context(distributed.Client(scheduler))
            except (OSError, ValueError) as error:
                what = f"no scheduler answers: {error}"
                raise UrdfcalError(what, where=scheduler or "dask", remedy="Name one: tcp://host:8786.") from error
            backend, options, dead = "dask", {}, (distributed.scheduler.KilledWorker,)
        elif engine == "ray":
            _installed("ray.util.joblib", engine).register_ray()
            backend, options, dead = "ray", {}, ()
        stack.enter_context(parallel_config(backend=backend, **options))
        yield dead


def _installed(module: str, engine: str) -> Any:
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError as error:
        remedy = f"Install it: pip install 'urdfcal[{engine}]'."
        raise UrdfcalError(f"{engine} is not installed", where=f"engine {engine}", remedy=remedy) from error
