"""The targets of kills: everything that writes for longer than a moment, small."""

from __future__ import annotations

import dataclasses
import json
import os
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import helpers_distributed
import helpers_killed
from helpers_convert import FakeReader
from helpers_segments import crossing, straight_road
from helpers_store import fill
from kills import Target
from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data import generate as generation
from symphony.data.builtin import builtin_store
from symphony.data.convert import convert
from symphony.data.generate import Harvest, Plan, Task
from symphony.data.store import SegmentStore
from symphony.evaluation import evaluate
from symphony.evaluation.records import evaluation_record
from symphony.files import write_json
from symphony.learning import SceneDataset
from symphony.recipes import train
from symphony.saved.folder import About, RolloutWriter
from symphony.saved.rollouts import SavedRollouts
from symphony.saved.saving import save_simulation

AGENT = "pretrained:bc_ts_h"
CONFIG = EvaluateConfig(rollouts=2, branches=4, batch=1)
TIMES = ("seconds", "updates_per_second", "cost", "out", "path")
"""Names of what is a matter of the clock or of the folder."""


def files(folder: Path) -> dict[str, bytes]:
    """All files of a folder but locks; of JSON all but what is a matter of the clock or of the folder."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock"):
        data = path.read_bytes()
        if path.suffix in (".json", ".jsonl"):
            lines = [data] if path.suffix == ".json" else data.splitlines()
            data = b"\n".join(json.dumps(timeless(json.loads(line))).encode() for line in lines)
        found[str(path.relative_to(folder))] = data
    return found


def timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: timeless(item) for name, item in value.items() if name not in TIMES}
    return [timeless(item) for item in value] if isinstance(value, list) else value


def _generate(out: Path) -> None:
    """Networks from a list instead of SUMO: what is killed is the writing."""
    held = list(SegmentStore(builtin_store("train")))[:6]

    def give(task: Task) -> Harvest:
        names = [f"{task.name}-{k}" for k in range(task.seed % 4)]
        made = [held[(task.seed + k) % 6].replace(segment_id=name) for k, name in enumerate(names)]
        return Harvest(task, made, accepted=len(made), reasons=Counter(overlap=1))

    generation.harvest = give
    generation.sumo_version = lambda: "0.0"
    generation.generate(Plan(60), out / "store")


def _convert(logs: Path, out: Path) -> None:
    # It was done when it was killed, and would be refused, unless it had not tidied up.
    if not (out / "store").exists() or (out / "store.partial" / "job.json").exists():
        convert(FakeReader(), sorted(logs.glob("*.scene")), out / "store")


def _train(method: Any, store: Path, out: Path) -> None:
    train(helpers_killed.config(method, store, out))


def _train_by_two(method: Any, store: Path, out: Path) -> None:
    def one(rank: int) -> None:
        os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank)}
        _train(method, store, out)

    if any(helpers_distributed.as_torchrun(one)):
        raise RuntimeError("a process of two failed")


def _simulate(store: Path, out: Path) -> None:
    agent = load_agent(AGENT)
    dataset = SceneDataset(SegmentStore(store), 2, agent.dynamics, routes=True)
    save_simulation(out / "rollouts", agent, dataset, CONFIG)


def _evaluate(store: Path, out: Path) -> None:
    agent, segments = load_agent(AGENT), SegmentStore(store)
    writer = RolloutWriter(out / "rollouts", About.of(AGENT, segments, dataclasses.asdict(CONFIG)))

    def observe(item: int, saved: SavedRollouts) -> None:
        if not writer.has(saved.segment.segment_id):
            writer.add(saved)

    found = evaluate(agent, segments, CONFIG, baselines=True, observe=observe)
    write_json(out / "found.json", evaluation_record(agent, found, segments))


def targets(folder: Path) -> dict[str, Target]:
    """Everything, with the data that it works on in a folder."""
    store, logs = folder / "store", folder / "logs"
    fill(store, [straight_road(4, steps=9), crossing(4, steps=9), crossing(4, seed=1, steps=8)])
    logs.mkdir()
    for k in range(4):
        kinds = (f"straight {2 * k}", f"broken {k}", f"crossing {2 * k + 1}")
        (logs / f"{k}.scene").write_text("\n".join(kinds[: 2 + k % 2]))
    work: dict[str, Callable[[Path], None]] = {
        "generate": _generate, "convert": partial(_convert, logs), "train bc": partial(_train, "bc", store),
        "train bc_ts_h": partial(_train, "bc_ts_h", store), "bc by two": partial(_train_by_two, "bc", store),
        "bc_ts_h by two": partial(_train_by_two, "bc_ts_h", store), "evaluate": partial(_evaluate, store),
        "simulate": partial(_simulate, store),
    }  # fmt: skip
    return {name: Target(action, files) for name, action in work.items()}
