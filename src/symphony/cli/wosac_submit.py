"""Simulate scenarios for the Waymo Open Sim Agents Challenge."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from symphony.cli.shared import TrustCode
from symphony.config import WosacSettings
from symphony.config.wosac import FUTURE
from symphony.errors import ConfigError, DataError
from symphony.wosac.submission_meta import SubmissionMeta

if TYPE_CHECKING:
    from symphony.agents import Agent
    from symphony.wosac.rollouts import RolloutArrays

SHARDS = 150
"""Files of an archive that the challenge's own example has."""


@dataclass(frozen=True)
class Submit:
    """Simulate 32 rollouts of every scenario of the Waymo Open Motion Dataset and write them as a submission.

    The agent drives all vehicles; pedestrians and cyclists keep their velocity. What happens after the current step
    of a scenario is not looked at, so the test set will do. See docs/wosac.md.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder of a run (see `symphony train`), `pretrained:NAME` or `constant_velocity`."""
    data: Annotated[Path, tyro.conf.arg(metavar="FILE|DIR")]
    """Scenario file (TFRecord) with one or many scenarios, folder of such files, or pattern with *."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write (.tar.gz)."""
    meta: Annotated[SubmissionMeta, tyro.conf.arg(name="")]
    shards: int = 0
    """Files in the archive; 0: 150, or one a scenario where there are fewer."""
    trust_code: TrustCode = False
    settings: Annotated[WosacSettings, tyro.conf.arg(name="")] = field(default_factory=WosacSettings)

    def __post_init__(self) -> None:
        if self.shards < 0:
            raise ConfigError(f"--shards must not be negative, is {self.shards}")
        if self.settings.logged_goals:
            raise ConfigError(
                "a submission must not know the routes of the log: --logged-goals is not for it"
            )
        if self.settings.future != FUTURE:
            raise ConfigError(f"a submission has 8 s: --horizon {self.settings.horizon:g} is not for it")

    def run(self) -> None:
        """Simulate, showing how far it is, and write."""
        import sys

        from symphony.agents import load_agent
        from symphony.cli.shared import progress
        from symphony.wosac.submission import write_submission
        from symphony.wosac.submission_check import required_agents

        agent = load_agent(self.agent, self.settings.device, trust_code=self.trust_code)
        # Before hours of simulation: that all can be read, and no scenario comes twice.
        total = len(required_agents(self.data))
        shards = self.shards or min(SHARDS, total)
        if shards > total:
            raise ConfigError(f"{total} scenarios don't fill {shards} shards")
        with progress(f"simulating {agent.name}") as advance:
            found = simulated_scenarios(agent, self.data, self.settings, lambda done: advance(done, total))
            write_submission(found, self.meta, self.out, shards)
        sys.stdout.write(
            f"{total} scenarios in {self.out}: symphony wosac validate {self.out} --scenario {self.data}\n"
        )


def simulated_scenarios(
    agent: Agent, data: Path, settings: WosacSettings, progress: Callable[[int], None] = lambda done: None
) -> Iterator[tuple[str, RolloutArrays]]:
    """Yield id and rollouts of every WOMD scenario of a file, folder or pattern.

    Raises:
        DataError: a record can't be used; names file, scenario and field.
    """
    from symphony.rollouts.workers import shared
    from symphony.wosac.records import read_scenario_payloads, scenario_files

    packed = read_scenario_payloads(scenario_files(data))
    with closing(shared(_Simulation(agent, settings), packed, settings.config(1, 0))) as results:
        for done, found in enumerate(results, 1):
            yield found
            progress(done)


@dataclass(frozen=True)
class _Simulation:
    """Simulates a packed scenario."""

    agent: Agent
    settings: WosacSettings

    def __call__(self, packed: tuple[Path, int, bytes]) -> tuple[str, RolloutArrays]:
        """Id and rollouts."""
        from symphony.data.odd import mended
        from symphony.data.segment import validate
        from symphony.data.sources.womd import scenario_to_segment
        from symphony.wosac.records import parse_scenario
        from symphony.wosac.simulate import with_the_rest, wosac_rollouts

        file, record, payload = packed
        scenario = parse_scenario(payload, file, record)
        try:
            whole = scenario_to_segment(scenario, file=file.name)
            segment = validate(mended(whole))
            found = wosac_rollouts(self.agent, segment, self.settings)
            return scenario.scenario_id, with_the_rest(found, whole)
        except DataError as error:
            raise error.at(file=file, segment=scenario.scenario_id) from None
