"""Score rollouts as the Waymo Open Sim Agents Challenge does; make and check a submission to it."""

from __future__ import annotations

import sys
from dataclasses import field
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import symphony
from symphony import errors, wosac
from symphony.cli import shared
from symphony.config import WosacSettings, checks, evaluation
from symphony.wosac.meta import SubmissionMeta

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
    per_object: bool = False  # Also write the numbers of each scored object into the JSON.
    partial: bool = False  # Leave out scenarios without rollouts; otherwise each must have some.
    strict: Strict = False
    workers: shared.Workers = 1

    def __call__(self) -> None:
        from symphony.data.report import left_out

        if self.per_object and self.json is None:
            raise errors.ConfigError("--per-object adds to the JSON: name its file with --json")
        options = {key: value for key, value in vars(self).items() if key not in ("scenario", "json")}
        with shared.progress("scoring", "scenarios") as advance:
            found, skipped = wosac.score_files(self.scenario, **options, progress=advance)
        if shared.write_numbers(self.json, found):
            numbers = {name: value for name, value in found.items() if isinstance(value, float)}
            shared.print_facts(numbers, f"WOSAC {self.config}, {found['scenario_count']} scenarios")
        for line in left_out(skipped):
            shared.tell(f"left out: {line}")


class Evaluate(shared.Command):
    """Simulate 32 rollouts of every run segment and score them, beside those of baselines.

    The agent drives all vehicles but those that stand with no green light ahead, which stay; pedestrians and cyclists
    roughly keep their velocity. Standard errors are over recordings.
    """

    agent: Agent
    data: Path  # Store of run segments of 8 s or more, of any time step.
    config: Year = "2025"
    json: shared.Json = None
    segments: shared.Segments = ()
    baselines: bool = True  # Score the baselines, too; `--no-baselines` leaves them out.
    strict: Strict = False
    trust_code: shared.TrustCode = False
    settings: Annotated[WosacSettings, arg(name="")] = field(default_factory=WosacSettings)

    def __call__(self) -> None:
        from symphony.data.report import left_out
        from symphony.wosac.table import wosac_table

        agent = symphony.load_agent(self.agent, self.settings.device, trust_code=self.trust_code)
        store = symphony.SegmentStore(self.data)
        items = shared.segment_indices(store, self.segments) or list(range(len(store)))
        how = {"baselines": self.baselines, "strict": self.strict}
        with shared.progress(f"scoring {agent.name}") as advance:
            found = wosac.evaluate_wosac(agent, store, items, self.settings, self.config, advance, **how)
        if shared.write_numbers(self.json, found.record()):
            sys.stdout.write(wosac_table(found.record()))
        for line in left_out(found.left_out):
            shared.tell(f"left out: {line}")


class Submit(shared.Command):
    """Simulate 32 rollouts of every scenario of the Waymo Open Motion Dataset and write them as a submission.

    The agent drives the same objects as in `symphony wosac evaluate`. Nothing after the current step of a scenario is
    read, so scenarios of the test set can be simulated. See docs/wosac.md.
    """

    agent: Agent
    data: Scenarios
    out: Annotated[Path, shared.Result(), arg(metavar="FILE")]  # File to write (.tar.gz).
    meta: Annotated[SubmissionMeta, arg(name="")]
    shards: checks.Natural = 0  # Number of files in the archive; 0: 150, or one per scenario if those are fewer.
    trust_code: shared.TrustCode = False
    settings: Annotated[WosacSettings, arg(name="")] = field(default_factory=WosacSettings)

    def __post_init__(self) -> None:
        if self.settings.logged_goals or self.settings.future != evaluation.FUTURE:
            raise errors.ConfigError("a submission has 8 s and knows no log: no --horizon, no --logged-goals")

    def __call__(self) -> None:
        from symphony.wosac.simulate import simulated_scenarios
        from symphony.wosac.submission import required_agents

        agent = symphony.load_agent(self.agent, self.settings.device, trust_code=self.trust_code)
        total = len(required_agents(self.data))  # first of all: that all can be read, and none comes twice
        shards = self.shards or min(150, total)  # as in the challenge's own example
        if shards > total:
            raise errors.ConfigError(f"{total} scenarios don't fill {shards} shards")
        with shared.progress(f"simulating {agent.name}", "scenarios") as advance:
            found = simulated_scenarios(agent, self.data, self.settings, lambda done: advance(done, total))
            wosac.write_submission(found, self.meta, self.out, shards)
        out, data = (quote(str(path)) for path in (self.out, self.data))
        shared.say(f"{total} scenarios, see symphony wosac validate {out} --scenario {data}")


class Validate(shared.Command):
    """Check a submission offline for what the challenge's server would refuse.

    With --scenario, also that it holds exactly the scenarios and agents that have to be simulated.
    """

    submission: Annotated[Positional[Path], arg(metavar="FILE")]  # File of the submission (.tar.gz).
    #: Scenarios that have to be simulated: file (TFRecord), folder of such files, or pattern with *.
    scenario: Annotated[Path | None, arg(metavar="FILE|DIR")] = None

    def __call__(self) -> None:
        from symphony.wosac.submission import required_agents

        required = None if self.scenario is None else required_agents(self.scenario)
        report = wosac.check_submission(self.submission, required)
        for problem in report.problems[:20]:
            shared.tell(str(problem))
        if report.problems:
            raise errors.DataError(f"{len(report.problems)} problems", file=self.submission)
        shared.say(f"{len(report.scenarios)} scenarios in {len(report.shards)} shards, no problems found")
        if required is None:
            shared.say("Not checked without --scenario: whether scenarios and agents are the right ones")
