"""Fine-tune an agent in closed loop in one of several ways, to compare them at equal updates.

    python benchmarks/fine_tuning.py {cloning,siblings,...,fault} --warm-start RUN --data DIR --out DIR
    python benchmarks/fine_tuning.py table RUNS         # of runs RUNS/WAY-SEED, evaluated on both test parts

- `cloning`: the log alone, as before.
- `siblings`: survivors of a search against those of their siblings that a rule pruned, which count as negatives, in
  periods in which some of the branches were bad and others were not.
- `nearest`: rollouts of the action nearest to the log among the policy's 32 likeliest, each state labelled with the
  way back to the log (as CAT-K of Zhang et al., "Closed-loop supervised fine-tuning of tokenized traffic models").
- `both`: half of the states from each of these.
- `gradient`: the policy gradient of recipe `bc_rl`.
- `fault`: the same, in which being hit from behind, which playback vehicles can't help, costs nothing.

It takes the options of `symphony train bc_rl`; all ways also learn from the log in every update.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from copy import copy
from pathlib import Path
from typing import Any

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, TensorDictSequential

from methods import write
from relations import segment_rows
from symphony import DistillationLoss, DrivingEnv, SegmentStore, TrainConfig, keys
from symphony.agents import Agent, bicycle, observation_of, policy_network
from symphony.cli import guarded
from symphony.cli.agents import Train
from symphony.collectors import BeamSearchCollector, KeepAll, ReplaceBad, with_rows
from symphony.config.profiles import expanded
from symphony.errors import ConfigError
from symphony.evaluation.records import find_runs, kept_evaluations
from symphony.evaluation.table import Entry
from symphony.geometry.frames import wrap
from symphony.learning import SceneDataset, SearchReplay, with_survivors
from symphony.learning.experts import logged
from symphony.learning.perturbation import way_back
from symphony.metrics.intervals import clustered_mean
from symphony.metrics.kinds import CollisionKind, collision_kinds
from symphony.modules import SeededNoise
from symphony.recipes import train
from symphony.rollouts.search import branched_streams, collector_settings, realism_score
from symphony.training import Phase, Processes, Trainer, Updates, cosine

LIKELIEST = 32
"""K of CAT-K."""
NEGATIVE = 0.5
"""Weight of survivors and, with the other sign, of pruned siblings, beside cloning."""


class NearestToLog(TensorDictModuleBase):
    """Takes of the likeliest actions the one whose next state is nearest to the log; without a log the likeliest."""

    def __init__(self, policy: ProbabilisticTensorDictSequential, env: DrivingEnv) -> None:
        super().__init__()
        self.policy, self.env = policy, env
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action [..., N]."""
        scenes, dynamics = self.env.scenes, self.env.dynamics
        likely = self.policy.get_dist(tensordict).logits.topk(LIKELIEST).indices
        scene, after = tensordict[keys.SCENE].squeeze(-1), tensordict[keys.STEP].squeeze(-1) + 1
        states, known = logged(scenes)
        after = after.clamp_max(states.shape[1] - 1)
        target, there = states[scene, after][..., None, :], known[scene, after]
        row = scenes.interactive[scene]
        size = scenes.box_size[scene[..., None], row][..., None, :].expand(*likely.shape, 2)
        state = tensordict[keys.STATE][..., None, :].expand(*likely.shape, 4)
        moved = dynamics.step(state, likely, size, self.env.dt)
        # As experts are fitted: by positions alone speed and heading would swing about the log's.
        scale = state.new_tensor([1.0, 1.0, dynamics.heading_weight, dynamics.speed_weight])
        apart = moved - target
        apart = torch.cat([apart[..., :2], wrap(apart[..., 2:3]), apart[..., 3:]], -1) * scale
        best = apart.square().sum(-1).argmin(-1) * there
        return tensordict.set(keys.ACTION, likely.gather(-1, best[..., None]).squeeze(-1))


def siblings(replay: SearchReplay, count: int, rng: torch.Generator, observation: Any) -> TensorDict:
    """Return steps [count] of decided periods with weights: of survivors above 0, of what was pruned below."""
    tree, period = replay.leaves["tree"], replay.collector.prune_every
    bad = tree["collector", "beam_score"] > 0  # [B, S, T, N]
    going = (tree[keys.STEP].squeeze(-1) < replay.env.scenes.last_step[tree[keys.SCENE].squeeze(-1)])[..., None]
    there = tree[keys.VALID] & going
    parts = []
    for steps, real in zip(bad.split(period, 2), there.split(period, 2), strict=True):
        pruned = (steps & real).any(2, keepdim=True).expand_as(steps).float()
        share = pruned.mean(1, keepdim=True)
        # As much of either kind in all; what comes after a fault is not to blame.
        before = (steps & real).cumsum(2) - (steps & real).long() == 0
        parts.append((share - pruned) * real * before)
    advantage = torch.cat(parts, 2)
    share = advantage.abs().amax(-1).flatten()
    pick = torch.multinomial(share + 1e-9, count, replacement=True, generator=rng)
    weight = NEGATIVE * advantage.flatten(0, -2)[pick] / share[pick].clamp_min(1e-6)[:, None]
    return replay.learned(tree.flatten()[pick], observation).set(keys.WEIGHT, weight)


def relabelled(replay: SearchReplay, count: int, rng: torch.Generator, observation: Any) -> TensorDict:
    """Return steps [count] of rollouts near the log, labelled with the way back to it."""
    env, leaves = replay.env, replay.leaves.flatten()
    scene, step = leaves[keys.SCENE].squeeze(-1), leaves[keys.STEP].squeeze(-1)
    rows = (step < env.scenes.last_step[scene]).nonzero().squeeze(-1)
    pick = rows[torch.randint(len(rows), (count,), generator=rng)]
    chosen, scene, step = leaves[pick], scene[pick], step[pick]
    states, known = logged(env.scenes)
    size = env.scenes.box_size[scene[:, None], env.scenes.interactive[scene]]
    state, now, after = (
        part.flatten(0, 1) for part in (chosen[keys.STATE], states[scene, step], states[scene, step + 1])
    )
    flat = size.flatten(0, 1)
    label = env.dynamics.towards(state, way_back(state, now, after, flat[:, 0], env.dt), flat, env.dt)
    batch = replay.learned(chosen, observation)
    both = known[scene, step] & known[scene, step + 1] & batch[keys.VALID]
    batch.set(keys.VALID, both).set(keys.ACTION, label.view(both.shape))
    return batch.set(keys.WEIGHT, both.float())


def at_fault(replay: SearchReplay, count: int, rng: torch.Generator, observation: Any) -> TensorDict:
    """Return steps [count] for the policy gradient; an agent that is hit from behind is gone from then on instead."""
    leaves, scenes = replay.leaves.copy(), replay.env.scenes
    scenes = scenes[leaves[:, 0, 0][keys.SCENE].squeeze(-1)]
    going = leaves[keys.STEP] < scenes.last_step[:, None, None, None]
    there = leaves[keys.VALID] & going
    collided, times = leaves["next", *keys.COLLISION], torch.arange(leaves.shape[2])
    state = torch.cat([leaves[keys.STATE], leaves["next", *keys.STATE][:, :, -1:]], 2)  # [B, S, T+1, N, 4]
    found = collision_kinds(
        (collided.squeeze(-1) & there).transpose(2, 3),
        state.transpose(2, 3),
        torch.cat([leaves[keys.VALID], leaves["next", *keys.VALID][:, :, -1:]], 2).transpose(2, 3),
        torch.where(scenes.interactive_valid, scenes.interactive, -1)[:, None],
        scenes.log_state[:, None, : len(times) + 1].transpose(2, 3),
        scenes.log_valid[:, None, : len(times) + 1].transpose(2, 3),
        scenes.box_size[:, None],
        scenes.agent_type[:, None],
    )
    hit = (found.kind == CollisionKind.REAR_ENDED)[:, :, None]  # [B, S, 1, N]
    leaves.set(keys.VALID, leaves[keys.VALID] & ~(hit & (times[:, None] > found.step[:, :, None])))
    leaves.set(("next", *keys.COLLISION), collided & ~hit[..., None])
    judged = copy(replay)
    judged._leaves = leaves
    return judged.blamed(count, rng, observation)


TITLES = {
    "siblings": "survivors against pruned siblings",
    "nearest": "the way back to the log (CAT-K)",
    "both": "half of each",
    "gradient": "the policy gradient",
    "fault": "the same, being hit from behind costs nothing",
}
Drawn = Callable[[SearchReplay, int, torch.Generator, Any], TensorDict]
WAYS: dict[str, tuple[Drawn, ...]] = {
    "cloning": (),
    "siblings": (siblings,),
    "nearest": (relabelled,),
    "both": (siblings, relabelled),
    "gradient": (SearchReplay.blamed,),
    "fault": (at_fault,),
}


def fine_tuned(way: str) -> Callable[[TrainConfig, Processes], Trainer]:
    """Return the recipe of a way."""

    def recipe(config: TrainConfig, processes: Processes) -> Trainer:
        torch.manual_seed(config.seed)
        seed, rng, dynamics = processes.seed(config.seed), torch.Generator(), bicycle(config.agent)
        data = SceneDataset(SegmentStore(config.data), dynamics=dynamics, routes=False, **config.scenes)
        spec = config.spec("bicycle", data.dt)
        policy = policy_network(spec)
        agent = Agent(str(config.out), policy, spec).to(processes.device)

        def replay_of(drawn: Drawn) -> SearchReplay:
            env = DrivingEnv(data, dynamics, observation_of(spec), generator=rng, device=processes.device)
            near, rows = drawn is relabelled, config.rows(len(data))
            rule = ReplaceBad(0.0) if drawn is siblings else KeepAll()
            settings = collector_settings(config.search, env, seed, data, rows, rule)
            if near:  # it draws nothing, so one rollout of a segment is all there are
                settings |= {"branches": 1, "leaves": 1, "frames_per_batch": rows * data.decisions}
            acting = NearestToLog(policy, env) if near else policy
            collector = BeamSearchCollector(
                with_rows(env, [rows]),
                TensorDictSequential(SeededNoise(seed, dynamics.numbers), acting),
                score=realism_score(env, None, score="rule" if drawn is siblings else "flags"),
                prepare=branched_streams,
                **settings,
            )
            return SearchReplay(collector, env, data, config.search.updates, config.search.states, config.segments)

        replays = [(drawn, replay_of(drawn)) for drawn in WAYS[way]]
        policy_loss = processes.wrap_ddp(DistillationLoss(policy))
        optimizers = {name: torch.optim.Adam(network.parameters()) for name, network in agent.modules.items()}

        def update(step: int) -> Updates:
            items, observation = data.draw(config.segments, rng), observation_of(spec)
            for _, replay in replays:
                yield "search", replay.refresh(step)
            experts = data.sample_states(
                items, config.states, observation, rng, processes.device, config.perturb.at(step)
            )
            each = config.search.states // max(1, len(replays))
            found = [drawn(replay, each, rng, observation) for drawn, replay in replays]
            experts.set(keys.ROLLOUT, torch.zeros_like(experts[keys.VALID]))
            yield "policy", policy_loss(with_survivors(experts, torch.cat(found)) if found else experts)

        phases = [Phase(config.steps, update, cosine(config.rates(optimizers), config.steps))]
        first = replays[0][1] if replays else None
        return Trainer(config, agent, data, phases, optimizers, rng, processes, first)

    return recipe


def table(runs: Path) -> None:
    """Write how each way differs from as much cloning, paired over segments, seeds averaged, as a record."""
    found: dict[tuple[str, str], list[Entry]] = {}
    for run in find_runs([runs]):
        for name, record in kept_evaluations(run).items():
            way, seed = run.name.rsplit("-", 1)
            facts = {"method": way, "seed": int(seed)}
            found.setdefault((way, record["data"]["name"]), []).append(Entry(run, facts, name, record))
    rows, seeds = [], []
    for way, title in TITLES.items():
        cells: list[Any] = [title]
        for part, shown in (("test", 3), ("ngsim-test", 2)):
            if lost := [each for each in (way, "cloning") if (each, part) not in found]:
                raise ConfigError(f"{runs}: no run of {lost[0]} has an evaluation on {part}")
            mine = found[way, part]
            base = [entry for entry in found["cloning", part] if entry.seed in {each.seed for each in mine}]
            names = ("collision_rate", "collision_rear_ended", "offroad_time")
            member, (after, before) = segment_rows([mine, base], names)
            every, behind, off = after - before
            changes = [every, every - behind, off][:shown]
            cells += [[round(float(x), 1) for x in clustered_mean(change, member)] for change in changes]
        rows.append(cells)
        seeds.append(f"{title}: {len(mine)}")
    towns, roads = ([f"{part}: collisions", f"{part}: not from behind"] for part in ("towns", "real roads"))
    columns = [[""], *([name, 1] for name in (*towns, "towns: off-road", *roads))]
    of = f"points that 500 updates give beyond cloning (seeds of {', '.join(seeds)}), paired, ± over recordings"
    write("fine-tuning", of, columns, rows, "fine_tuning.py table RUNS")


def main() -> None:
    """Train, or write the table."""
    way, *args = sys.argv[1:] or ["--help"]
    if way == "table" and len(args) == 1:
        return table(Path(args[0]))
    if way not in WAYS:
        sys.exit(__doc__)
    config = tyro.cli(Train, args=expanded(["bc_rl", *args])).config
    print(train(config, fine_tuned(way)))


if __name__ == "__main__":
    sys.exit(guarded(main))
