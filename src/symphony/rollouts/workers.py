"""Sharing of run segments among processes."""

from __future__ import annotations

import dataclasses
import io
import pickle
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import lru_cache
from types import FunctionType
from typing import Any, TypeVar, cast

import torch

from symphony import allocator
from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.config.evaluation import TOGETHER, compiles
from symphony.errors import ConfigError, SymphonyError
from symphony.imports import load_object
from symphony.learning.demonstrations import SceneDataset
from symphony.parallel import WorkerError, ordered_map
from symphony.rollouts.search import FILL
from symphony.rollouts.unroll import NotFiniteError

POINTS = 1 << 19
"""Map points that all agents of a batch see together, at most: some 50 MB of features."""
BYTES, FULL = 2048, 1024
"""Bytes of a card for each of these points, with all that is computed from it, and run segments that fill a card."""
IN_TRAFFIC, NAMED = 32, 8
"""Agents that a run segment is taken to have where all are driven; segments that an error names, at most."""

T = TypeVar("T")
R = TypeVar("R")
Work = Callable[[T], R]
"""The work on a task, such as a batch of items: a picklable object, with the dataset and the agent inside."""


def segments_together(agent: Agent, config: EvaluateConfig, interactive: int) -> int:
    """Return how many run segments to simulate at a time: as many as the configuration says, by default up to
    ``TOGETHER``, as a step of few agents costs little less than one of many; fewer if they see more than ``POINTS``.
    On a card up to ``FULL``, fewer if its free memory has less than ``BYTES`` for each point that they see.
    """
    if config.batch:
        return config.batch
    everyone = config.interactive == "all" or config.open_traffic or config.others != "log"
    plan = agent.plan(config)
    agents = plan.trees * plan.branches * (IN_TRAFFIC if everyone else interactive)
    card = torch.device(config.device)
    points, most = POINTS, TOGETHER
    if card.type == "cuda":
        points, most = torch.cuda.mem_get_info(card)[0] // BYTES, FULL
    found = min(max(1, points // (agents * max(1, agent.observation.num_points))), most)
    return found * FILL if plan.kind == "backtrack" else found


def settled(config: EvaluateConfig, dataset: SceneDataset, searches: int) -> EvaluateConfig:
    """Return the configuration with its choice whether to compile this many searches (or batches of rollouts) made,
    for which batches of the dataset are padded to few shapes.
    """
    dataset.few_shapes = compiles(config.compile, config.device, searches)
    return dataclasses.replace(config, compile="yes" if dataset.few_shapes else "no")


def batches(items: Sequence[int], size: int, config: EvaluateConfig) -> list[list[int]]:
    """Return items in order, ``size`` at a time, by default so few that each of several workers gets two batches."""
    if config.workers > 1 and not config.batch:
        size = max(1, min(size, -(-len(items) // (2 * config.workers))))
    if config.compile == "yes" and items:  # as equal as can be, since each size is a program
        size = -(-len(items) // -(-len(items) // size))
    return [list(items[first : first + size]) for first in range(0, len(items), size)]


class _Pickler(pickle.Pickler):
    """Sends what a file of the user's defines by its import path: nothing else finds such a module."""

    def reducer_override(self, value: Any) -> Any:
        module, name = (getattr(value, part, None) for part in ("__module__", "__qualname__"))
        if isinstance(value, type | FunctionType) and str(module).endswith(".py") and "<" not in str(name):
            return load_object, (f"{module}:{name}",)
        return NotImplemented


def shared(
    work: Work[T, R], tasks: Iterable[T], config: EvaluateConfig, dataset: SceneDataset | None = None
) -> Generator[R, None, None]:
    """Yield the results of some work on every task, in the order of the tasks, by ``config.workers`` processes; one
    local worker is this process. ``close`` ends the others. With a dataset, tasks are a list of batches of its items.

    Raises:
        ConfigError: the work can't be sent to another process, or Ray is not installed.
        SymphonyError: a worker process died, with the run segments at hand if the dataset is given; what the work
            raises comes through unchanged.
    """
    if config.workers == 1 and config.engine == "local":
        yield from map(work, tasks)
        return
    try:
        _Pickler(sent := io.BytesIO()).dump(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ConfigError(f"can't be shared among processes: {error}") from error
    pairs, imports = ((sent.getvalue(), task) for task in tasks), [getattr(work, "func", type(work)).__module__]
    done = ordered_map(_done, pairs, workers=config.workers, engine=config.engine, imports=imports)
    with closing(done) as results:
        try:
            for result in results:
                yield cast(R, pickle.loads(result))  # noqa: S301  (from our own worker)
        except WorkerError as error:
            if dataset is None:
                raise
            batched = cast("Sequence[list[int]]", tasks)
            names = _names(dataset, [i for number in error.tasks for i in batched[number]])
            raise SymphonyError(f"{error}; at hand were the run segments {names}") from error


@contextmanager
def naming(dataset: SceneDataset, items: Sequence[int]) -> Iterator[None]:
    """Make errors inside name the run segment they are about, unexpected ones all of the items."""
    try:
        yield
    except NotFiniteError as error:
        raise error.named(dataset.store.ids[dataset.indices[items[error.row]]]) from error
    except SymphonyError:
        raise
    except Exception as error:
        error.add_note(f"in one of the run segments {_names(dataset, items)}")
        raise


def _names(dataset: SceneDataset, items: Sequence[int]) -> str:
    names, more = [dataset.store.ids[dataset.indices[i]] for i in items[:NAMED]], len(items) - NAMED
    return ", ".join(names) + (f" and {more} more (batches of 1 tell which)" if more > 0 else "")


@lru_cache(1)
def _opened(sent: bytes) -> Work[Any, Any]:
    """Return the work, once per process: it keeps what it prepared from one task to the next."""
    allocator.tune()  # this process is ours
    return cast("Work[Any, Any]", pickle.loads(sent))  # noqa: S301  (from our own parent)


def _done(pair: tuple[bytes, Any]) -> bytes:
    # As bytes: tensors of their own would travel through shared memory, of which containers have little.
    sent, task = pair
    return pickle.dumps(_opened(sent)(task))
