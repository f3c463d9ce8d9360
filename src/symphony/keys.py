"""TensorDict keys, defined once. Losses and modules take them as ``NestedKey`` arguments with these defaults.

Shapes: ``...`` batch (scenes, branches), N interactive agents, O objects, P points.
"""

from __future__ import annotations

Key = str | tuple[str, ...]

SCENE: Key = "scene"
"""[..., 1] int64: row of the environment's scene batch."""
STEP: Key = "step"
"""[..., 1] int64: simulated steps since the first state."""
STREAM: Key = "stream"
"""[..., 1] int64: identity of the rollout, from which all its random numbers derive."""

VALID: Key = ("agents", "valid")
"""[..., N] bool: False for padding."""
STATE: Key = ("agents", "state")
"""[..., N, 4] float: x, y, heading, speed."""
ACTION: Key = ("agents", "action")
"""[..., N] int64 (bicycle) or [..., N, 2] float (displacement)."""
REWARD: Key = ("agents", "reward")
COLLISION: Key = ("agents", "collision")
"""[..., N, 1] bool: box overlaps another valid box at this step."""
OFFROAD: Key = ("agents", "offroad")
"""[..., N, 1] bool: box centre off the drivable area at this step."""
NOISE: Key = ("agents", "noise")
"""[..., N] float in (0, 1): the random number that decides an action."""
LOGITS: Key = ("agents", "logits")

OWN: Key = ("agents", "observation", "own")
"""[..., N, Fs] float."""
OBJECTS: Key = ("agents", "observation", "objects")
"""[..., N, O, Fo] float."""
OBJECTS_MASK: Key = ("agents", "observation", "objects_mask")
POINTS: Key = ("agents", "observation", "points")
"""[..., N, P, Fp] float."""
POINTS_MASK: Key = ("agents", "observation", "points_mask")
