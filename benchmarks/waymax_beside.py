"""Waymax beside ours, where it is installed: bicycle, collisions and off-road of 32 agents on each of 64 ring roads.

    python benchmarks/waymax_beside.py [--steps 20] [--device cuda]

The same scenes, with 2 000 road points each; on one core if you say so (``taskset -c 0`` and ``OMP_NUM_THREADS=1``).
With ``--device cuda`` both are on the card (JAX must have been installed for it), and the time of a step is that on
the wall until the card is done, not that of the CPU. Waymax comes from https://github.com/waymo-research/waymax; the
``waymax`` of the package index is another. First both take one step of 0.1 s, and must find the same positions and
overlaps.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from symphony import keys
from symphony.envs import Bicycle, DrivingEnv, ObservationConfig, SceneBatch, collate
from workloads import AGENTS, SCENES, ring, rings

try:
    import jax
    import jax.numpy as jnp
    from waymax import config, datatypes, dynamics, env
except ImportError as error:
    message = "this needs Waymax: pip install git+https://github.com/waymo-research/waymax.git"
    raise SystemExit(f"{message} ({error})") from error


def state_of(scenes: SceneBatch) -> Any:
    """Return the scenes in Waymax's terms, all objects controlled, the first of each the ego."""
    log = np.moveaxis(scenes.log_state.numpy(), 1, 2)  # [B, A, T, 5]
    shape, count = log.shape[:3], log.shape[:2]

    def every(value: Any, kind: Any = np.float32) -> Any:
        return jnp.asarray(np.broadcast_to(np.asarray(value, kind), shape))

    def each(value: Any, kind: Any = bool) -> Any:
        return jnp.asarray(np.broadcast_to(np.asarray(value, kind), count))

    size = scenes.box_size.numpy()
    trajectory = datatypes.Trajectory(
        x=every(log[..., 0]),
        y=every(log[..., 1]),
        z=every(0),
        vel_x=every(log[..., 3]),
        vel_y=every(log[..., 4]),
        yaw=every(log[..., 2]),
        valid=every(True, bool),
        timestamp_micros=every(0, np.int32),
        length=every(size[..., None, 0]),
        width=every(size[..., None, 1]),
        height=every(1.5),
    )
    metadata = datatypes.ObjectMetadata(
        ids=each(np.arange(count[1]), np.int32),
        object_types=each(1, np.int32),
        is_sdc=each(np.arange(count[1]) == 0),
        is_modeled=each(True),
        is_valid=each(True),
        objects_of_interest=each(False),
        is_controlled=each(True),
    )
    point, direction = scenes.point.numpy(), scenes.point_direction.numpy()
    flat, first = np.zeros(point.shape[:2], np.float32), np.arange(point.shape[1]) < point.shape[1] // 2
    road = datatypes.RoadgraphPoints(
        x=jnp.asarray(point[..., 0]),
        y=jnp.asarray(point[..., 1]),
        z=jnp.asarray(flat),
        dir_x=jnp.asarray(direction[..., 0]),
        dir_y=jnp.asarray(direction[..., 1]),
        dir_z=jnp.asarray(flat),
        types=jnp.full(flat.shape, datatypes.MapElementIds.ROAD_EDGE_BOUNDARY, jnp.int32),
        ids=jnp.broadcast_to(jnp.asarray(first, jnp.int32), flat.shape),
        valid=jnp.ones(flat.shape, bool),
    )
    none = jnp.zeros((count[0], 1, shape[2]))
    lights = datatypes.TrafficLights(
        x=none,
        y=none,
        z=none,
        state=none.astype(jnp.int32),
        lane_ids=none.astype(jnp.int32),
        valid=none.astype(bool),
    )
    return datatypes.SimulatorState(
        sim_trajectory=trajectory,
        log_trajectory=trajectory,
        log_traffic_light=lights,
        object_metadata=metadata,
        timestep=jnp.asarray(0),
        roadgraph_points=road,
    )


def waymax_step(scenes: SceneBatch) -> Callable[[], Any]:
    """Return one compiled step of all scenes, with its flags."""
    settings = dataclasses.replace(
        config.EnvironmentConfig(),
        max_num_objects=AGENTS,
        init_steps=1,
        controlled_object=config.ObjectType.VALID,
        metrics=config.MetricsConfig(metrics_to_run=("overlap", "offroad")),
    )
    world = env.MultiAgentEnvironment(dynamics.InvertibleBicycleModel(), settings)
    state = world.reset(state_of(scenes))
    count = (SCENES, AGENTS)
    action = datatypes.Action(data=jnp.zeros((*count, 2)), valid=jnp.ones((*count, 1), bool))

    @jax.jit
    def step(state: Any) -> tuple[Any, Any]:
        after = world.step(state, action)
        return after, world.metrics(after)

    return lambda: jax.block_until_ready(step(state))


def agree(scenes: SceneBatch, after: Any, flags: Any) -> None:
    """Print how far apart the first steps of both are.

    Raises:
        SystemExit: beyond rounding.
    """
    env = DrivingEnv(scenes, Bicycle(), ObservationConfig.nothing())
    env.dt = 0.1  # that of Waymax, whatever the scenes say
    start = env.start(torch.arange(SCENES))
    start.set(keys.ACTION, torch.full((SCENES, AGENTS), env.dynamics.num_actions // 2))
    ours = env.step(start)["next"]
    place = np.stack([np.asarray(getattr(after.sim_trajectory, axis))[..., 1] for axis in "xy"], -1)
    apart = np.abs(ours[keys.STATE][..., :2].numpy() - place).max()
    hit, theirs = ours[keys.COLLISION].squeeze(-1).numpy(), np.asarray(flags["overlap"].value) > 0
    print(f"one step: positions within {apart:.0e} m, {(hit == theirs).mean():.0%} of {hit.size} overlap flags equal")
    if apart > 1e-4 or (hit != theirs).any():
        raise SystemExit("they don't do the same")


def main() -> None:
    """Print whether both do the same, agent-steps a second of both, and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    options = parser.parse_args()
    card, found = options.device == "cuda", {}
    jax.config.update("jax_platforms", options.device)
    if card and jax.devices()[0].platform != "gpu":
        raise SystemExit("JAX has no card here: pip install 'jax[cuda13]'")
    clock = time.perf_counter if card else time.process_time
    step, _ = rings(0, 0, device=options.device)

    def ours() -> None:
        step()
        if card:
            torch.cuda.synchronize()

    scenes = collate([ring(k) for k in range(SCENES)])
    theirs = waymax_step(scenes)
    agree(scenes, *theirs())
    for name, work in (("symphony", ours), ("waymax", theirs)):
        for _ in range(25):  # compilation there, grids of the maps here
            work()
        seconds = []
        for _ in range(options.steps):
            began = clock()
            work()
            seconds.append(clock() - began)
        found[name] = SCENES * AGENTS / float(np.median(seconds))
        print(f"{name}: {found[name]:,.0f} agent-steps/s {'on the card' if card else 'of CPU time'}", flush=True)
    print(f"ratio: {found['symphony'] / found['waymax']:.1f}")


if __name__ == "__main__":
    main()
