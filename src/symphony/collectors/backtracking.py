"""Backtracking: independent lines, of which a bad one goes back in its own past and draws again.

Copying good branches over bad ones makes rollouts alike; here nothing is copied from another line. After every T_p
steps the lines whose total is above a threshold go back, the first time a little and with every failed try farther,
in the end to the start; only the lines that are still under way are simulated. Like the beam search it knows nothing
of what is simulated.

Legend: M lines (all rows and branches), R lines under way, P periods of T_p steps, N agents.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Int
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from symphony.collectors.branching import take, take_values

Renew = Callable[[TensorDictBase, Tensor], TensorDictBase]


@dataclass(frozen=True)
class Backtrack:
    """Rule of :func:`symphony.collectors.beam_search`: branches are lines that go back where they are bad.

    A line is bad that ends a period with a total above the threshold, or NaN. The first time it goes back `back[0]`
    periods from there; if it is bad again before it has come `back[0]` good periods past that place `back[1]`, and so
    on, and then the last of them again and again. Once it was simulated `cap` times over, it goes on as it is.

    Args:
        threshold: in the units of the totals.
        back: periods, counted from the end of the bad one (1 repeats that alone); 0 for the first state.
        cap: of what is simulated again, in lengths of a line: bounds the cost of starts from which nothing goes well.
        renew: ``renew(state, attempt) -> state`` makes the state [R, 1] that lines go on from. It gets the kept
            entries of the step they go back to and how often each line [R] has gone back so far, and must give them
            other random numbers than before, and what was not kept of the entries that the start state has. None
            where everything is kept and numbers come from a global generator.
        width: lines simulated at a time, the next of which begin as others end: few steps are then of few lines. None
            for all. It changes memory and speed only.
    """

    threshold: float
    back: tuple[int, ...] = (3, 5, 10, 0)
    cap: float = 6.0
    renew: Renew | None = None
    width: int | None = None

    def __post_init__(self) -> None:
        if not self.back or min(self.back) < 0 or self.back[0] < 1:
            raise ValueError(f"back is periods, the first at least 1, is {self.back}")
        if self.width is not None and self.width < 1:
            raise ValueError(f"width must be at least 1 line, is {self.width}")
        if not self.cap >= 0 or self.threshold != self.threshold:  # NaN
            raise ValueError(f"cap and threshold must be numbers, are {self.cap} and {self.threshold}")


class Course:
    """Where each line is, and how often it has tried; all [M].

    Args:
        rule: of going back.
        lines: M.
        periods: P.
        device: of the totals.
    """

    def __init__(self, rule: Backtrack, lines: int, periods: int, device: torch.device) -> None:
        self.rule, self.periods = rule, periods
        self.back = torch.tensor(rule.back, device=device)
        self.at, self.tries, self.times, self.front, self.again = torch.zeros(
            5, lines, dtype=torch.int64, device=device
        )

    def judge(self, line: Int[Tensor, " R"], bad: Bool[Tensor, " R"]) -> Bool[Tensor, " R"]:
        """Move lines to their next periods by whether the one they ended was bad; True for those that go back."""
        at, tries, front = self.at[line], self.tries[line], self.front[line]
        goes = bad & (self.again[line] < self.rule.cap * self.periods)
        back = self.back[tries.clamp_max(len(self.back) - 1)]
        to = torch.where(back == 0, 0, (at + 1 - back).clamp_min(0))
        # Past the place of its trouble a line begins to count anew.
        past = ~bad & (at >= front + self.rule.back[0])
        self.tries[line] = torch.where(past, 0, tries + goes)
        self.front[line] = torch.where(goes, torch.maximum(front, at), front)
        self.again[line] += torch.where(goes, at + 1 - to, 0)
        self.times[line] += goes
        self.at[line] = torch.where(goes, to, at + 1)
        return goes


class Run(NamedTuple):
    """A period of branches [*b, S] (of lines [R, 1]) as simulated.

    Attributes:
        records: T_p steps, kept entries.
        scores: [*b, S, T_p, N], 0 after the end of an episode.
        alive: [*b, S, T_p, K] steps before (and with) the end of the episode of each agent, or of all (K = 1).
        ended: [*b, S, K] whose episodes have ended.
        after: the last states.
    """

    records: list[TensorDictBase]
    scores: Tensor
    alive: Tensor
    ended: Tensor
    after: TensorDictBase


@torch.no_grad()
def follow(
    simulate: Callable[[TensorDictBase, Tensor, int], Run],
    total: Callable[..., Tensor],
    start: TensorDictBase,
    ended: Bool[Tensor, "*b S K"],
    rule: Backtrack,
    steps: int,
    every: int,
) -> tuple[TensorDictBase, Tensor, Tensor, Tensor, int]:
    """Simulate lines [*b, S] until all have come to their ends.

    Returns their kept entries and scores [*b, S, T, N], which steps counted [*b, S, T], totals [*b, P, S], and how
    many line-steps were simulated, those that were done again included.

    Args:
        simulate: steps of lines [R, 1] that may have ended [R, 1, K].
        total: of a run [R, 1], or of its first steps alone.
        start: [*b, S].
        ended: whose episodes have ended before they begin.
        rule: when lines go back, and how far.
        steps: T.
        every: T_p.
    """
    lines, device = start.numel(), ended.device
    periods, short = -(-steps // every), steps % every
    entries, length = list(start.keys(True, True)), periods * every
    course = Course(rule, lines, periods, device)
    everyone = torch.arange(lines, device=device)
    line = everyone[: rule.width]
    now, over = take(start, line[:, None]), take_values(ended, line[:, None], start.ndim)
    simulated, begun = line.new_zeros(()), len(line)
    history: TensorDictBase | None = None
    while len(line):
        at = course.at[line]
        run = simulate(now, over, every)
        totals = total(run)[:, 0]
        ending = (at == periods - 1) & (short > 0)
        if short:
            # The last period is simulated as long as the others: what lies past its end is neither counted nor kept.
            totals = torch.where(ending, total(run, short)[:, 0], totals)
        simulated = simulated + every * len(line) - ending.sum() * (every - short)
        alive = run.alive.any(-1)
        if history is None:
            nowhere = line.new_zeros(lines * length)
            history = take(run.records[0], nowhere)
            all_scores, all_totals = run.scores[:, 0, 0][nowhere], totals[nowhere[: lines * periods]]
            all_alive = alive[:, 0, 0][nowhere]
        place = (line * periods + at) * every
        for k, record in enumerate(run.records):
            _write(history, place + k, record)
            all_scores.index_copy_(0, place + k, run.scores[:, 0, k])
            all_alive.index_copy_(0, place + k, alive[:, 0, k])
        all_totals.index_copy_(0, line * periods + at, totals)
        # An episode that has ended can't be bad any more; who goes back goes to before its end.
        goes = course.judge(line, ~(totals <= rule.threshold) & alive[:, 0, 0]).nonzero().squeeze(-1)
        now, over = run.after.select(*entries), run.ended.index_fill(0, goes, False)
        if len(goes):
            who = line[goes]
            root = take(history.exclude("next"), ((who * periods + course.at[who]) * every)[:, None])
            root = root if rule.renew is None else rule.renew(root, course.times[who])
            now = _with_rows(now, goes, root, entries)
        on = (course.at[line] < periods).nonzero().squeeze(-1)
        finished = len(line) - len(on)
        if finished:
            line, now, over = line[on], take(now, on[:, None]), over[on]
        if finished and begun < lines:
            others = everyone[begun : begun + finished]
            line, begun = torch.cat([line, others]), begun + len(others)
            now = torch.cat([now, take(start, others[:, None]).select(*entries)])
            over = torch.cat([over, take_values(ended, others[:, None], start.ndim)])
    assert history is not None  # noqa: S101  (a search has a line and a step)
    order = torch.arange(lines * length, device=device).reshape(*start.shape, length)[..., :steps]
    return (
        take(history, order),
        take_values(all_scores, order, 1),
        take_values(all_alive, order, 1),
        all_totals.reshape(*start.shape, periods).transpose(-1, -2),
        int(simulated),
    )


def _write(into: TensorDictBase, rows: Int[Tensor, " R"], values: TensorDictBase) -> None:
    """Put values [R, 1] into rows of a flat buffer, in place."""
    for key, value in values.items():
        if isinstance(value, TensorDictBase):
            _write(into.get(key), rows, value)
        else:
            into.get(key).index_copy_(0, rows, value.flatten(0, 1))


def _with_rows(
    state: TensorDictBase, rows: Int[Tensor, " K"], other: TensorDictBase, entries: Sequence[NestedKey]
) -> TensorDictBase:
    """A state [R, 1] of which some rows are another's [K, 1]."""
    for key in entries:
        value = other.get(key, None)
        if value is None:
            raise ValueError(f"lines can't go back: their kept states have no {key!r}, and `renew` gave none")
        # Not in place: an environment may hand out one tensor for several states.
        state.set(key, state.get(key).index_copy(0, rows, value))
    return state
