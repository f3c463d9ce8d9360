"""TensorDict keys, defined once. Losses and modules take them as ``NestedKey`` arguments with these defaults.

Shapes: ``...`` batch (scenes, branches), N interactive agents, O objects, P points.
"""

from __future__ import annotations

Key = str | tuple[str, ...]

SCENE: Key = "scene"
"""[..., 1] int64: row of the environment's scene batch."""
SEGMENT: Key = "segment"
"""[..., 1] int64: number of the run segment among those that scenes are drawn from."""
STEP: Key = "step"
"""[..., 1] int64: simulated steps since the first state."""
STREAM: Key = "stream"
"""[..., 1] int64: identity of the rollout, from which all its random numbers derive."""

PLANNER: Key = "planner"
"""[..., 1] int64: number of the planner that drives the ego of the rollout."""
PLANNED: Key = "planned"
"""[..., 4] float: x, y, heading, speed that a planner gives the ego at the next step."""

BACKGROUND: Key = ("agents", "background")
"""[..., N, 4] float: x, y, heading, speed that a rule gives background agents at the next step."""

VALID: Key = ("agents", "valid")
"""[..., N] bool: False for padding, and in open traffic for agents that are not there yet or no more."""
WAITING: Key = ("agents", "waiting")
"""[..., N] bool: in open traffic, agents that have not entered yet."""
STATE: Key = ("agents", "state")
"""[..., N, 4] float: x, y, heading, speed."""
GOAL: Key = ("agents", "goal")
"""[..., N] int64: the route the agent follows, a row of its scene's table; -1 for none."""
GOAL_SET: Key = ("agents", "goal_set")
"""[..., N, G] bool: the feasible routes among which an expert's log does not tell; where given, instead of GOAL."""
PROGRESS: Key = ("agents", "progress")
"""[..., N] float: metres that the agent has come along its route; 0 where it begins, and without one."""
PERSONA: Key = ("agents", "persona")
"""[..., N, 2] float: the agent's headway and speed among those of the log, from -1 (shortest, slowest) to 1."""
ACTION: Key = ("agents", "action")
"""[..., N] int64 (bicycle) or [..., N, 2] float (displacement)."""
REWARD: Key = ("agents", "reward")
COLLISION: Key = ("agents", "collision")
"""[..., N, 1] bool: box overlaps another valid box at this step."""
OFFROAD: Key = ("agents", "offroad")
"""[..., N, 1] bool: box centre off the drivable area at this step."""
NOISE: Key = ("agents", "noise")
"""[..., N] or [..., N, 2] float in (0, 1): the random numbers that decide an action."""
NOISE_PLAN: Key = "noise_plan"
"""[..., T, N] or [..., T, N, 2] float in (0, 1): those of all steps of a rollout."""
LOGITS: Key = ("agents", "logits")
LOG_PROB: Key = ("agents", "action_log_prob")
"""[..., N] float: of the action, where it is asked for."""
SCORE: Key = ("agents", "score")
"""[..., N] float: the discriminator's logit; high where a state looks simulated."""
SIMULATED: Key = ("agents", "simulated")
"""[..., N] bool: the state comes from a simulation, not from the log."""
ROLLOUT: Key = ("agents", "rollout")
"""[..., N] bool: the action comes from a rollout that survived the search, not from the log."""

OWN: Key = ("agents", "observation", "own")
"""[..., N, Fs] float."""
OBJECTS: Key = ("agents", "observation", "objects")
"""[..., N, O, Fo] float."""
OBJECTS_MASK: Key = ("agents", "observation", "objects_mask")
POINTS: Key = ("agents", "observation", "points")
"""[..., N, P, Fp] float."""
POINTS_MASK: Key = ("agents", "observation", "points_mask")
ROUTE: Key = ("agents", "observation", "route")
"""[..., N, Fr] float: the agent's route as it observes it."""
GAP: Key = ("agents", "observation", "gap")
"""[..., N, O] float: signed gap to the box of each object, metres."""
GAP_AHEAD: Key = ("agents", "observation", "gap_ahead")
"""[..., N, O, H] float: the same at some times ahead, were everyone to keep speed and course."""
ALONG: Key = ("agents", "observation", "along")
"""[..., N, O, Fa] float: where each object is along the agent's route, in bounded numbers."""
LIGHTS: Key = ("agents", "observation", "lights")
"""[..., N, L, Fp] float: the nearest lights, as points."""
LIGHTS_MASK: Key = ("agents", "observation", "lights_mask")
ROAD: Key = ("agents", "observation", "road")
"""[..., N, 5] float: signed distance of box centre and corners to the edge of the road, metres, positive off it."""
SEEN: tuple[Key, ...] = (OWN, OBJECTS, POINTS, ROUTE, GAP, GAP_AHEAD, ALONG, LIGHTS, ROAD)
"""What an agent observes and could react to."""

ROUTES: Key = ("agents", "routes")
"""[..., N, G, Fg] float: every feasible route, as the goal policy observes it."""
ROUTES_MASK: Key = ("agents", "routes_mask")
GOAL_LOGITS: Key = ("agents", "goal_logits")
"""[..., N, G] float."""
GOAL_NOISE: Key = ("agents", "goal_noise")
"""[..., N] float in (0, 1): the random number that decides a goal."""
