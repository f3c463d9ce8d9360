"""Say whether this installation works."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from symphony.cli.tables import print_table, write_numbers

CORE = ("torch", "torchrl", "tensordict", "numpy", "shapely", "matplotlib", "wandb", "safetensors")
EXTRAS = {
    "sumo": ("sumo", "eclipse-sumo"),
    "argoverse2": ("pyarrow", "pyarrow"),
    "ray": ("ray", "ray"),
    "video": ("imageio_ffmpeg", "imageio-ffmpeg"),
    "gym": ("gymnasium", "gymnasium"),
}
"""Optional extras: the module that each brings, and its distribution."""


@dataclass(frozen=True)
class Doctor:
    """Say what is installed, and simulate a second with an agent that comes with the package."""

    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write what was found to; - for standard output, in place of the table."""

    def run(self) -> None:
        """Look, simulate, print."""
        from rich.console import Console
        from rich.markup import escape
        from rich.table import Table

        found = examined()
        if self.json is not None:
            write_numbers(self.json, found)
        if str(self.json) == "-":
            return
        table = Table(show_header=False, box=None, pad_edge=False)
        for name, value in found.items():
            for k, (part, text) in enumerate(value.items() if isinstance(value, dict) else [("", value)]):
                table.add_row("" if k else name, part, escape(str(text)))
        print_table(table, Console(highlight=False))


def examined() -> dict[str, Any]:
    """What is installed, where things are kept, and what a short simulation gave.

    Raises:
        SymphonyError: the simulation fails.
    """
    import os
    import platform
    import sys
    import tempfile
    from importlib.metadata import version

    import torch

    from symphony._version import __version__
    from symphony.agents.included import FOLDER, pretrained_names

    devices = ", ".join(torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count()))
    return {
        "symphony": {"version": __version__, "at": str(FOLDER.parent)},
        "python": {"version": platform.python_version(), "at": sys.executable},
        "system": {"kernel": platform.platform(), "cores": os.cpu_count()},
        "packages": {name: version(name) for name in CORE},
        "extras": {name: _extra(module, package) for name, (module, package) in EXTRAS.items()},
        "torch": {
            "threads": torch.get_num_threads(),
            "OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "not set"),
            "CUDA devices": devices or "none",
        },
        "agents": {"included": ", ".join(pretrained_names())},
        "folders": {
            "matplotlib": _matplotlib_cache(),
            "wandb": os.environ.get("WANDB_DIR", "in the folder of each run"),
            "temporary": tempfile.gettempdir(),
        },
        "simulation": _simulated(),
    }


def _extra(module: str, package: str) -> str:
    from importlib.metadata import PackageNotFoundError, version
    from importlib.util import find_spec

    if find_spec(module) is None:
        return "not installed"
    try:
        return version(package)
    except PackageNotFoundError:
        return "installed"


def _matplotlib_cache() -> str:
    import matplotlib as mpl

    return mpl.get_cachedir()


def _simulated() -> dict[str, Any]:
    """A second of the first segment of the built-in data, by an agent that comes with the package."""
    import time

    from symphony import EvaluateConfig, builtin_store, evaluate
    from symphony.agents import load_agent
    from symphony.agents.included import PREFIX, pretrained_names

    agent = load_agent(PREFIX + pretrained_names()[0])
    began = time.perf_counter()
    found = evaluate(
        agent, builtin_store("test"), EvaluateConfig(rollouts=2, branches=2, duration=1), items=[0]
    )
    numbers = found.numbers()
    return {
        "agent": agent.name,
        "seconds simulated": 1,
        "rollouts": numbers["rollouts"],
        "took seconds": round(time.perf_counter() - began, 2),
        "result": f"ADE {numbers['ade']:.2f} m",
    }
