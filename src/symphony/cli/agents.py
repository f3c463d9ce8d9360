"""Say which agents come with the package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from symphony.cli.tables import COLUMNS, number_cell, print_table, write_numbers


@dataclass(frozen=True)
class Agents:
    """Print the model cards of the agents that come with the package: data, seeds, scores and limits."""

    names: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[pretrained:NAME ...]")
    ] = ()
    """Only these agents; by default all."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write all numbers to; - for standard output, in place of the cards."""

    def run(self) -> None:
        """Print them."""
        from symphony.agents.included import PREFIX, pretrained_folder, pretrained_names, read_card

        names = self.names or tuple(PREFIX + name for name in pretrained_names())
        cards = [read_card(pretrained_folder(name)) for name in names]
        if self.json is not None:
            write_numbers(self.json, {"agents": cards})
        if str(self.json) != "-":
            for card in cards:
                print_card(card)


def print_card(card: dict[str, Any]) -> None:
    """Print one model card."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)

    def words(text: str, style: str = "") -> None:
        console.print(escape(text.replace("`", "")), style=style)

    console.print(escape(card["name"]), style="bold")
    words(card["about"])
    words(f"Training: {card['training']['words']}")
    for found in card["scores"]:
        table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
        table.add_column(escape(found["data"]), no_wrap=True)
        for _, heading, _ in COLUMNS:
            table.add_column(heading, justify="right", no_wrap=True)
        for label, row in found["rows"].items():
            cells = [number_cell(row[name], row[f"{name}_se"], digits) for name, _, digits in COLUMNS]
            table.add_row(escape(label or card["name"]), *cells)
        print_table(table, console)
        words(
            f"{found['segments']} run segments of {found['groups']} recordings, {found['interactive']} interactive "
            f"agents each; per segment {found['how']}; ± standard error over recordings; seed {found['seed']}",
            "dim",
        )
    words(f"Limits: {card['limits']}\n")
