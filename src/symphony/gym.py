"""Tells Gymnasium of ``symphony/Driving-v0`` when it is imported; nothing heavy is until one is made.

``gymnasium.make("symphony/Driving-v0", data="store")`` after ``import symphony.gym``, or without it
``gymnasium.make("symphony.gym:symphony/Driving-v0", data="store")``.

Raises:
    ImportError: Gymnasium is not installed (the extra ``gym``).
"""

from __future__ import annotations

try:
    import gymnasium
except ImportError as error:
    raise ImportError("Gymnasium is not installed: pip install 'symphony-traffic[gym]'") from error

ENVIRONMENT = "symphony/Driving-v0"

if ENVIRONMENT not in gymnasium.registry:
    gymnasium.register(ENVIRONMENT, entry_point="symphony.envs.gym:DrivingGym")
