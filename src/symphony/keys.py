"""TensorDict keys, defined once; losses and modules take them as ``NestedKey`` arguments with these defaults.

Shapes: ``...`` batch (scenes, branches), N interactive agents, O objects, P points, G routes, T steps.
"""

from __future__ import annotations

Key = str | tuple[str, ...]

SCENE: Key = "scene"  # [..., 1] int64: row of the environment's scene batch
STEP: Key = "step"  # [..., 1] int64: simulated steps since the first state
STREAM: Key = "stream"  # [..., 1] int64: identity of the rollout, from which all its random numbers derive
PLANNER: Key = "planner"  # [..., P] int64: numbers of the planners that drive the first agents of the rollout
PLANNED: Key = "planned"  # [..., P, 4]: x, y, heading, speed that planners give these at the next step
NOISE_PLAN: Key = "noise_plan"  # [..., T, N] or [..., T, N, 2]: NOISE of all steps of a rollout

# Padding is not valid; in open traffic neither are agents before they enter (they are waiting) or after they left.
VALID: Key = ("agents", "valid")  # [..., N] bool
WAITING: Key = ("agents", "waiting")  # [..., N] bool
STATE: Key = ("agents", "state")  # [..., N, 4]: x, y, heading, speed
BACKGROUND: Key = ("agents", "background")  # [..., N, 4]: the same, as a rule moves background agents next
GOAL: Key = ("agents", "goal")  # [..., N] int64: the route followed, a row of its scene's table; -1 for none
GOAL_SET: Key = ("agents", "goal_set")  # [..., N, G] bool: routes that fit an expert's log equally well
PROGRESS: Key = ("agents", "progress")  # [..., N]: metres come along the route from its begin; 0 without one
ACTION: Key = ("agents", "action")  # [..., N] int64 (bicycle) or [..., N, 2] (displacement)
LOGITS: Key = ("agents", "logits")
LOG_PROB: Key = ("agents", "action_log_prob")  # [..., N]: of the action, where it is asked for
NOISE: Key = ("agents", "noise")  # [..., N] or [..., N, 2] in (0, 1): decides an action
REWARD: Key = ("agents", "reward")
COLLISION: Key = ("agents", "collision")  # [..., N, 1] bool: box overlaps another valid box at this step
OFFROAD: Key = ("agents", "offroad")  # [..., N, 1] bool: box centre off the drivable area at this step
SCORE: Key = ("agents", "score")  # [..., N]: the discriminator's logit; high where a state looks simulated
SIMULATED: Key = ("agents", "simulated")  # [..., N] bool: the state comes from a simulation, not from the log
ROLLOUT: Key = ("agents", "rollout")  # [..., N] bool: the action is of a rollout that survived the search

WEIGHT: Key = ("agents", "weight")  # [..., N]: of an action of a rollout, negative where it shall become less likely

OWN: Key = ("agents", "observation", "own")  # [..., N, Fs]
OBJECTS: Key = ("agents", "observation", "objects")  # [..., N, O, Fo]
OBJECTS_MASK: Key = ("agents", "observation", "objects_mask")
POINTS: Key = ("agents", "observation", "points")  # [..., N, P, Fp]
POINTS_MASK: Key = ("agents", "observation", "points_mask")
ROUTE: Key = ("agents", "observation", "route")  # [..., N, Fr]: the agent's route as it observes it
GAP: Key = ("agents", "observation", "gap")  # [..., N, O]: signed gap to the box of each object, metres
GAP_AHEAD: Key = ("agents", "observation", "gap_ahead")  # [..., N, O, H]: at times ahead
ALONG: Key = ("agents", "observation", "along")  # [..., N, O, Fa]: along the route
LIGHTS: Key = ("agents", "observation", "lights")  # [..., N, L, Fp]: nearest, as points
LIGHTS_MASK: Key = ("agents", "observation", "lights_mask")
ROAD: Key = ("agents", "observation", "road")  # [..., N, 5]: metres off the road (signed), centre and corners
SEEN: tuple[Key, ...] = (OWN, OBJECTS, POINTS, ROUTE, GAP, GAP_AHEAD, ALONG, LIGHTS, ROAD)
"""What an agent observes and could react to."""

ROUTES: Key = ("agents", "routes")  # [..., N, G, Fg]: every feasible route, as the goal policy observes it
ROUTES_MASK: Key = ("agents", "routes_mask")
GOAL_LOGITS: Key = ("agents", "goal_logits")  # [..., N, G]
GOAL_NOISE: Key = ("agents", "goal_noise")  # [..., N] in (0, 1): the random number that decides a goal
