"""Score rollouts as the Waymo Open Sim Agents Challenge does, make and check a submission to it."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from symphony.cli.shared import TrustCode, at_least, print_table, progress, segment_indices, write_numbers
from symphony.config import WosacSettings
from symphony.config.wosac import FUTURE
from symphony.errors import ConfigError, DataError, printable
from symphony.files import write_file
from symphony.wosac.meta import SubmissionMeta

if TYPE_CHECKING:
    from symphony.data.report import Skip
    from symphony.wosac.evaluate import WosacEvaluation

SHARDS = 150
"""Files of an archive that the challenge's own example has."""
SHOWN = 20
"""Problems that are printed."""

app = tyro.extras.SubcommandApp()

Year = Literal["2024", "2025"]
Agent = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
Scenarios = Annotated[Path, tyro.conf.arg(metavar="FILE|DIR")]
OptionalFile = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]


@app.command(name="score")
@dataclass(frozen=True)
class Score:
    """Score rollouts, made by anything, against logged scenarios of the Waymo Open Motion Dataset.

    The numbers are those of the official scorer. See docs/wosac.md for what they mean, and for the legal notice that
    goes with the metric.
    """

    scenario: Scenarios
    """Scenario file (TFRecord) with one or many scenarios, folder of such files, or pattern with *."""
    rollouts: Scenarios
    """Rollouts of the only scenario (.npz with object_id [n] and x, y, z, heading [32, n, 80]), or folder with a file
    SCENARIO_ID.npz for each scenario."""
    config: Year = "2025"
    """Year of the challenge."""
    json: OptionalFile = None
    """File to write all numbers to; - for standard output, the table then goes to standard error."""
    per_object: bool = False
    """In that file, give the numbers of each scored object, too."""
    features: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder to write what is compared to, per object and step, as SCENARIO_ID.npz."""
    partial: bool = False
    """Leave out scenarios without rollouts; otherwise each must have some."""
    strict: bool = False
    """Stop at a scenario that can't be scored (without road edges, vehicles or a future), instead of leaving it
    out."""
    workers: int = 1
    """Processes that score."""

    def __post_init__(self) -> None:
        at_least(1, workers=self.workers)
        if self.per_object and self.json is None:
            raise ConfigError("--per-object goes with --json")

    def run(self) -> None:
        """Score, showing how far it is, and report."""
        from rich.console import Console
        from rich.table import Table

        from symphony.wosac.files import score_files

        options = {key: value for key, value in vars(self).items() if key not in ("scenario", "json")}
        with progress("scoring", "scenarios") as advance:
            found, skipped = score_files(self.scenario, **options, progress=advance)
        title = f"WOSAC {self.config}, {found['scenario_count']} scenarios"
        table = Table(show_header=False, box=None, pad_edge=False, title=title, title_justify="left")
        for name, value in found.items():
            if isinstance(value, float):
                table.add_row(name, f"{value:.6f}")
        print_table(table, Console(stderr=str(self.json) == "-"))
        print_left_out(skipped)
        write_numbers(self.json, found)


@app.command(name="evaluate")
@dataclass(frozen=True)
class Evaluate:
    """Simulate 32 rollouts of every run segment and score them, beside those of baselines.

    The agent drives all vehicles but those that stand with no green light ahead, which stay; pedestrians and cyclists
    keep about their velocity. Standard errors are over recordings.
    """

    agent: Agent
    """Folder of a run (see `symphony train`), `pretrained:NAME`, or a baseline."""
    data: Path
    """Store of run segments of 8 s or more, of any time step."""
    config: Year = "2025"
    """Year of the challenge."""
    json: OptionalFile = None
    """File to write all numbers to, those of every run segment included; - for standard output, the table then goes
    to standard error."""
    segments: tuple[str, ...] = ()
    """Ids of the run segments, or their numbers in the store; by default all."""
    baselines: bool = True
    """Score the agent alone."""
    strict: bool = False
    """Stop at a run segment that can't be scored (without road edges, vehicles or a future) instead of leaving it
    out."""
    trust_code: TrustCode = False
    settings: Annotated[WosacSettings, tyro.conf.arg(name="")] = field(default_factory=WosacSettings)

    def run(self) -> None:
        """Simulate and score, showing how far it is, and report."""
        from symphony.agents import load_agent
        from symphony.data.store import SegmentStore
        from symphony.wosac.evaluate import evaluate_wosac

        agent = load_agent(self.agent, self.settings.device, trust_code=self.trust_code)
        store = SegmentStore(self.data)
        items = segment_indices(store, self.segments) or list(range(len(store)))
        options = {"baselines": self.baselines, "strict": self.strict}
        with progress(f"scoring {agent.name}") as advance:
            found = evaluate_wosac(agent, store, items, self.settings, self.config, advance, **options)
        print_wosac(found, aside=str(self.json) == "-")
        write_numbers(self.json, found.record())


@app.command(name="table")
@dataclass(frozen=True)
class Table:
    """Put the scores of several agents on the same run segments into one table (Markdown).

    One line for the agent of each record, after the baselines.
    """

    records: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...")]
    """What `symphony wosac evaluate --json FILE` wrote."""
    names: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Names of the agents; by default what the records say."""
    out: OptionalFile = None
    """File to write it to; otherwise it is printed."""

    def run(self) -> None:
        """Read, compare and write."""
        from symphony.wosac.table import read_wosac, wosac_table

        text = wosac_table([read_wosac(file) for file in self.records], self.names)
        if self.out is None:
            sys.stdout.write(text)
        else:
            write_file(self.out, text)


@app.command(name="submit")
@dataclass(frozen=True)
class Submit:
    """Simulate 32 rollouts of every scenario of the Waymo Open Motion Dataset and write them as a submission.

    The agent drives all vehicles but those that stand with no green light ahead, which stay; pedestrians and cyclists
    keep about their velocity. What happens after the current step of a scenario is not looked at, so the test set
    will do. See docs/wosac.md.
    """

    agent: Agent
    """Folder of a run (see `symphony train`), `pretrained:NAME` or `constant_velocity`."""
    data: Scenarios
    """Scenario file (TFRecord) with one or many scenarios, folder of such files, or pattern with *."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write (.tar.gz)."""
    meta: Annotated[SubmissionMeta, tyro.conf.arg(name="")]
    shards: int = 0
    """Files in the archive; 0: 150, or one a scenario where there are fewer."""
    trust_code: TrustCode = False
    settings: Annotated[WosacSettings, tyro.conf.arg(name="")] = field(default_factory=WosacSettings)

    def __post_init__(self) -> None:
        at_least(0, shards=self.shards)
        if self.settings.logged_goals:
            raise ConfigError(
                "a submission must not know the routes of the log: --logged-goals is not for it"
            )
        if self.settings.future != FUTURE:
            raise ConfigError(f"a submission has 8 s: --horizon {self.settings.horizon:g} is not for it")

    def run(self) -> None:
        """Simulate, showing how far it is, and write."""
        from symphony.agents import load_agent
        from symphony.wosac.simulate import simulated_scenarios
        from symphony.wosac.submission import required_agents, write_submission

        agent = load_agent(self.agent, self.settings.device, trust_code=self.trust_code)
        # Before hours of simulation: that all can be read, and no scenario comes twice.
        total = len(required_agents(self.data))
        shards = self.shards or min(SHARDS, total)
        if shards > total:
            raise ConfigError(f"{total} scenarios don't fill {shards} shards")
        with progress(f"simulating {agent.name}", "scenarios") as advance:
            found = simulated_scenarios(agent, self.data, self.settings, lambda done: advance(done, total))
            write_submission(found, self.meta, self.out, shards)
        check = f"symphony wosac validate {self.out} --scenario {self.data}"
        sys.stdout.write(f"{total} scenarios in {self.out}: {check}\n")


@app.command(name="validate")
@dataclass(frozen=True)
class Validate:
    """Check a submission offline for what the challenge's server would refuse.

    Archive, shards, metadata, number of rollouts and steps, numbers; with --scenario also that it holds exactly the
    scenarios and agents that have to be simulated.
    """

    submission: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The submission (.tar.gz)."""
    scenario: Annotated[Path | None, tyro.conf.arg(metavar="FILE|DIR")] = None
    """Scenario file (TFRecord), folder of such files, or pattern with *: what has to be simulated."""

    def run(self) -> None:
        """Check and report."""
        from symphony.wosac.submission import check_submission, required_agents

        required = None if self.scenario is None else required_agents(self.scenario)
        report = check_submission(self.submission, required)
        for problem in report.problems[:SHOWN]:
            sys.stderr.write(f"{problem}\n")
        if count := len(report.problems):
            raise DataError(f"{count} problem{'s' if count > 1 else ''}", file=self.submission)
        found = f"{len(report.scenarios)} scenarios in {len(report.shards)} shards"
        sys.stdout.write(f"{self.submission}: {found}, all well\n")
        if required is None:
            note = "Not checked, for want of --scenario: whether scenarios and agents are the right ones\n"
            sys.stdout.write(note)


def print_wosac(found: WosacEvaluation, *, aside: bool = False) -> None:
    """Print the numbers of every agent side by side; to stderr if ``aside``."""
    from rich.console import Console
    from rich.table import Table

    rates = ", ".join(f"{rate:g}" for rate in sorted(set(found.rates)))
    title = (
        f"WOSAC {found.config}: {sum(found.objects)} objects scored in {len(found.segments)} run segments, "
        f"{len(set(found.groups))} recordings, logged at {rates} Hz (scored at 10)"
    )
    table = Table(box=None, pad_edge=False, title=title, title_justify="left")
    columns = {name: found.numbers(name) for name in found.results}
    orders = {name: found.order(name) for name in found.results}
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")
    for number in next(iter(columns.values())):
        cells = (_shown(*numbers[number]) for numbers in columns.values())
        table.add_row(number.removesuffix("_likelihood"), *cells)
    pairs = next(iter(orders.values())).pairs
    for share in ("kept", "reversed", "apart"):
        cells = (_shown(getattr(order, share), math.nan) for order in orders.values())
        table.add_row(f"order {share}, of {pairs} pairs", *cells)
    seconds = (sum(one.seconds for one in results) for results in found.results.values())
    table.add_row("CPU seconds", *(f"{value:.1f}" for value in seconds))
    print_table(table, Console(stderr=aside))
    print_left_out(found.left_out)


def print_left_out(skipped: list[Skip]) -> None:
    """Print why scenarios have no score, on standard error."""
    from symphony.data.report import left_out

    for line in left_out(skipped):
        sys.stderr.write(f"left out: {printable(line)}\n")


def _shown(mean: float, error: float) -> str:
    if math.isnan(mean):
        return "–"
    return f"{mean:.4f}" if math.isnan(error) else f"{mean:.4f} ± {error:.4f}"
