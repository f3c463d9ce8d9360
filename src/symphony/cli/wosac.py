"""Score rollouts as the Waymo Open Sim Agents Challenge does, make and check a submission to it."""

from __future__ import annotations

import sys
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

import symphony
from symphony.cli import shared
from symphony.config import WosacSettings
from symphony.config.checks import Natural
from symphony.config.evaluation import FUTURE
from symphony.errors import ConfigError, DataError
from symphony.wosac.meta import SubmissionMeta

if TYPE_CHECKING:
    from symphony.data.report import Skip

SHARDS, SHOWN = 150, 20
"""Files of an archive, as in the challenge's own example; problems that are printed."""
Year = Annotated[Literal["2024", "2025"], arg(help="Year of the challenge.")]
_AGENT = "Folder of a run (see `symphony train`), `pretrained:NAME`, or a baseline."
Agent = Annotated[Positional[str], arg(metavar="RUN", help=_AGENT)]
_SCENARIOS = "Scenario file (TFRecord) with one or many scenarios, folder of such files, or pattern with *."
Scenarios = Annotated[Path, arg(metavar="FILE|DIR", help=_SCENARIOS)]
_STRICT = "Stop at what can't be scored (without road edges, vehicles or a future) instead of leaving it out."
Strict = Annotated[bool, arg(help=_STRICT)]


class Score(shared.Command):
    """Score rollouts, made by anything, against logged scenarios of the Waymo Open Motion Dataset.

    The numbers are those of the official scorer; docs/wosac.md says what they mean, and has the legal notice.
    """

    scenario: Scenarios
    #: Rollouts of the only scenario (.npz with object_id [n] and x, y, z, heading [32, n, 80]), or folder with a file
    #: SCENARIO_ID.npz for each scenario.
    rollouts: Annotated[Path, arg(metavar="FILE|DIR")]
    config: Year = "2025"
    json: shared.Json = None
    per_object: bool = False  # Write the numbers of each scored object into the JSON, too.
    #: Folder to write what is compared to, per object and step, as SCENARIO_ID.npz.
    features: Annotated[Path | None, arg(metavar="DIR")] = None
    partial: bool = False  # Leave out scenarios without rollouts; otherwise each must have some.
    strict: Strict = False
    workers: shared.Workers = 1

    def __call__(self) -> None:
        from symphony.wosac.files import score_files

        options = {key: value for key, value in vars(self).items() if key not in ("scenario", "json")}
        with shared.progress("scoring", "scenarios") as advance:
            found, skipped = score_files(self.scenario, **options, progress=advance)
        if shared.write_numbers(self.json, found):
            numbers = {name: value for name, value in found.items() if isinstance(value, float)}
            shared.print_facts(numbers, f"WOSAC {self.config}, {found['scenario_count']} scenarios")
        _print_left_out(skipped)


class Evaluate(shared.Command):
    """Simulate 32 rollouts of every run segment and score them, beside those of baselines.

    The agent drives all vehicles but those that stand with no green light ahead, which stay; pedestrians and cyclists
    keep about their velocity. Standard errors are over recordings.
    """

    agent: Agent
    data: Path  # Store of run segments of 8 s or more, of any time step.
    config: Year = "2025"
    json: shared.Json = None
    segments: shared.Segments = ()
    baselines: bool = True  # Score the agent alone.
    strict: Strict = False
    trust_code: shared.TrustCode = False
    settings: Annotated[WosacSettings, arg(name="")] = field(default_factory=WosacSettings)

    def __call__(self) -> None:
        from symphony.wosac.evaluate import evaluate_wosac
        from symphony.wosac.table import wosac_table

        agent = symphony.load_agent(self.agent, self.settings.device, trust_code=self.trust_code)
        store = symphony.SegmentStore(self.data)
        items = shared.segment_indices(store, self.segments) or list(range(len(store)))
        options = {"baselines": self.baselines, "strict": self.strict}
        with shared.progress(f"scoring {agent.name}") as advance:
            found = evaluate_wosac(agent, store, items, self.settings, self.config, advance, **options)
        if shared.write_numbers(self.json, found.record()):
            sys.stdout.write(wosac_table([found.record()]))
        _print_left_out(found.left_out)


class Table(shared.Command):
    """Put the scores of several agents on the same run segments into one table (Markdown), after the baselines."""

    #: Files that `symphony wosac evaluate --json FILE` wrote.
    records: Annotated[Positional[shared.Paths], arg(metavar="FILE ...")]
    #: Names of the agents; by default what the records say.
    names: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    out: shared.ResultFile = None  # File to write it to; otherwise it is printed.

    def __call__(self) -> None:
        from symphony.wosac.table import read_wosac, wosac_table

        shared.write_text(self.out, wosac_table([read_wosac(file) for file in self.records], self.names))


class Submit(shared.Command):
    """Simulate 32 rollouts of every scenario of the Waymo Open Motion Dataset and write them as a submission.

    Who drives what is as in `symphony wosac evaluate`. What happens after the current step of a scenario is not
    looked at, so the test set will do. See docs/wosac.md.
    """

    agent: Agent
    data: Scenarios
    out: Annotated[Path, shared.Result(), arg(metavar="FILE")]  # File to write (.tar.gz).
    meta: Annotated[SubmissionMeta, arg(name="")]
    #: Number of files in the archive; 0: 150, or one a scenario where there are fewer.
    shards: Natural = 0
    trust_code: shared.TrustCode = False
    settings: Annotated[WosacSettings, arg(name="")] = field(default_factory=WosacSettings)

    def __post_init__(self) -> None:
        if self.settings.logged_goals or self.settings.future != FUTURE:
            raise ConfigError(
                "a submission has 8 s and must not know the log: no --horizon, no --logged-goals"
            )

    def __call__(self) -> None:
        from symphony.wosac.simulate import simulated_scenarios
        from symphony.wosac.submission import required_agents, write_submission

        agent = symphony.load_agent(self.agent, self.settings.device, trust_code=self.trust_code)
        # Before hours of simulation: that all can be read, and no scenario comes twice.
        total = len(required_agents(self.data))
        shards = self.shards or min(SHARDS, total)
        if shards > total:
            raise ConfigError(f"{total} scenarios don't fill {shards} shards")
        with shared.progress(f"simulating {agent.name}", "scenarios") as advance:
            found = simulated_scenarios(agent, self.data, self.settings, lambda done: advance(done, total))
            write_submission(found, self.meta, self.out, shards)
        shared.say(f"{total} scenarios, see symphony wosac validate {self.out} --scenario {self.data}")


class Validate(shared.Command):
    """Check a submission offline for what the challenge's server would refuse.

    With --scenario, also that it holds exactly the scenarios and agents that have to be simulated.
    """

    submission: Annotated[Positional[Path], arg(metavar="FILE")]  # File of the submission (.tar.gz).
    #: Scenarios that have to be simulated: file (TFRecord), folder of such files, or pattern with *.
    scenario: Annotated[Path | None, arg(metavar="FILE|DIR")] = None

    def __call__(self) -> None:
        from symphony.wosac.submission import check_submission, required_agents

        required = None if self.scenario is None else required_agents(self.scenario)
        report = check_submission(self.submission, required)
        for problem in report.problems[:SHOWN]:
            shared.tell(str(problem))
        if report.problems:
            raise DataError(f"{len(report.problems)} problems", file=self.submission)
        shared.say(f"{len(report.scenarios)} scenarios in {len(report.shards)} shards, all well")
        if required is None:
            shared.say("Not checked, for want of --scenario: whether scenarios and agents are the right ones")


def _print_left_out(skipped: list[Skip]) -> None:
    """Print why scenarios have no score, on standard error."""
    from symphony.data.report import left_out

    for line in left_out(skipped):
        shared.tell(f"left out: {line}")
