"""Say which agents come with the package."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import Positional, arg

from symphony.cli import shared


class Agents(shared.Command):
    """Print the model cards of the agents that come with the package: data, seeds, scores and limits."""

    #: Names of the agents to print; by default all.
    names: Annotated[Positional[tuple[str, ...]], arg(metavar="[pretrained:NAME ...]")] = ()
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.agents.agent import PREFIX, pretrained_folder, pretrained_names, read_card

        names = self.names or tuple(PREFIX + name for name in pretrained_names())
        folders = [pretrained_folder(name) for name in names]
        if shared.write_numbers(self.json, {"agents": [read_card(folder) for folder in folders]}):
            shared.say("\n\n".join((folder / "README.md").read_text(encoding="utf-8") for folder in folders))
