"""Score an agent on run segments of any source as the Waymo Open Sim Agents Challenge does."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from symphony.cli.shared import TrustCode, write_numbers
from symphony.cli.wosac_score import print_left_out
from symphony.config import WosacSettings

if TYPE_CHECKING:
    from symphony.wosac.evaluate import WosacEvaluation


@dataclass(frozen=True)
class Evaluate:
    """Simulate 32 rollouts of every run segment and score them, beside log playback, constant velocity and random.

    The agent drives all vehicles; pedestrians and cyclists keep their velocity. Standard errors are over recordings.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder of a run (see `symphony train`), `pretrained:NAME`, or a baseline."""
    data: Path
    """Store of run segments of 8 s or more, of any time step."""
    config: Literal["2024", "2025"] = "2025"
    """Year of the challenge."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
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
        from symphony.cli.shared import progress, segment_indices
        from symphony.data.store import SegmentStore
        from symphony.wosac.evaluate import evaluate_wosac

        agent = load_agent(self.agent, self.settings.device, trust_code=self.trust_code)
        store = SegmentStore(self.data)
        items = segment_indices(store, self.segments) or list(range(len(store)))
        with progress(f"scoring {agent.name}") as advance:
            found = evaluate_wosac(
                agent,
                store,
                items,
                self.settings,
                self.config,
                advance,
                baselines=self.baselines,
                strict=self.strict,
            )
        print_wosac(found, aside=str(self.json) == "-")
        if self.json is not None:
            write_numbers(self.json, found.record())


def print_wosac(found: WosacEvaluation, *, aside: bool = False) -> None:
    """Print the numbers of every agent side by side; to stderr if ``aside``."""
    from rich.console import Console
    from rich.table import Table

    title = f"WOSAC {found.config}, {len(found.segments)} run segments, {len(set(found.groups))} recordings"
    table = Table(box=None, pad_edge=False, title=title, title_justify="left")
    columns = {name: found.numbers(name) for name in found.results}
    orders = {name: found.order(name) for name in found.results}
    table.add_column("", overflow="fold")
    for name in columns:
        table.add_column(name, justify="right")
    for number in next(iter(columns.values())):
        table.add_row(
            number.removesuffix("_likelihood"), *(_shown(*numbers[number]) for numbers in columns.values())
        )
    pairs = next(iter(orders.values())).pairs
    for share in ("kept", "reversed", "apart"):
        cells = (_shown(getattr(order, share), math.nan) for order in orders.values())
        table.add_row(f"order {share}, of {pairs} pairs", *cells)
    table.add_row("CPU seconds", *(f"{result.seconds:.1f}" for result in found.results.values()))
    Console(stderr=aside).print(table)
    print_left_out(found.left_out)


def _shown(mean: float, error: float) -> str:
    if math.isnan(mean):
        return "–"
    return f"{mean:.4f}" if math.isnan(error) else f"{mean:.4f} ± {error:.4f}"
