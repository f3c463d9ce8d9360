"""Runs that preview what their agent does while they train."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from PIL import Image

from helpers_runs import run_of, same_weights, tiny, weights
from helpers_segments import crossing, straight_road
from helpers_store import stored
from symphony.agents.checkpoint import checkpoints
from symphony.config import PreviewConfig, TrainConfig, ValidationConfig
from symphony.errors import ConfigError
from symphony.recipes import train
from symphony.render import Clip, animate_rollouts
from symphony.training.logging import Tracker, read_metrics

store = stored(lambda: [straight_road(4, steps=6), crossing(4, steps=5), crossing(5, seed=1, steps=6)])
held_out = stored(lambda: [crossing(6, seed=seed, steps=5) for seed in range(10, 14)])


@pytest.fixture(scope="module", autouse=True)
def few() -> Iterator[None]:
    """Films are small."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("symphony.training.hooks.animate_rollouts", partial(animate_rollouts, size=2.0))
        yield


def config(store: Path, out: Path, every: int, method: Any = "bc", **changes: Any) -> TrainConfig:
    return tiny(method, store, out, preview=PreviewConfig(every=every), **changes)


def media(run: Path) -> list[str]:
    return sorted(path.name for path in (run / "media").glob("*"))


def numbers_of(run: Path) -> list[dict[str, Any]]:
    """Return the records of a run without its validation and its speed."""
    other = ("updates_per_second", "validation_")
    return [{k: x for k, x in record.items() if not k.startswith(other)} for record in read_metrics(run)]


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the places instead of drawing them, which takes a second."""

    def write(clips: list[Clip], path: Path) -> None:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"".join(clip.position.tobytes() for clip in clips))

    monkeypatch.setattr("symphony.training.hooks.animate_rollouts", write)


run = run_of(partial(config, every=4, method="bc_ts_h", steps=5))


def test_a_run_shows_itself_now_and_then_and_at_its_end(run: Path) -> None:
    assert media(run) == [f"rollout-00000{step}.gif" for step in (4, 5)]
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
    assert (len(media(watched)), numbers_of(blind)) == (2, numbers_of(watched))


@pytest.mark.usefixtures("undrawn")
def test_a_resumed_run_shows_the_rest_whatever_is_there(store: Path, tmp_path: Path) -> None:
    whole = config(store, tmp_path / "run", 2, "bc_ts", steps=6)
    train(whole)
    before = {name: (whole.out / "media" / name).read_bytes() for name in media(whole.out)}
    shutil.rmtree(checkpoints(whole.out / "checkpoints")[-1])
    (whole.out / "media" / "rollout-000002.gif").unlink()
    (whole.out / "media" / "rollout-000006.gif").write_bytes(b"cut short")
    train(replace(whole, resume=True))
    assert media(whole.out) == ["rollout-000004.gif", "rollout-000006.gif"]
    assert all((whole.out / "media" / name).read_bytes() == before[name] for name in media(whole.out))
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


@pytest.mark.usefixtures("undrawn")
def test_weights_and_biases_gets_the_film(store: Path, tmp_path: Path, monkeypatch: Any) -> None:
    import wandb

    recorder, logged = Mock(), list[tuple[int, dict[str, Any]]]()
    recorder.log = lambda values, step: logged.append((step, values))
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setattr(wandb, "init", lambda **_: recorder)
    run = train(config(store, tmp_path / "run", 2, steps=4, wandb="offline"))
    assert [step for step, _ in logged] == sorted(step for step, _ in logged)
    found = {step: values["preview/rollout"] for step, values in logged if "preview/rollout" in values}
    assert list(found) == [2, 4]
    for step, video in found.items():
        assert video._path == str(run / "media" / f"rollout-{step:06d}.gif")


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
