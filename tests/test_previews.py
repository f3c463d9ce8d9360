"""Runs that preview what their agent does while they train."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image

from helpers_runs import run_of, same_weights, tiny, weights
from helpers_segments import crossing, hide, straight_road
from helpers_store import stored
from symphony.agents import load_agent
from symphony.agents.checkpoint import checkpoints
from symphony.config import EvaluateConfig, PreviewConfig, TrainConfig, ValidationConfig
from symphony.data.store import SegmentStore
from symphony.envs.scene import scene
from symphony.errors import ConfigError
from symphony.learning.demonstrations import SceneDataset
from symphony.recipes import train
from symphony.render import Clip, animate_rollouts
from symphony.rollouts.driving import playback, simulate_batch
from symphony.rollouts.unroll import Rollouts
from symphony.training.hooks import QUANTILES, ROLLOUTS, quantiles, samples_of
from symphony.training.logging import Tracker, read_metrics

MOTIONS = ("speed", "acceleration", "turn")
store = stored(lambda: [straight_road(4, steps=6), crossing(4, steps=5), crossing(5, seed=1, steps=6)])
held_out = stored(lambda: [crossing(6, seed=seed, steps=5) for seed in range(10, 14)])


@pytest.fixture(scope="module", autouse=True)
def few() -> Iterator[None]:
    """Two run segments are shown."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("symphony.training.hooks.SEGMENTS", 2)
        patch.setattr("symphony.training.hooks.animate_rollouts", partial(animate_rollouts, size=2.0))
        yield


def config(store: Path, out: Path, every: int, method: Any = "bc", **changes: Any) -> TrainConfig:
    return tiny(method, store, out, preview=PreviewConfig(every=every), **changes)


def media(run: Path) -> list[str]:
    return sorted(path.name for path in (run / "media").glob("*"))


def numbers_of(run: Path, previews: bool) -> dict[int, dict[str, Any]]:
    """Return the records of a run's previews, or of all else but its validation and its speed, by the update."""
    found = {}
    for r in read_metrics(run):
        kept = [k for k in r if not k.startswith(("updates_per_second", "validation_"))]
        found[r["step"]] = {k: r[k] for k in kept if k.startswith("preview_") == previews}
    return {step: values for step, values in found.items() if values}


previewed = partial(numbers_of, previews=True)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the numbers instead of drawing them, which takes a second."""

    def write(clips: list[Clip], path: Path) -> None:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"".join(clip.position.tobytes() for clip in clips))

    monkeypatch.setattr("symphony.training.hooks.animate_rollouts", write)


run = run_of(partial(config, every=4, method="bc_ts_h", steps=5))


def test_a_run_shows_itself_now_and_then_and_at_its_end(run: Path) -> None:
    assert media(run) == [f"rollout-00000{step}.gif" for step in (4, 5)]
    assert list(previewed(run)) == [4, 5]
    for name in media(run):
        with Image.open(run / "media" / name) as image:
            assert image.n_frames == 6


@pytest.mark.parametrize(("method", "validated"), [("bc_ts_h", True), ("mgail", False)])
@pytest.mark.usefixtures("undrawn")
def test_being_watched_changes_nothing(store, held_out, tmp_path, method, validated):
    blind, watched = (
        train(config(store, tmp_path / str(n), n, method, validation=ValidationConfig(data=data, rollouts=2)))
        for n, data in ((0, None), (2, held_out if validated else None))
    )
    assert same_weights(weights(f"{blind}@last"), weights(f"{watched}@last"))
    assert (len(media(watched)), numbers_of(blind, False)) == (2, numbers_of(watched, False))


@pytest.mark.usefixtures("undrawn")
def test_a_resumed_run_shows_the_rest_whatever_is_there(store: Path, tmp_path: Path) -> None:
    whole = config(store, tmp_path / "run", 2, "bc_ts", steps=6)
    train(whole)
    before = {name: (whole.out / "media" / name).read_bytes() for name in media(whole.out)}
    numbers = previewed(whole.out)
    shutil.rmtree(checkpoints(whole.out / "checkpoints")[-1])
    (whole.out / "media" / "rollout-000002.gif").unlink()
    (whole.out / "media" / "rollout-000006.gif").write_bytes(b"cut short")
    train(replace(whole, resume=True))
    assert media(whole.out) == ["rollout-000004.gif", "rollout-000006.gif"]
    assert all((whole.out / "media" / name).read_bytes() == before[name] for name in media(whole.out))
    assert previewed(whole.out) == numbers
    # How often it is shown does not make it another run.
    train(replace(whole, resume=True, steps=8, preview=PreviewConfig(every=8)))
    assert media(whole.out)[-1] == "rollout-000008.gif"


def test_segments_to_validate_on_are_shown_where_there_are_some(store, held_out, tmp_path, monkeypatch):
    seen: list[str] = []

    def note(clips: list[Clip], path: Path) -> None:
        seen.extend(clip.segment.segment_id for clip in clips)

    monkeypatch.setattr("symphony.training.hooks.animate_rollouts", note)
    train(config(store, tmp_path / "run", 2, steps=2, validation=ValidationConfig(data=held_out, rollouts=1)))
    assert seen == ["crossing-10", "crossing-12"]


def test_the_numbers_are_quantiles_of_what_the_agent_does(run: Path, store: Path) -> None:
    """Simulated with its search and its goals, as the evaluator does; the rest is worked out once more by numpy."""
    agent, segments = load_agent(f"{run}@4"), SegmentStore(store)
    dataset = SceneDataset(segments, 2, agent.dynamics, [0, 1], routes=True)
    scenes = dataset.scenes([0, 1])
    found = simulate_batch(agent, scenes, EvaluateConfig(rollouts=ROLLOUTS)).rollouts
    values: dict[str, list[float]] = {name: [] for name in (*MOTIONS, *(f"{m}_log" for m in MOTIONS), "ade")}
    for b in range(2):
        segment, away = dataset.segment(b), []
        for n, agent_row in enumerate(scenes.interactive[b].tolist()):
            heading = segment.heading[agent_row].astype(float)
            course = np.stack([np.cos(heading), np.sin(heading)], -1)
            speed = (segment.velocity[agent_row] * course).sum(-1)
            tracks = [(heading, speed, "_log")]
            for k in range(ROLLOUTS):
                state = found.state[b, k, : segment.num_steps, n].double().numpy()
                tracks.append((state[:, 2], state[:, 3], ""))
                away.append(np.linalg.norm(state[1:, :2] - segment.position[agent_row, 1:, :2], axis=-1))
            for angle, pace, kind in tracks:
                values[f"speed{kind}"].extend(pace[1:])
                values[f"acceleration{kind}"].extend(np.diff(pace) / segment.dt)
                turn = (np.diff(angle) + math.pi) % (2 * math.pi) - math.pi
                values[f"turn{kind}"].extend(turn / segment.dt)
        values["ade"].append(float(np.mean(away)))
    record = previewed(run)[4]
    for name, numbers in values.items():
        for q, expected in zip(QUANTILES, np.percentile(numbers, QUANTILES), strict=True):
            assert record[f"preview_{name}_p{q}"] == pytest.approx(expected, rel=1e-3, abs=1e-3), name
    for name in ("score_simulated", "score_data"):
        assert sorted(scores := [record[f"preview_{name}_p{q}"] for q in QUANTILES]) == scores
    assert len(record) == 3 * (len(values) + 2)


def test_the_log_is_like_itself_and_what_is_not_there_is_left_out() -> None:
    segment = crossing(4, steps=9)
    for shown in (segment, hide(segment, 1, slice(3, 6))):
        scenes = scene(shown, [0, 1])
        found = playback(scenes)
        samples = samples_of(scenes, found, [segment.dt])
        assert samples["ade"].tolist() == [0]
        assert all(np.isfinite(values).all() for values in samples.values())
    # Of the log, steps with both ends.
    assert (len(samples["speed"]), len(samples["speed_log"])) == (8 + 5, 8 + 4)
    numbers = quantiles(samples_of(scenes, Rollouts(*found[:3], torch.zeros_like(found.counted)), [0.2]))
    assert math.isnan(numbers["preview_speed_p50"])
    assert math.isfinite(numbers["preview_speed_log_p50"])


@pytest.mark.usefixtures("undrawn")
def test_weights_and_biases_gets_video_and_histograms(store: Path, tmp_path: Path, monkeypatch: Any) -> None:
    import wandb

    recorder, logged = Mock(), list[tuple[int, dict[str, Any]]]()
    recorder.log = lambda values, step: logged.append((step, values))
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setattr(wandb, "init", lambda **_: recorder)
    early = replace(tiny("mgail", store, tmp_path).mgail, regression=2)
    run = train(config(store, tmp_path / "run", 2, "mgail", mgail=early, wandb="offline"))
    assert [step for step, _ in logged] == sorted(step for step, _ in logged)
    found = {step: values for step, values in logged if "preview/rollout" in values}
    assert list(found) == [2, 4]
    motions = {f"preview/{name}{kind}" for name in MOTIONS for kind in ("", "_log")}
    assert found[2].keys() == {"preview/rollout", "preview/ade", *motions}
    # A discriminator that has not scored yet has no scores.
    assert found[4].keys() - found[2].keys() == {"preview/score_simulated", "preview/score_data"}
    for step, values in found.items():
        video = values.pop("preview/rollout")
        assert video._path == str(run / "media" / f"rollout-{step:06d}.gif")
        assert all(isinstance(value, wandb.Histogram) and sum(value.histogram) for value in values.values())


def test_a_run_is_named_once_at_weights_and_biases_and_its_variables_hold(tmp_path, monkeypatch):
    import wandb

    told: list[dict[str, Any]] = []
    monkeypatch.setenv("WANDB_MODE", "")  # as if it were not set
    monkeypatch.setattr(wandb, "init", lambda **given: told.append(given))
    for after in (0, 3, 0, 3):  # the second and the fourth go on
        Tracker(tmp_path, {}, "offline", after=after).close()
        monkeypatch.setenv("WANDB_PROJECT", "mine")
        if len(told) == 3:
            (tmp_path / "wandb-id").write_text("../other\n")
    assert [f"{given['mode']} {given['project']}" for given in told] == ["offline symphony", *["offline mine"] * 3]
    assert not {"group", "tags"} & told[0].keys()  # else its own variables would not be looked at
    assert [given["resume"] for given in told[:3]] == [None, "allow", None]
    assert told[0]["id"] == told[1]["id"] != told[2]["id"]
    assert re.fullmatch(r"[0-9a-f]{8}", told[3]["id"])
    locked = wandb.errors.UsageError("No API key configured.\nlog in."), ValueError("mode: input should be")
    monkeypatch.setattr(wandb, "init", Mock(side_effect=locked))
    for why in (r"No API key .*log in\.", "mode: input should be"):
        with pytest.raises(ConfigError, match=rf"^Weights & Biases: {why} .*WANDB_MODE=offline$"):
            Tracker(tmp_path, {}, "online")
