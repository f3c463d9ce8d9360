"""Compare planners among crowds, test them against thresholds, estimate how often they fail if that is rare."""

from __future__ import annotations

from dataclasses import asdict
from math import isnan
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import symphony
from symphony import errors, files
from symphony.cli import shared
from symphony.config import checks

Rate = Literal["at_fault_collision_rate", "collision_rate", "red_light_rate", "offroad_rate", "wrong_way_rate",
               "blocking_rate", "failed_rate"]  # fmt: skip
Device = Annotated[str, arg(help="Device that simulates: `cpu`, `cuda` or `cuda:N`.")]


class Planners(shared.Command):
    """Compare planners, each among several crowds: one table, and which planner is first in each crowd.

    The score of a run is its progress in percent of the log's, at most 100, but 0 if the run failed or the planner is
    at fault in a collision, runs a red light or leaves the road. Runs whose progress is not defined have no score.
    """

    records: shared.SavedFolders
    out: shared.ResultFile = None  # File to write the table to; otherwise it is printed.
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.evaluation.planners import check_crowds, planner_record, planners_text
        from symphony.saved.folder import load_rollouts

        records = [planner_record(load_rollouts(path)) for path in self.records]
        check_crowds(records)
        if shared.write_numbers(self.json, {"records": records}) or self.out is not None:
            shared.write_text(self.out, planners_text(records))


class Test(shared.Command):
    """Test planners among crowds against a suite of thresholds, such as collisions at fault in at most 1 % of runs.

    The suite is a TOML file (see docs/test-bench.md and examples/suite.toml). The exit status is 0 if every threshold
    is kept, 1 if one is not, and 2 if the suite could not run. An interrupted suite is continued by the same command.
    """

    suite: Annotated[Positional[Path], arg(metavar="SUITE")]  # File of the suite.
    #: Folder of the results: index.html, result.json, junit.xml, and the rollouts of each planner and crowd.
    out: Annotated[Path, arg(metavar="DIR")] = Path("out/test")
    junit: shared.ResultFile = None  # File to write the JUnit XML to as well.
    json: shared.Json = None
    view: bool = True  # Whether the pages that play the rollouts are written.
    workers: shared.Workers = 1
    engine: shared.EngineName = "local"
    device: Device = "cpu"

    def __call__(self) -> None:
        from symphony.bench.pages import junit, page, sentence
        from symphony.bench.run import run_suite
        from symphony.bench.suite import read_suite

        index = self.out / "index.html"
        try:
            suite = read_suite(self.suite, workers=self.workers, engine=self.engine, device=self.device)
            with shared.progress(suite.name, "runs") as advance:
                result = run_suite(suite, self.out, lambda name, n, of: advance(n, of, name), view=self.view)
            for file in (self.out / "junit.xml", self.junit):
                if file is not None:
                    files.write_file(file, junit(result))
            files.write_file(index, page(result, view=self.view))
            if shared.write_numbers(self.json, result.plain()):
                for one in result.verdicts:
                    shared.say(f"{one.status:9} {one.planner} among {one.crowd}: {sentence(one)}")
                for run in result.regressions[:5]:  # all of them are in the files
                    which = "segment {segment}, rollout {rollout}, seed {seed}: {what}".format_map(run)
                    shared.say(f"worse than the baseline: {run['planner']} among {run['crowd']}, {which}")
                shared.say(f"written: {index}")
        except (errors.SymphonyError, OSError) as error:
            raise errors.CouldNotRunError(str(error)) from error
        count, failing = len(result.verdicts), sum(one.status != "passes" for one in result.verdicts)
        if failing:
            raise errors.SymphonyError(f"{failing} of {count} thresholds are not kept: see {index}")


class Hunt(shared.Command):
    """Hunt for rare failures of a planner among learned agents, and estimate how often they happen.

    Traffic in which the ego comes near to a collision is simulated more often, and weighs less in turn, so that the
    estimate has no bias. It holds for these run segments alone; its error is one standard error over trees. Some runs
    that show the failure are kept: view them with `symphony view`.
    """

    #: Learned agent that drives the others: folder of a run (see `symphony train`), or `pretrained:NAME`.
    agent: Annotated[Positional[str], arg(metavar="RUN")]
    planner: str  # Planner that drives the ego, as for `symphony simulate`; a process can't be copied.
    data: Path  # Store of run segments.
    out: Path  # Folder of the runs that are kept, at most 3 of a run segment.
    metric: Rate = "at_fault_collision_rate"  # Rate to estimate, in percent of runs (see docs/metrics.md).
    segments: shared.Segments = ()
    trust_code: shared.TrustCode = False
    trees: Annotated[int, checks.Bounds(4)] = 8  # Independent estimates of a run segment, one tree each.
    branches: Annotated[int, checks.Bounds(2)] = 32  # Rollouts of a tree; near a collision they are copied.
    interactive: checks.Natural = 0  # Agents that are driven, the ego included; 0: as the agent was trained.
    duration: checks.Natural = 0  # Seconds to simulate; 0: as many as the agent was trained with.
    seed: int = 0  # Seed of everything that is drawn at random.
    workers: shared.Workers = 1
    engine: shared.EngineName = "local"
    device: Device = "cpu"
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.bench import rare
        from symphony.rollouts.crowd import crowd_dataset

        names = ("trees", "branches", "interactive", "duration", "seed", "workers", "engine", "device")
        config = symphony.EvaluateConfig(**{name: getattr(self, name) for name in names}, rollouts=self.trees)
        agent = symphony.load_agent(self.agent, self.device, trust_code=self.trust_code)
        store = symphony.SegmentStore(self.data)
        chosen = shared.segment_indices(store, self.segments) or None
        dataset = crowd_dataset(store, agent, config, chosen, routes=True)
        with shared.progress("hunting") as advance:
            found = rare.hunt(self.out, rare.Hunt(agent, dataset, config, self.planner, self.metric), advance)
        known = sum(not isnan(one.rate) for one in found[:-1])
        if shared.write_numbers(self.json, [asdict(one) for one in found]):
            rows = [["segment", f"{self.metric} %", "±", "in trees", "runs kept"]]
            for one in found:
                numbers = (100 * min(one.rate, 1.0), 100 * one.error)
                told = ["–" if isnan(x) else f"{x:.3g}" for x in numbers]
                trees = f"{one.trees} of {self.trees * (1 if one.segment else known)}"
                rows.append([one.segment or f"mean of {known}", *told, trees, str(one.kept)])
            shared.print_table(rows, heads=1)
            if found[-1].kept:
                shared.say(f"view them: symphony view {quote(str(self.out))}")
        for remark in rare.remarks(found):
            shared.tell(remark)
