"""Say whether this installation works."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from symphony.cli.shared import ResultFile, print_facts, write_numbers

CORE = ("torch", "torchrl", "tensordict", "numpy", "shapely", "matplotlib", "wandb", "safetensors")
EXTRAS = {
    "sumo": "eclipse-sumo",
    "argoverse2": "pyarrow",
    "ray": "ray",
    "video": "imageio-ffmpeg",
    "gym": "gymnasium",
}
"""The distribution that each optional extra brings."""


@dataclass(frozen=True)
class Doctor:
    """Say what is installed, and simulate a second with an agent that comes with the package."""

    json: ResultFile = None
    """File to write what was found to; - for standard output, in place of the table."""

    def run(self) -> None:
        """Look, simulate, print."""
        found = examined()
        write_numbers(self.json, found)
        if str(self.json) != "-":
            print_facts(found)


def examined() -> dict[str, Any]:
    """What is installed, where things are kept, and what a short simulation gave.

    Raises:
        SymphonyError: the simulation fails.
    """
    import os
    import platform
    import sys
    import tempfile
    import time
    from importlib.metadata import PackageNotFoundError, version

    import matplotlib as mpl
    import torch

    from symphony import EvaluateConfig, __version__, builtin_store, evaluate
    from symphony.agents.included import FOLDER, PREFIX, pretrained_names

    def extra(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return "not installed"

    agent, began = PREFIX + pretrained_names()[0], time.perf_counter()
    second = EvaluateConfig(rollouts=2, branches=2, duration=1)
    numbers = evaluate(agent, builtin_store("test"), second, items=[0]).numbers()
    devices = ", ".join(torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count()))
    return {
        "symphony": {"version": __version__, "at": str(FOLDER.parent)},
        "python": {"version": platform.python_version(), "at": sys.executable},
        "system": {"kernel": platform.platform(), "cores": os.cpu_count()},
        "packages": {name: version(name) for name in CORE},
        "extras": {name: extra(package) for name, package in EXTRAS.items()},
        "torch": {
            "threads": torch.get_num_threads(),
            "OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "not set"),
            "CUDA devices": devices or "none",
        },
        "agents": {"included": ", ".join(pretrained_names())},
        "folders": {
            "matplotlib": mpl.get_cachedir(),
            "wandb": os.environ.get("WANDB_DIR", "in the folder of each run"),
            "temporary": tempfile.gettempdir(),
        },
        "simulation": {
            "agent": agent,
            "seconds simulated": second.duration,
            "rollouts": numbers["rollouts"],
            "took seconds": round(time.perf_counter() - began, 2),
            "result": f"ADE {numbers['ade']:.2f} m",
        },
    }
