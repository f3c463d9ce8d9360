"""Metrics of a user's own that other processes import."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import torch
from torch import Tensor

from symphony.envs.scene import SceneBatch
from symphony.rollouts.unroll import Rollouts


def travelled(scenes: SceneBatch, rollouts: Rollouts) -> Tensor:
    """Metres, of the ego."""
    path = rollouts.state[..., 0, :2].double()
    return ((path[:, :, 1:] - path[:, :, :-1]).norm(dim=-1) * rollouts.counted[..., 0]).sum(-1)


def short_scenes_fail(scenes: SceneBatch, rollouts: Rollouts) -> Tensor:
    if (scenes.last_step < 8).any():
        raise ZeroDivisionError("too short for me")
    return travelled(scenes, rollouts)


def short_scenes_kill(scenes: SceneBatch, rollouts: Rollouts) -> Tensor:
    if (scenes.last_step < 8).any():
        os.kill(os.getpid(), signal.SIGKILL)
    return travelled(scenes, rollouts)


def waits(scenes: SceneBatch, rollouts: Rollouts) -> Tensor:
    """Leaves a file named after its process where STARTED says, and takes its time."""
    (Path(os.environ["STARTED"]) / str(os.getpid())).touch()
    time.sleep(120)
    return torch.zeros(rollouts.state.shape[:2])
