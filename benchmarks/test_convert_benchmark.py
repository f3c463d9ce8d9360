"""Measure how fast logs are converted, from the bytes of a file to the store.

``pytest benchmarks/test_convert_benchmark.py``; needs the real WOMD sample (see CONTRIBUTING.md), whose record is
repeated under other names.
"""

from __future__ import annotations

import itertools
import os
import struct
from pathlib import Path
from typing import Any

import pytest

from symphony.data.convert import convert
from symphony.data.sources import womd_pb2 as pb
from symphony.data.sources.womd import masked_crc32c, read_records

RECORDS = 20


@pytest.fixture(scope="module")
def shard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    source = Path(os.environ.get("SYMPHONY_SAMPLES", default)) / "womd" / "motion_data_one_scenario.tfrecord"
    if not source.is_file():
        pytest.skip(f"real sample not found at {source} (set SYMPHONY_SAMPLES)")
    payload = next(read_records(source))
    assert isinstance(payload, bytes)
    scenario = pb.Scenario.FromString(payload)
    path = tmp_path_factory.mktemp("shards") / "training.tfrecord-00000-of-01000"
    with path.open("wb") as file:
        for k in range(RECORDS):
            scenario.scenario_id = f"{k:016x}"
            data = scenario.SerializeToString()
            head = struct.pack("<Q", len(data))
            file.write(head + struct.pack("<I", masked_crc32c(head)))
            file.write(data + struct.pack("<I", masked_crc32c(data)))
    return path


def test_convert_womd(benchmark: Any, shard: Path, tmp_path: Path) -> None:
    names = (tmp_path / str(k) for k in itertools.count())
    report = benchmark.pedantic(convert, setup=lambda: (("womd", [shard], next(names)), {}), rounds=3)
    assert report.converted == RECORDS
    benchmark.extra_info["scenarios_per_s"] = round(RECORDS / benchmark.stats["median"], 1)
