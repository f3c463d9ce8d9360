"""Say whether this installation works."""

from __future__ import annotations

import os
import platform
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import symphony
from symphony.cli import shared

PACKAGES = "torch torchrl tensordict numpy shapely matplotlib wandb safetensors"
EXTRAS = "eclipse-sumo pyarrow ray imageio-ffmpeg gymnasium"


class Doctor(shared.Command):
    """Say what is installed, and simulate a second with an agent that comes with the package."""

    json: shared.Json = None

    def __call__(self) -> None:
        import torch

        began, second = time.perf_counter(), symphony.EvaluateConfig(rollouts=2, branches=2, duration=1)
        store = symphony.builtin_store("test")
        numbers = symphony.evaluate("pretrained:bc_ts_h", store, second, items=[0]).numbers()
        devices = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
        found: dict[str, Any] = {
            "symphony": {"version": symphony.__version__, "at": symphony.__file__},
            "python": {"version": platform.python_version(), "at": sys.executable},
            "system": {"kernel": platform.platform(), "cores": os.cpu_count(), "CUDA devices": devices},
            "packages": {name: _installed(name) for name in PACKAGES.split()},
            "extras": {name: _installed(name) for name in EXTRAS.split()},
            "simulation": {
                "rollouts": numbers["rollouts"],
                "seconds": time.perf_counter() - began,
                "ADE": numbers["ade"],
            },
        }
        if shared.write_numbers(self.json, found):
            shared.print_facts(found)


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
