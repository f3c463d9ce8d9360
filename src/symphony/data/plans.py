"""What is to be simulated: plans of run segments, and the standard sets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, get_args

from symphony.data.sources.sumo import KINDS, is_own, kind_name, sumo_version
from symphony.errors import ConfigError

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
DURATIONS = (10, 20, 30)
"""Seconds a segment may last."""

VERSION = 1
"""Of this generator: another one may give other segments for the same plan, so a store is not continued by it."""
FIRST_NETWORK = 1_000_000
"""Seeds of networks below this are left to the built-in set and to experiments."""
BLOCK = 100_000
"""Networks that a seed has for each split."""
MAX_SEED = 9_999


@dataclass(frozen=True)
class Plan:
    """All that decides what is in a generated store.

    Attributes:
        segments: how many.
        seed: another seed is another set of networks.
        split: training, validation and test sets never share a network, whatever their seeds.
        kinds: of networks, which take turns; one named twice comes twice as often. A file of roads of one's own is a
            kind, too; its roads are the same for every split and seed, the traffic is another.
        duration: seconds of a segment, one of :data:`DURATIONS`.
        interactive: moving vehicles a segment must have at its first step (N_I).

    Raises:
        ConfigError: a value out of range; names the field.
    """

    segments: int
    seed: int = 0
    split: Split = "train"
    kinds: tuple[str, ...] = ("town",)
    duration: int = 10
    interactive: int = 2

    def __post_init__(self) -> None:
        unknown = [kind for kind in self.kinds if kind not in KINDS and not is_own(kind)]
        missing = [kind for kind in self.kinds if is_own(kind) and not Path(kind).is_file()]
        known = f"(known: {', '.join(KINDS)}, and files of roads: .xodr, .osm, .net.xml)"
        for wrong, message in (
            (self.segments < 1, f"segments must be at least 1, is {self.segments}"),
            (not 0 <= self.seed <= MAX_SEED, f"seed must be between 0 and {MAX_SEED}, is {self.seed}"),
            (self.split not in SPLITS, f"unknown split {self.split!r} (known: {', '.join(SPLITS)})"),
            (unknown, f"kinds: unknown kind of network {', '.join(unknown)!r} {known}"),
            (not self.kinds, f"no kinds {known}"),
            (self.duration not in DURATIONS, f"duration must be one of {DURATIONS}, is {self.duration}"),
            (self.interactive < 2, f"interactive must be at least 2, is {self.interactive}"),
            (missing, f"kinds: there is no file {', '.join(missing)}"),
        ):
            if wrong:
                raise ConfigError(message)

    def network(self, number: int) -> Task:
        """The plan's network of that number, counted from 0."""
        if not 0 <= number < BLOCK:
            raise ConfigError(f"one seed has {BLOCK} networks for each split: make more stores instead")
        first = FIRST_NETWORK + (self.seed * len(SPLITS) + SPLITS.index(self.split)) * BLOCK
        kind = self.kinds[number % len(self.kinds)]
        return Task(kind, first + number, float(self.duration), self.interactive)

    def networks(self, start: int = 0) -> Iterator[Task]:
        """The plan's networks from one number on."""
        return map(self.network, range(start, BLOCK + 1))

    def settings(self) -> dict[str, Any]:
        """As kept with the store: the arguments, and the versions that decide what they give."""
        own = {kind: sha256(Path(kind).read_bytes()).hexdigest() for kind in self.kinds if is_own(kind)}
        found = {**asdict(self), "kinds": list(self.kinds), **({"roads": own} if own else {})}
        return found | {"reader": "generate", "generator": VERSION, "sumo": sumo_version()}


@dataclass(frozen=True)
class Preset:
    """A standard set: its three plans, and the checksums of the stores they give."""

    plans: dict[Split, Plan]
    checksums: dict[Split, str]


MADE_WITH = "SUMO 1.28.0 on Linux, x86-64"
"""What the checksums of the standard sets were taken with: other versions or processors may give others."""


def _preset(train: int, validation: int, test: int, *checksums: str) -> Preset:
    counts = dict(zip(SPLITS, (train, validation, test), strict=True))
    plans = {split: Plan(count, split=split) for split, count in counts.items()}
    return Preset(plans, dict(zip(SPLITS, checksums, strict=True)))


# Both use seed 0, so the smaller set is the beginning of the larger one.
PRESETS: dict[str, Preset] = {
    "town-small": _preset(
        *(2_000, 200, 500),
        "bc250bfc215864d18e132821f7a9eb786dd5ed51f20f3a06aba403eabf700a07",
        "f683fa0e9d9cad2d792be1652c7108d13ce6c42ece6f5a76f3bb707444cf061a",
        "0cfa3e8c082441702d7cc19962bbda606b9941f7434c8c8837f5ef39ad20bbe2",
    ),
    "town": _preset(
        *(10_000, 200, 1_000),
        "5fcd71bef8cc5ea81c118cd28b933280b344eb492a98caba9fcc3a8e1235b141",
        "f683fa0e9d9cad2d792be1652c7108d13ce6c42ece6f5a76f3bb707444cf061a",
        "c2c4a0677f9b780f20f23af5d57b00dc5961d840bcc8b4d95eacc7ff3f0d032d",
    ),
}
"""The standard sets: towns with signals, all kinds of unsignalled control and roundabouts, 10 s, N_I = 2."""


@dataclass(frozen=True)
class Task:
    """One network: its kind and seed, the seconds of a segment, and N_I."""

    kind: str
    seed: int
    duration: float
    interactive: int

    @property
    def name(self) -> str:
        """As in the segments' tags."""
        return f"{kind_name(self.kind)}-{self.seed}"
