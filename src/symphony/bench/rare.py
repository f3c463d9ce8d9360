"""How often a planner fails among learned agents, where that is rare: what leads to it is simulated more often.

A particle filter (:class:`symphony.collectors.Resampling`) simulates the branches of a tree. Every second those in
which the ego comes near to a collision are copied and others dropped, with weights that make up for it: the mean over
branches of weight times failure has no bias, whatever is taken for near. Branches only ever go on, so that planners
are forked like branches and never go back; splitting at levels needs each planner as it was when it passed a level.

Source: Del Moral and Garnier, "Genealogical particle analysis of rare events", Ann. Appl. Probab. 15 (2005).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.agents import Agent
from symphony.bench.measures import MEASURES
from symphony.collectors import BeamSearchResult, Systematic
from symphony.config import EvaluateConfig
from symphony.errors import ConfigError, DataError
from symphony.evaluation.report import Report, add_segment
from symphony.learning.demonstrations import SceneDataset
from symphony.planners.driver import EgoPlanners
from symphony.planners.identity import source_of
from symphony.planners.interface import planner_maker, planner_name
from symphony.planners.nearness import Nearness
from symphony.rollouts.driving import simulate_batch
from symphony.rollouts.workers import batches, naming, shared
from symphony.saved.folder import About, RolloutWriter
from symphony.saved.rollouts import SavedRollouts, saved_rollouts
from symphony.saved.saving import has_ego, plain_settings

PERIOD = 0.4
"""Seconds after which branches go on or not."""
TOGETHER = 4
"""Run segments simulated at a time, unless more are asked for."""
KEPT = 3
"""Failing runs of a segment that are kept, at most."""


def resampling() -> Systematic:
    """The rule by which branches go on: where less than half of them carry the weight."""
    return Systematic(temperature=1.0, threshold=0.5)


def leaf_weights(found: BeamSearchResult) -> Float[Tensor, "*b L"]:
    """Weights of the leaves of a search whose totals are 0: the mean of their products with anything that is a number
    of a leaf is an estimate, without bias, of its expectation over free rollouts.
    """
    if found.leaf_log_weights is None or found.log_evidence is None:
        raise ValueError("the rule of this search does not weigh")
    return (found.leaf_log_weights + found.log_evidence[..., None]).exp()


@dataclass(frozen=True)
class Rate:
    """How often something happens: a share, its standard error over trees, and the simulated runs that showed it.

    ``segment`` is None for the mean over segments, whose error is that for these segments, not for others. NaN: the
    metric is not defined there, or, of an error, nothing was seen that would have one.
    """

    segment: str | None
    rate: float
    error: float
    shown: int


@dataclass(frozen=True)
class Hunt:
    """Simulates a planner in trees that are weighed, in scenes with routes whose first agents are egos.

    ``config`` says how many; ``metric`` is a rate of :data:`symphony.bench.measures.MEASURES`.
    """

    agent: Agent
    dataset: SceneDataset
    config: EvaluateConfig
    planner: str | Callable[..., Any]
    metric: str

    def __call__(self, items: list[int]) -> list[tuple[SavedRollouts, NDArray[np.float64]]]:
        """Of each segment the runs that show what the metric counts, few of them, and the estimates of all trees."""
        agent, config, name = self.agent, self.config, planner_name(self.planner)
        with naming(self.dataset, items):
            scenes = self.dataset.scenes(items).to(torch.device(config.device))
            segments = [self.dataset.segment(i) for i in items]
            egos = EgoPlanners(name, planner_maker(self.planner), segments)
            found = simulate_batch(agent, scenes, config, keep_tree=True, egos=egos, toward=Nearness)
            assert found.search is not None  # noqa: S101 - as asked for
            weight = leaf_weights(found.search).cpu().numpy()
            driver = [name, *[agent.name] * (scenes.interactive.shape[1] - 1)]
            rollouts, on_cpu, out = found.rollouts.cpu(), scenes.cpu(), []
            about: dict[str, Any] = {"goal": found.goal, "driver": driver, "others": config.others}
            for b, segment in enumerate(segments):
                saved = saved_rollouts(segment, on_cpu, rollouts, b, failed=found.failed[b], **about)
                report = Report(agent.name, "ego")
                add_segment(report, saved)
                if saved.failed and self.metric != "failed_rate":
                    lost = f"{name} failed in {len(saved.failed)} of {saved.rollouts} runs, the first: "
                    why = f"{min(saved.failed.items())[1]}; metric failed_rate counts such runs"
                    raise DataError(lost + why, segment=segment.segment_id)
                values = [MEASURES[self.metric].of(run) for run in report.rows]
                hits = np.array([bool(value) for value in values]).reshape(weight[b].shape)
                known = np.nan if None in values else 1.0
                out.append((_kept(saved, hits), (hits * weight[b]).mean(-1) * known))
            return out


def _kept(saved: SavedRollouts, hits: NDArray[np.bool_]) -> SavedRollouts:
    """The first run of each tree [R, S] that shows it, few of them."""
    rows = [int(k) * hits.shape[1] + int(hits[k].argmax()) for k in np.flatnonzero(hits.any(1))[:KEPT]]
    names = ("state", "counted", "collision", "offroad", "goal")
    parts: dict[str, Any] = {name: getattr(saved, name)[rows] for name in names}
    failed = {k: saved.failed[row] for k, row in enumerate(rows) if row in saved.failed}
    return replace(saved, **parts, failed=failed)


def _rate(segment: str, estimates: NDArray[np.float64], shown: int) -> Rate:
    """The mean of the estimates of independent trees."""
    seen = len(estimates) > 1 and bool(estimates.any())
    error = float(estimates.std(ddof=1)) / math.sqrt(len(estimates)) if seen else math.nan
    return Rate(segment, float(estimates.mean()), error, shown)


def hunt(path: Path, hunter: Hunt, progress: Callable[[int, int], None] | None = None) -> list[Rate]:
    """The rates in all segments and, last, their mean; some runs of each that show it are kept in a new folder.

    Segments whose ego can't be driven are put on record as failed there, and count for nothing.

    Raises:
        ConfigError: nothing is drawn at random around the planner, it can't be copied, or the folder is not new.
        DataError: the planner failed in a run, which no other metric than ``failed_rate`` counts.
        SymphonyError: as of :func:`symphony.saved.saving.save_simulation`.
    """
    agent, data, config = hunter.agent, hunter.dataset, hunter.config
    planner_maker(hunter.planner)  # or complain before anything is simulated
    if agent.policy is None or agent.rule:
        raise ConfigError(f"{agent.name} draws nothing at random: one run of each segment says it all")
    if path.exists() and any(path.iterdir()):
        raise ConfigError(f"{path} is not empty")
    search: dict[str, Any] = {"search": "tree", "score": "flags", "rule": f"{__name__}:resampling"}
    search |= {"goals": "branch", "prune_every": max(1, round(PERIOD / data.segment(0).dt))}
    config = replace(config, **search, rollouts=config.trees * config.branches)
    hunter = replace(hunter, config=config)
    settings = plain_settings(config, agent, data.interactive, data.duration)
    settings["planner"] = source_of(hunter.planner)
    name = planner_name(hunter.planner)
    about = About.of(agent.name, data.store, settings, seed=config.seed, planner=name)
    found: list[Rate] = []
    with RolloutWriter(path, about) as writer:
        items = [i for i in range(len(data)) if has_ego(writer, data, i, config.rollouts)]
        with closing(
            shared(hunter, batches(items, config.batch or TOGETHER, config), config, data)
        ) as results:
            for result in results:
                for saved, estimates in result:
                    found.append(_rate(saved.segment.segment_id, estimates, saved.rollouts))
                    if saved.rollouts:
                        writer.add(saved)
                if progress is not None:
                    progress(len(found), len(items))
    if not found:
        raise ConfigError("the ego of no run segment can be driven")
    known = [one for one in found if not math.isnan(one.rate)]
    seen = [one for one in known if one.rate > 0]
    mean = sum(one.rate for one in seen) / len(known) if known else math.nan
    error = math.hypot(*(one.error for one in seen)) / len(known) if seen else math.nan
    return [*found, Rate(None, mean, error, sum(one.shown for one in found))]
