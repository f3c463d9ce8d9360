"""What is learned from more often than the rest."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_runs import tiny
from helpers_segments import straight_road
from symphony import keys
from symphony.config import SamplingConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.envs import Bicycle, ObservationConfig
from symphony.errors import ConfigError, DataError
from symphony.recipes import train
from symphony.simulation import SceneDataset
from symphony.simulation.weights import some_of, state_weights

OBSERVATION = ObservationConfig(num_objects=1, num_points=1)


def dataset(sampling: SamplingConfig | None = None) -> SceneDataset:
    return SceneDataset(SegmentStore(builtin_store("train")), 2, Bicycle(), sampling=sampling)


def record_of(store: SegmentStore, path: Path, rates: dict[str, float], **more: Any) -> Path:
    rows = [{"segment": name, "collision_rate": rate, "offroad_time": 0.0} for name, rate in rates.items()]
    path.write_text(json.dumps({"data": {"checksum": store.checksum()}, "per_segment": rows} | more))
    return path


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@given(st.integers(1, 30), st.integers(1, 40), st.floats(0, 1), st.integers(0, 2**20))
def test_items_are_different_whatever_the_share(total: int, count: int, share: float, seed: int) -> None:
    weights = torch.rand(total, generator=rng(seed), dtype=torch.float64).round()
    found = some_of(weights, count, share, rng(seed))
    assert len(found) == len(set(found)) == min(total, count)
    heavy = sum(weights[item] > 0 for item in found)
    assert heavy >= min(round(count * share), int((weights > 0).sum()), total)


def test_segments_that_went_badly_come_in_proportion(tmp_path: Path) -> None:
    store = SegmentStore(builtin_store("train"))
    rates = dict(zip(store.ids[:3], (30.0, 10.0, 0.0), strict=True))
    record = record_of(store, tmp_path / "hard.json", rates)
    data = dataset(SamplingConfig(hard=record, share=1.0))
    generator = rng()
    drawn = torch.tensor([data.draw(1, generator)[0] for _ in range(2000)])
    assert drawn.unique().tolist() == [0, 1]
    assert (drawn == 0).float().mean() == pytest.approx(0.75, abs=0.04)
    # A copy in another process draws the same.
    copy = pickle.loads(pickle.dumps(data))  # noqa: S301
    assert copy.draw(8, rng(1)) == data.draw(8, rng(1))
    # Without a share of them all is drawn as without a record.
    assert dataset(SamplingConfig(hard=record, share=0.0)).draw(8, rng(1)) == dataset().draw(8, rng(1))


def two_sources(path: Path) -> SegmentStore:
    """Segment number 2 is of another source than the other seven."""
    with StoreWriter(path) as writer:
        for number, segment in enumerate(SegmentStore(builtin_store("train"))):
            writer.append(segment.replace(source="other") if number == 2 else segment)
            if number == 7:
                break
    return SegmentStore(path)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_every_source_comes_as_often(tmp_path: Path, share: float) -> None:
    store = two_sources(tmp_path / "store")
    assert dict(zip(*np.unique(store.sources, return_counts=True), strict=True)) == {"other": 1, "sumo": 7}
    data = SceneDataset(store, 2, Bicycle(), sampling=SamplingConfig(even_sources=True, share=share))
    generator, count = rng(), 2 if share == 0.5 else 1
    drawn = torch.tensor([data.draw(count, generator)[0] for _ in range(2000)])
    assert (drawn == 2).float().mean() == pytest.approx(0.5, abs=0.04)
    assert torch.bincount(drawn)[drawn.unique() != 2].float().std() < 30  # of 143 each
    # Sources are of the store, so a run resumes on what it learned from.
    assert data.checksum() == SceneDataset(store, 2, Bicycle()).checksum()
    # Of a part of one source all are alike.
    rest = SceneDataset(store, 2, Bicycle(), [0, 1, 3], sampling=SamplingConfig(even_sources=True, share=1.0))
    assert torch.tensor([rest.draw(1, generator)[0] for _ in range(300)]).unique().tolist() == [0, 1, 2]


def test_hard_ones_of_a_small_source_come_more_often(tmp_path: Path) -> None:
    store = two_sources(tmp_path / "store")
    record = record_of(store, tmp_path / "hard.json", {store.ids[k]: 10.0 for k in (0, 1, 2)})
    both = SamplingConfig(hard=record, even_sources=True, share=1.0)
    generator, data = rng(), SceneDataset(store, 2, Bicycle(), sampling=both)
    drawn = torch.tensor([data.draw(1, generator)[0] for _ in range(2000)])
    assert drawn.unique().tolist() == [0, 1, 2]
    assert (drawn == 2).float().mean() == pytest.approx(7 / 9, abs=0.04)


def test_a_run_does_not_go_on_with_another_record(tmp_path: Path) -> None:
    store = SegmentStore(builtin_store("train"))
    record = record_of(store, tmp_path / "hard.json", {store.ids[0]: 1.0, store.ids[1]: 2.0})
    sampling = SamplingConfig(hard=record)
    config = tiny("bc", store.path, tmp_path / "run", sampling=sampling)
    train(config)
    more = replace(config, steps=config.steps + 2, resume=True)
    record_of(store, record, {store.ids[0]: 2.0, store.ids[1]: 1.0})
    with pytest.raises(DataError, match="record of hard ones"):
        train(more)
    record_of(store, record, {store.ids[0]: 1.0, store.ids[1]: 2.0})
    train(more)


def test_records_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    store = SegmentStore(builtin_store("train"))
    path = tmp_path / "hard.json"
    for text in ("", "[]", '{"data": {}}', "[" * 100_000):
        path.write_text(text)
        with pytest.raises(DataError, match=r"hard\.json"):
            dataset(SamplingConfig(hard=path))
    with pytest.raises(DataError, match=r"gone\.json"):
        dataset(SamplingConfig(hard=tmp_path / "gone.json"))
    for rates in ({store.ids[0]: float("nan")}, {store.ids[0]: -1.0}):
        with pytest.raises(DataError, match="per_segment"):
            dataset(SamplingConfig(hard=record_of(store, path, rates)))
    with pytest.raises(ConfigError, match="nothing went badly"):
        dataset(SamplingConfig(hard=record_of(store, path, {store.ids[0]: 0.0})))
    record = record_of(store, path, {store.ids[0]: 1.0}, data={"checksum": "0"})
    with pytest.raises(ConfigError, match="another store"):
        dataset(SamplingConfig(hard=record))


def test_states_come_as_often_as_their_weights_say() -> None:
    def shares(sampling: SamplingConfig) -> tuple[float, float]:
        data = dataset(sampling)
        items = list(range(8))
        batch = data.sample_states(items, 6000, OBSERVATION, rng())
        return float((batch[keys.STATE][..., 3].abs() < 0.5).float().mean()), batch[keys.OWN].numel()

    even, standing = shares(SamplingConfig())[0], shares(SamplingConfig(standing=0.25))[0]
    assert 0.02 < even < 0.9
    assert standing == pytest.approx(0.25 * even / (0.25 * even + 1 - even), abs=0.02)
    assert shares(SamplingConfig(standing=0.0))[0] == 0.0


def test_weights_multiply() -> None:
    acts, speed = torch.tensor([True, True, False, False]), torch.tensor([0.0, 5.0, 0.2, -3.0])
    found = state_weights(acts, speed, SamplingConfig(interactive=4.0, standing=0.5))
    assert found.tolist() == [2.0, 4.0, 0.5, 1.0]


def test_interactive_agents_come_more_often() -> None:
    data, often = dataset(), dataset(SamplingConfig(interactive=50.0))
    item = 0
    scene = data.scenes([item])
    size = scene.box_size[0, scene.interactive[0]]

    def share(source: SceneDataset) -> float:
        seen = source.sample_states([item], 2000, ObservationConfig(num_objects=0, num_points=0), rng())
        own = seen[keys.OWN][:, 0, 1:3] * ObservationConfig().size_scale
        return float(((own[:, None] - size).abs().amax(-1) < 1e-4).any(1).float().mean())

    assert share(often) > share(data)


def test_a_batch_in_which_nothing_counts_is_named(tmp_path: Path) -> None:
    standing = straight_road(2, steps=11)
    standing = standing.replace(
        position=standing.position[:, :1].repeat(11, 1), velocity=np.zeros_like(standing.velocity)
    )
    with StoreWriter(tmp_path / "store") as writer:
        writer.append(standing)
    data = SceneDataset(SegmentStore(tmp_path / "store"), 1, Bicycle(), sampling=SamplingConfig(standing=0.0))
    with pytest.raises(DataError, match=r"store.*sampling.*none of the states"):
        data.sample_states([0], 8, ObservationConfig(), rng(0))
