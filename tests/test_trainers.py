"""Training and evaluation, end to end on tiny stores."""

from __future__ import annotations

import copy
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from helpers_runs import same_weights, weights
from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.agents import build_agent, load_agent, observation_of
from symphony.agents.checkpoint import checkpoints
from symphony.cli import main
from symphony.config import (
    METHODS,
    AgentConfig,
    AgentSpec,
    TrainConfig,
    read_json,
    to_json,
)
from symphony.config.files import from_dict
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.envs import Bicycle, Displacement, DrivingEnv, ObservationConfig
from symphony.errors import ConfigError, DataError
from symphony.evaluation import evaluate
from symphony.geometry import signed_distance
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.experts import fit_experts
from symphony.metrics import collisions
from symphony.objectives import GoalLoss
from symphony.recipes import train
from symphony.rollouts import simulate
from symphony.training import Phase, Processes, Trainer, Updates, cosine
from symphony.training.logging import read_metrics

TINY = AgentConfig(num_points=20, hidden=8)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    with StoreWriter(path) as writer:
        for seed in range(3):
            writer.append(straight_road(4, seed=seed, steps=11 + 3 * seed))
            writer.append(crossing(4, seed=seed, steps=16))
    return path


def config(store: Path, out: Path, **changes: object) -> TrainConfig:
    base = TrainConfig(
        method="bc",
        data=store,
        out=out,
        steps=6,
        agent=TINY,
        segments=3,
        states=32,
        checkpoint_every=2,
        log_every=1,
        wandb="disabled",
    )
    return replace(base, **changes)


@pytest.fixture(scope="module")
def run(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(config(store, tmp_path_factory.mktemp("runs") / "bc"))


def test_a_run_leaves_its_config_metrics_and_last_checkpoints(run: Path, store: Path) -> None:
    assert read_json(TrainConfig, run / "config.json") == config(store, run)
    spec = AgentSpec(action_space="bicycle", dt=0.2, agent=TINY)
    assert read_json(AgentSpec, run / "agent.json") == spec == load_agent(str(run)).spec
    assert [r["step"] for r in read_metrics(run)] == [1, 2, 3, 4, 5, 6]
    assert [int(p.name[-12:]) for p in checkpoints(run / "checkpoints")] == [2, 4, 6]


def test_the_same_seed_gives_the_same_weights(run: Path, store: Path, tmp_path: Path) -> None:
    again = train(config(store, tmp_path / "again"))
    other = train(config(store, tmp_path / "other", seed=1))
    assert same_weights(weights(run), weights(again))
    assert not same_weights(weights(run), weights(other))


@pytest.mark.parametrize("stop", [2, 4])
def test_a_resumed_run_ends_with_the_same_weights(run: Path, store: Path, tmp_path: Path, stop: int) -> None:
    out, whole = tmp_path / "part", config(store, tmp_path / "part")
    train(whole)
    for done in checkpoints(out / "checkpoints"):
        if int(done.name[-12:]) > stop:
            shutil.rmtree(done)
    train(replace(whole, resume=True))
    assert same_weights(weights(run), weights(out))
    assert [r["step"] for r in read_metrics(out)] == [1, 2, 3, 4, 5, 6]


def test_a_run_that_failed_at_its_first_update_is_no_run(run: Path, store: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    with pytest.raises(DataError, match="60 are asked for"):
        train(config(store, out, duration=60))
    train(config(store, out))
    assert same_weights(weights(run), weights(out))


def test_a_run_is_not_overwritten_nor_resumed_as_another(run: Path, store: Path) -> None:
    with pytest.raises(ConfigError, match="holds a run already"):
        train(config(store, run))
    with pytest.raises(ConfigError, match=r"another seed \(was \d+\)$"):
        train(config(store, run, resume=True, seed=5))


def test_a_recipe_of_ones_own_may_leave_the_policy_as_it_is(store: Path, tmp_path: Path) -> None:
    settings, rng = config(store, tmp_path / "goals", method="bc_h"), torch.Generator()
    data = SceneDataset(SegmentStore(store), routes=True, **settings.scenes)
    spec = settings.spec("bicycle", data.dt, goals=True)
    agent = build_agent("goals", spec)
    before, loss = copy.deepcopy(agent.policy.state_dict()), GoalLoss(agent.goals)

    def update(step: int) -> Updates:
        batch = data.sample_goals(data.draw(2, rng), 8, observation_of(spec), rng)
        yield "goals", loss(batch)

    phases = [Phase(settings.steps, update, cosine({"goals": 0.01}, settings.steps))]
    optimizers = {"goals": torch.optim.Adam(agent.goals.parameters())}
    alone = Processes(torch.device("cpu"))
    out = Trainer(settings, agent, data, phases, optimizers, rng, alone).run()
    assert [r["step"] for r in read_metrics(out) if "loss_goals" in r] == [1, 2, 3, 4, 5, 6]
    after = load_agent(str(out)).policy.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_training_lowers_the_loss(store: Path, tmp_path: Path) -> None:
    out = train(
        config(store, tmp_path / "long", steps=100, states=128, learning_rate=3e-3, checkpoint_every=100)
    )
    losses, rates = ([r[name] for r in read_metrics(out)] for name in ("loss_policy", "learning_rate"))
    assert rates[0] == 3e-3
    assert rates[-1] == pytest.approx(3e-4, rel=0.05)
    assert losses[0] == pytest.approx(math.log(147), rel=0.1)
    assert sum(losses[-5:]) < 0.85 * sum(losses[:5])


def test_playback_scores_nothing_against_itself(store: Path) -> None:
    numbers = evaluate("playback", store).numbers()
    assert numbers["segments"] == 6
    assert numbers["rollouts"] == 1
    for name in ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd"):
        assert numbers[name] == pytest.approx(0, abs=1e-6)


def test_flags_of_the_environment_are_those_of_the_metrics(store: Path) -> None:
    """One definition in two forms: step by step in simulation, whole trajectories for logs."""
    dataset = SceneDataset(SegmentStore(store), 2)
    scenes = dataset.scenes(range(len(dataset)))
    env = DrivingEnv(scenes, Bicycle(), ObservationConfig(num_points=1))
    start = env.start(torch.arange(len(dataset))[:, None].expand(-1, 20), torch.arange(20))
    done = simulate(env, env.rand_action, start)
    where = scenes.log_state[:, None].transpose(2, 3).repeat(1, 20, 1, 1, 1)
    valid = scenes.log_valid[:, None].transpose(2, 3).repeat(1, 20, 1, 1)
    rows = torch.arange(len(dataset))[:, None, None], torch.arange(20)[:, None], scenes.interactive[:, None]
    where[rows] = torch.cat([done.state, done.state[..., :1]], -1).transpose(2, 3)
    valid[rows] = True
    hit = collisions(
        where[..., :2],
        where[..., 2],
        scenes.box_size[:, None],
        valid,
        scenes.interactive[:, None],
        at_states=True,
    )[..., 1:]
    assert torch.equal(hit.transpose(2, 3), done.collision)
    assert 0 < hit.float().mean() < 1
    edges = (
        scenes.edge_start,
        scenes.edge_end,
        scenes.edge_valid,
        scenes.edge_previous,
        scenes.edge_following,
    )
    places = done.state[:, :, 1:, :, :2]
    off = signed_distance(places.flatten(1, -2), *edges).reshape(places.shape[:-1]) > 0
    assert torch.equal(off, done.offroad)
    assert 0 < off.float().mean() < 1


def test_experts_drive_or_wait_in_a_lane_and_are_not_parked() -> None:
    segment = straight_road(4)
    position, velocity = segment.position.copy(), segment.velocity.copy()
    position[1:3] = position[1:3, :1]
    velocity[1:3] = 0
    position[2, :, 1] += 1.5  # beside its lane
    (found,) = fit_experts([segment.replace(position=position, velocity=velocity)], Bicycle())
    assert found.agent.tolist() == [0, 1, 3]
    assert found.error.max() < 0.15
    assert (found.actions[1] == 73).all()  # who waits neither steers nor brakes


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_expert_batches_show_what_the_environment_shows(
    store: Path, dynamics: Bicycle | Displacement
) -> None:
    dataset = SceneDataset(SegmentStore(store), 2, dynamics)
    rng = torch.Generator().manual_seed(0)
    batch = dataset.sample_states([0, 1], 50, ObservationConfig(num_objects=4, num_points=20), rng)
    assert batch.shape == (50,)
    assert batch[keys.POINTS].shape == (50, 1, 20, 23)
    assert batch[keys.VALID].all()
    assert batch[keys.OWN][..., 0].mean() > 0.3  # everybody drives at 6 to 15 m/s
    seen = batch[keys.OBJECTS][..., :2][batch[keys.OBJECTS_MASK]]
    assert seen.norm(dim=-1).min() * 20 > 1  # nobody sees itself


def test_command_line_trains_and_evaluates(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, file, picture = tmp_path / "run", tmp_path / "numbers.json", tmp_path / "rollouts.png"
    small = ["--agent.hidden", "8", "--agent.num-points", "20", "--wandb", "disabled"]
    command = ["train", "bc", "--data", store, "--out", out, "--steps", "3", "--seed", "4", *small]
    assert main([str(c) for c in command]) == 0
    command = ["evaluate", out, "--data", store, "--json", file, "--figure", picture, "--rollouts", "2"]
    assert main([str(c) for c in command]) == 0
    numbers = json.loads(file.read_text())
    wanted = {
        "collision_rate",
        "offroad_time",
        "ade",
        "min_sade",
        "curvature_jsd",
        "segments",
        "rollouts",
        "seed",
    }
    assert wanted <= numbers.keys()
    assert numbers["playback"]["ade"] == 0
    assert len(numbers["per_segment"]) == numbers["segments"] == 6
    printed = capsys.readouterr().out
    assert f"{numbers['ade']:.2f}" in printed
    assert f"{numbers['min_sade']:.2f}" in printed
    assert picture.stat().st_size > 10_000


def test_a_store_that_teaches_nothing_is_found_before_training(tmp_path: Path) -> None:
    with StoreWriter(tmp_path / "store"):
        pass
    for method in METHODS:
        with pytest.raises(DataError, match="no run segments") as caught:
            train(replace(config(tmp_path / "store", tmp_path / "run"), method=method))
        assert caught.value.file == tmp_path / "store"
        assert not (tmp_path / "run").exists()


def test_configurations_are_read_back_strictly(store: Path, tmp_path: Path) -> None:
    saved, file = json.loads(to_json(config(store, tmp_path))), tmp_path / "config.json"
    file.write_text(json.dumps({**saved, "format": 99}))
    with pytest.raises(
        ConfigError, match=r"config\.json: configuration of another version, expected format 3"
    ):
        read_json(TrainConfig, file)
    assert saved.pop("format") == 3
    assert from_dict(TrainConfig, saved) == config(store, tmp_path)
    with pytest.raises(ConfigError, match="did you mean 'learning_rate'"):
        from_dict(TrainConfig, {**saved, "learning_rat": 1})
    with pytest.raises(ConfigError, match="missing"):
        from_dict(TrainConfig, {"out": "x", "method": "bc"})
    for seed in (1 << 40, -(1 << 40)):
        with pytest.raises(ConfigError, match="seed must be within"):
            config(store, tmp_path, seed=seed)
    with pytest.raises(ConfigError, match="steps must be positive"):
        replace(config(store, tmp_path), steps=0)
