"""The rate of rare failures of a planner among learned agents: what leads to them is simulated more often.

A particle filter (:class:`symphony.collectors.Systematic`) simulates the branches of a tree. Every :data:`PERIOD`
those in which the ego comes near to a collision are copied and others dropped, with weights that make up for it: the
mean over branches of weight times failure has no bias, whatever is taken for near. Branches only ever go on, so that
planners are forked like branches and never go back; splitting at levels needs each planner as it passed a level.

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
from symphony.envs.dynamics import ConstantVelocity
from symphony.errors import AllFailedError, ConfigError
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
"""Seconds after which branches are resampled."""
TOGETHER = 4
"""Run segments simulated at a time, unless more are asked for."""
KEPT = 3
"""Failing runs of a segment that are kept, at most."""
FEW = 4
"""Number of trees that show the event, with fewer than which its rate is rough."""


def resampling() -> Systematic:
    """Return the rule that resamples branches where less than half of them carry the weight."""
    return Systematic(temperature=1.0, threshold=0.5)


def leaf_weights(found: BeamSearchResult) -> Float[Tensor, "*b L"]:
    """Return the weights of the leaves of a search whose totals are 0: the mean of their products with any number of
    a leaf is an unbiased estimate of its expectation over free rollouts.
    """
    if found.leaf_log_weights is None or found.log_evidence is None:
        raise ValueError("the rule of this search does not weigh")
    return (found.leaf_log_weights + found.log_evidence[..., None]).exp()


@dataclass(frozen=True)
class Rate:
    """The rate of an event in a run segment: a share, its standard error over trees, in how many trees it was seen,
    how many of the runs that show it are kept, and why there is no share where the planner failed.

    ``segment`` is None for the mean over segments that have a share; its error holds for these segments alone. A NaN
    share means that the metric is not defined there or the planner failed, a NaN error that the event was not seen. A
    share above 1 is no mistake: with few branches the estimate scatters to both sides.
    """

    segment: str | None
    rate: float
    error: float
    trees: int
    kept: int
    failed: str = ""


@dataclass(frozen=True)
class Hunt:
    """Simulates a planner in weighted trees, in scenes with routes whose first agents are egos. ``config`` says how
    many; ``metric`` is a rate of :data:`symphony.bench.measures.MEASURES`.
    """

    agent: Agent
    dataset: SceneDataset
    config: EvaluateConfig
    planner: str | Callable[..., Any]
    metric: str

    def __call__(self, items: list[int]) -> list[tuple[SavedRollouts, Rate]]:
        """Return for each segment a few of the runs that show the counted event, and the rate of the event."""
        agent, config, name = self.agent, self.config, planner_name(self.planner)
        with naming(self.dataset, items):
            scenes = self.dataset.scenes(items).to(torch.device(config.device))
            segments = [self.dataset.segment(i) for i in items]
            egos = [EgoPlanners(name, planner_maker(self.planner), segments)]
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
                values = [MEASURES[self.metric].of(run) for run in report.rows]
                hits = np.array([bool(value) for value in values]).reshape(weight[b].shape)
                lost = sorted(saved.failed.items()) if self.metric != "failed_rate" else []
                why = f"failed in {len(lost)} of {saved.rollouts} runs, the first: {lost[0][1]}" if lost else ""
                kept = _kept(saved, hits & (not why))
                known = np.nan if None in values else 1.0
                out.append((kept, _rate(kept, (hits * weight[b]).mean(-1) * known, why)))
            return out


def _kept(saved: SavedRollouts, hits: NDArray[np.bool_]) -> SavedRollouts:
    """Return the first run of each tree [R, S] that shows the event, up to a few."""
    rows = [int(k) * hits.shape[1] + int(hits[k].argmax()) for k in np.flatnonzero(hits.any(1))[:KEPT]]
    names = ("state", "counted", "collision", "offroad", "goal")
    parts: dict[str, Any] = {name: getattr(saved, name)[rows] for name in names}
    failed = {k: saved.failed[row] for k, row in enumerate(rows) if row in saved.failed}
    return replace(saved, **parts, failed=failed)


def _rate(kept: SavedRollouts, estimates: NDArray[np.float64], why: str) -> Rate:
    """Return the mean of the estimates of independent trees."""
    trees = int((estimates > 0).sum())
    error = float(estimates.std(ddof=1)) / math.sqrt(len(estimates)) if trees else math.nan
    return Rate(kept.segment.segment_id, float(estimates.mean()), error, trees, kept.rollouts, why)


def hunt(path: Path, hunter: Hunt, progress: Callable[[int, int], None] = lambda *_: None) -> list[Rate]:
    """Return the rates in all segments and, last, their mean; a few runs of each that show the event are kept in a
    folder, where the same hunt finds them again.

    Segments in which the planner failed, or whose ego can't be driven, are recorded as failed there.

    Raises:
        AllFailedError: the planner failed in every segment.
        ConfigError: nothing is drawn at random around the planner, it can't be copied, or there is no such rate.
        SymphonyError: as for :func:`symphony.saved.saving.save_simulation`.
    """
    agent, data, config = hunter.agent, hunter.dataset, hunter.config
    planner_maker(hunter.planner)  # fail before anything is simulated
    rates = [name for name, measure in MEASURES.items() if measure.kind == "rate"]
    if hunter.metric not in rates:
        raise ConfigError(f"metric is one of {', '.join(rates)}, not '{hunter.metric}'")
    alone = (config.interactive or agent.interactive) == 1
    if alone or agent.policy is None or agent.rule or isinstance(agent.policy, ConstantVelocity):
        what = "only the ego is driven" if alone else f"{agent.name} draws nothing at random"
        raise ConfigError(f"{what}: one run of each segment is enough")
    search: dict[str, Any] = {"search": "tree", "score": "flags", "rule": f"{__name__}:resampling"}
    search |= {"goals": "branch", "prune_every": max(1, round(PERIOD / data.segment(0).dt))}
    config = replace(config, **search, rollouts=config.trees * config.branches)
    hunter = replace(hunter, config=config)
    settings = plain_settings(config, agent, data.interactive, data.duration)
    settings |= {"planner": source_of(hunter.planner), "hunt": hunter.metric}
    name = planner_name(hunter.planner)
    about = About.of(agent.name, data.store, settings, seed=config.seed, planner=name)
    found: list[Rate] = []
    with RolloutWriter(path, about) as writer:
        items = [i for i in range(len(data)) if has_ego(writer, data, i, config.rollouts)]
        tasks = batches(items, config.batch or TOGETHER, config)
        with closing(shared(hunter, tasks, config, data)) as results:
            for saved, rate in (one for result in results for one in result):
                found.append(rate)
                segment = saved.segment
                if rate.failed:
                    writer.fail(segment.segment_id, config.rollouts, rate.failed, segment.group)
                elif saved.rollouts and not writer.has(segment.segment_id):
                    writer.add(saved)
                progress(len(found), len(items))
    if not found:
        raise ConfigError("the ego of no run segment can be driven")
    if all(one.failed for one in found):
        raise AllFailedError(f"{name} {found[0].failed}, as in all segments: metric failed_rate counts such runs")
    known = [one for one in found if not math.isnan(one.rate)]
    seen = [one for one in known if one.rate > 0]
    mean = sum(one.rate for one in seen) / len(known) if known else math.nan
    error = math.hypot(*(one.error for one in seen)) / len(known) if seen else math.nan
    return [*found, Rate(None, mean, error, sum(one.trees for one in seen), sum(one.kept for one in found))]


def remarks(found: list[Rate]) -> list[str]:
    """Return the caveats of rates, the last of which is the mean."""
    out = [f"{one.segment}: the planner {one.failed}" for one in found if one.failed]
    if any(one.rate > 1 for one in found):
        out.append("a rate came to more than 100 %: take more branches")
    if rough := sum(0 < one.trees < FEW for one in found):
        out.append(f"{rough} of the rates and errors are rough: fewer than {FEW} trees show it, take more trees")
    if found[-1].rate == 0:
        out.append("no run shows it: it may be too rare for so few trees and branches, which bounds no rate")
    return out
