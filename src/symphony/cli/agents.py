"""Train agents, evaluate them against the log, build the paper's tables; show the included agents, run a demo."""

from __future__ import annotations

import dataclasses
import os
import platform
import shlex
import shutil
import sys
import time
from importlib.metadata import distributions
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

import symphony
from symphony import files, render
from symphony.cli import shared
from symphony.config import AgentConfig, PaperData, PerturbConfig, Setting, TableFormat, WosacSettings
from symphony.config.checks import Count
from symphony.config.profiles import WORDS, Profile

PANELS, SHOWN, NAMED = 6, 8, 5
"""Run segments in one picture, rollouts that are drawn of each, runs left out for one reason that are named."""
BASELINES = {"log playback": "playback", "constant velocity": "constant_velocity"}
"""Agents of the demo by their titles, of which only the numbers are shown."""
PACKAGES = "torch torchrl tensordict numpy shapely matplotlib wandb safetensors"
EXTRAS = "eclipse-sumo pyarrow ray imageio-ffmpeg gymnasium"


class Train(shared.Command):
    """Train agents on a store of run segments."""

    config: Annotated[symphony.TrainConfig, arg(name="")]
    profile: Annotated[Profile, arg(help=WORDS)] = "default"

    def __call__(self) -> None:
        from symphony.agents.choice import best_of, choose

        folder = symphony.train(self.config)
        if os.environ.get("RANK", "0") != "0":  # of the processes that torchrun starts, one prints
            return
        score = "the last one; nothing was validated, see --validation.data"
        if (best := best_of(choose(folder, "last"))) is not None:
            score = f"the best one, with collision rate plus off-road time of {best.infractions:.2f} % in validation"
        shared.say(f"trained agent  {folder}\ncheckpoint     {choose(folder).name}: {score}")
        shared.say(f"curves         symphony plot curves {shlex.quote(str(folder))} --out curves.png")
        shared.say(f"evaluate it    symphony evaluate {shlex.quote(str(folder))} --data DIR")


class Evaluate(shared.SimulationOptions):
    """Simulate the interactive agents of every run segment and compare them with the log.

    The log itself and agents at constant velocity are evaluated beside the agent. A run keeps the results as
    evaluations/NAME.json in its folder, where `symphony table` looks for them; --segments leaves the folder as it is.
    """

    json: shared.Json = None
    figure: shared.ResultFile = None  # Picture (.png, .pdf or .svg) or animation (.gif) of some rollouts.
    save_rollouts: shared.Folder = None  # Folder for the rollouts that are evaluated (see `symphony view`).
    details: bool = False  # Print every number of each agent, not only the table (see docs/metrics.md).
    keep: bool = True  # Keep the results in the folder of the run; `--no-keep` does not.
    #: Import paths of metrics of your own, functions from scenes and rollouts to a number per rollout.
    metric: tuple[str, ...] = ()
    #: More scores for the record and `symphony table`: `wosac` (2025), 32 rollouts of all agents (see docs/wosac.md).
    metrics: tuple[Literal["wosac"], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "config", dataclasses.replace(self.config, metric=self.metric))

    def __call__(self) -> None:
        from symphony.evaluation.records import evaluation_record, keep_evaluation
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.saved import folder, saving

        if self.figure is not None:
            from symphony.render.style import ANIMATIONS, FORMATS, picture_path

            picture_path(self.figure, (*FORMATS, *ANIMATIONS))
        agent = symphony.load_agent(self.agent, self.config.device, trust_code=self.trust_code)
        store, config = symphony.SegmentStore(self.data), self.config
        shared.check_search(agent, config)
        chosen = shared.segment_indices(store, self.segments)
        if self.metrics:
            from symphony.wosac.evaluate import evaluate_wosac, scorable, wosac_parts
            from symphony.wosac.table import wosac_table

            rows, settings = chosen or range(len(store)), WosacSettings.of(config)
            scorable(store, rows, settings.future)  # fails now, not after the work
        shown = [] if self.figure is None else evenly_spaced(len(chosen or store), PANELS)
        clips: list[render.Clip] = []
        writer: folder.RolloutWriter | None = None
        if self.save_rollouts is not None:
            plain = saving.plain_settings(config, agent, agent.interactive, agent.duration)
            about = folder.About.of(agent.name, store, plain, seed=config.seed)
            writer = folder.RolloutWriter(self.save_rollouts, about)

        def observe(item: int, saved: Any) -> None:
            if item in shown:
                name = f"{shared.short_name(agent.name)}: {saved.segment.segment_id}"
                clips.append(render.saved_clip(saved, SHOWN, name))
            if writer is not None and not writer.has(saved.segment.segment_id):
                writer.add(saved)

        how: dict[str, Any] = {"observe": observe} if shown or writer is not None else {}
        how |= {"items": chosen or None, "baselines": True}
        with shared.progress(f"evaluating {agent.name}") as advance:
            found = symphony.evaluate(agent, store, config, advance, **how)
        record = evaluation_record(agent, found, store)
        if self.metrics:
            with shared.progress(f"WOSAC score of {agent.name}") as advance:
                scored = evaluate_wosac(agent, store, rows, settings, progress=advance)
            record |= wosac_parts(scored, record)
        if shared.write_numbers(self.json, record):
            others = [one.numbers() for one in found.baselines if one.agent != found.agent]
            shared.print_metrics([*others, found.numbers()], str(self.data), details=self.details)
            if self.metrics:
                sys.stdout.write(wosac_table(scored.record()))
        if self.figure is not None:
            render.draw_clips(clips, self.figure)
        if self.keep and not chosen:  # last: the run may be another's, to read only
            keep_evaluation(agent.name, record)


class Table(shared.Command):
    """Build one of the paper's tables from runs that `symphony evaluate` (or a recipe) has evaluated.

    Each method (and each way in which it was simulated) has a row: mean and standard error over its seeds. Runs of
    other settings are left out.
    """

    #: Setting of the table. `main`: 10 s, 2 interactive agents; `long`: 20 s, 2 agents; `many`: 10 s, 8 agents.
    setting: Setting
    runs: Annotated[shared.Paths, arg(metavar="DIR ...")]  # Folders of runs, or folders that hold some.
    #: Names of evaluations, for runs that keep several; * and ? stand for anything, and the first that fits decides.
    evaluation: shared.Names = ()
    paper: PaperData | None = None  # Data set on which the paper's own figures are shown beside ours.
    format: TableFormat = "markdown"  # Format of the table.
    out: shared.ResultFile = None  # File to write the table to; otherwise it is printed.

    def __call__(self) -> None:
        from symphony.evaluation.table import collect, compare, table_text

        entries, left_out = collect(self.runs, self.setting, self.evaluation)
        for reason, folders in left_out.items():
            more = f" and {len(folders) - NAMED} more" if len(folders) > NAMED else ""
            shared.tell(f"left out, {reason}: {', '.join(map(str, folders[:NAMED]))}{more}")
        table = compare(entries, self.setting, self.paper)
        shared.write_text(self.out, files.json_text(table) if self.format == "json" else table_text(table))


class Agents(shared.Command):
    """Print the model cards of the agents that come with the package: data, seeds, scores and limits."""

    #: Names of the agents to print; by default all.
    names: Annotated[Positional[tuple[str, ...]], arg(metavar="[pretrained:NAME ...]")] = ()
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.agents.choice import PREFIX, pretrained_folder, pretrained_names, read_card

        names = self.names or tuple(PREFIX + name for name in pretrained_names())
        folders = [pretrained_folder(name) for name in names]
        if shared.write_numbers(self.json, {"agents": [read_card(folder) for folder in folders]}):
            shared.say("\n\n".join((folder / "README.md").read_text(encoding="utf-8") for folder in folders))


class Demo(shared.Command):
    """Evaluate and draw an agent that comes with the package, on the built-in data: half a minute on a laptop.

    Then train another on the built-in data, which takes a few minutes, and show it beside the first.
    """

    out: Path = Path("out/demo")  # Folder for agent, pictures, numbers; an earlier demo there is replaced.
    steps: Count = 1500  # Updates of the agent that is trained.
    rollouts: Count = 16  # Rollouts per run segment in the evaluation.
    seed: int = 0  # Seed of the training and of the rollouts.

    def __call__(self) -> None:
        with files.Lock(self.out / "demo.lock"):
            self._show_all()

    def _show_all(self) -> None:
        from symphony.learning.demonstrations import evenly_spaced

        began, run, numbers = time.perf_counter(), self.out / "bc_h", self.out / "metrics.json"
        test = symphony.builtin_store("test")
        settings = symphony.EvaluateConfig(rollouts=self.rollouts, seed=self.seed)
        items = evenly_spaced(len(symphony.SegmentStore(test)), 3)
        rows: list[dict[str, Any]] = []
        clips: list[render.Clip] = []

        def show(agents: dict[str, str], picture: Path) -> None:
            """Evaluate agents by their titles, and show them beside the earlier ones."""
            for title, agent in agents.items():
                kept: dict[int, Any] = {}
                with shared.progress(f"evaluating {title}") as advance:
                    found = symphony.evaluate(agent, test, settings, advance, observe=kept.__setitem__)
                rows.append({**found.numbers(), "agent": title})
                for saved in [] if title in BASELINES else map(kept.__getitem__, items):
                    clips.append(render.saved_clip(saved, SHOWN, f"{title}: {saved.segment.segment_id}"))
            shared.print_metrics(rows, "Built-in test segments")
            files.write_json(numbers, {"rows": rows, "seconds": round(time.perf_counter() - began, 1)})
            render.draw_clips(clips, picture, columns=len(items))
            shared.say(f"picture: {picture}")

        shared.say("An included agent, on segments that it has not seen, with its search:")
        show({**BASELINES, "included BC+TS+H": "pretrained:bc_ts_h"}, self.out / "included.png")
        shared.say(f"\nNow one of your own: BC with goals (BC+H), {self.steps} updates, a few minutes.")
        if (run / "config.json").is_file():
            shutil.rmtree(run)
        # Cheaper updates than by default suit the few segments of the package; so do inputs beyond the paper's, and
        # displaced states once the policy drives.
        agent = AgentConfig(num_points=128, num_lights=4, features="gaps", accelerations=21)
        perturb = PerturbConfig(share=0.5, begin=self.steps // 3)
        more: dict[str, Any] = {"states": 512, "agent": agent, "perturb": perturb, "wandb": "disabled"}
        more |= {"data": symphony.builtin_store("train"), "out": run, "steps": self.steps, "seed": self.seed}
        symphony.train(symphony.TrainConfig(method="bc_h", **more))
        show({"your BC+H": str(run)}, self.out / "rollouts.png")
        shared.say(f"numbers: {numbers}\nagent:   {run}\nnext:    symphony evaluate {run} --data DIR")


class Doctor(shared.Command):
    """Show what is installed, and simulate a second with an agent that comes with the package."""

    json: shared.Json = None

    def __call__(self) -> None:
        import torch

        began, second = time.perf_counter(), symphony.EvaluateConfig(rollouts=2, duration=1)
        test = symphony.builtin_store("test")
        numbers = symphony.evaluate("pretrained:bc_ts_h", test, second, items=[0]).numbers()
        spent, held = time.perf_counter() - began, {one.name: one.version for one in reversed([*distributions()])}
        devices = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
        found: dict[str, Any] = {
            "symphony": {"version": symphony.__version__, "at": symphony.__file__},
            "python": {"version": platform.python_version(), "at": sys.executable},
            "system": {"kernel": platform.platform(), "cores": os.cpu_count(), "CUDA devices": devices},
            "packages": {name: held.get(name, "not installed") for name in PACKAGES.split()},
            "extras": {name: held.get(name, "not installed") for name in EXTRAS.split()},
            "simulation": {"rollouts": numbers["rollouts"], "seconds": spent, "ADE": numbers["ade"]},
        }
        if shared.write_numbers(self.json, found):
            shared.print_facts(found)
