"""Say which agents come with the package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from symphony.cli.shared import ResultFile, metrics_table, print_table, write_numbers


@dataclass(frozen=True)
class Agents:
    """Print the model cards of the agents that come with the package: data, seeds, scores and limits."""

    names: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[pretrained:NAME ...]")
    ] = ()
    """Names of the agents to print; by default all."""
    json: ResultFile = None
    """File to write all numbers to; - for standard output, in place of the cards."""

    def run(self) -> None:
        """Print them."""
        from symphony.agents.included import PREFIX, pretrained_folder, pretrained_names, read_card

        names = self.names or tuple(PREFIX + name for name in pretrained_names())
        cards = [read_card(pretrained_folder(name)) for name in names]
        write_numbers(self.json, {"agents": cards})
        if str(self.json) != "-":
            for card in cards:
                print_card(card)


def print_card(card: dict[str, Any]) -> None:
    """Print one model card."""
    from rich.console import Console

    console = Console(highlight=False)

    def words(text: str, style: str = "") -> None:
        console.print(text.replace("`", ""), style=style, markup=False)

    words(card["name"], "bold")
    words(card["about"])
    words(f"Training: {card['training']['words']}")
    for found in card["scores"]:
        rows = [{**row, "agent": label or card["name"]} for label, row in found["rows"].items()]
        print_table(metrics_table(rows, first=found["data"]), console)
        words(
            f"{found['segments']} run segments of {found['groups']} recordings, {found['interactive']} interactive "
            f"agents each; per segment {found['how']}; ± standard error over recordings; seed {found['seed']}",
            "dim",
        )
    words(f"Limits: {card['limits']}\n")
