"""Backtracking: independent lines, of which a bad one goes back in its own past and draws again.

Copying good branches over bad ones makes rollouts alike; here nothing is copied from another line. After every T_p
steps the lines whose total is above a threshold go back, with every failed try farther, in the end to the start.
Where all tries have failed, the line goes on, and the agents whose trouble it was are excused.

Legend: M lines (all rows and branches), R lines under way, P periods of T_p steps, N agents.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from symphony.collectors.branching import take, take_values

Renew = Callable[[TensorDictBase, Tensor], TensorDictBase]


@dataclass(frozen=True)
class Backtrack:
    """Rule of :func:`symphony.collectors.beam_search`: branches are lines that go back where they are bad.

    A line is bad if it ends a period with a total above the threshold, or NaN. The first time it goes back `back[0]`
    periods from there; if it is bad again before it has come `back[0]` good periods past that place `back[1]`, and so
    on. After the last of them the agents whose score was the worst at all tries are excused: the line goes on, and
    from then on it is judged by the others. So an agent that cannot do better, such as one that starts off the road,
    neither costs more nor hides others. The scores and totals that are returned are those of all agents.

    Args:
        threshold: the threshold in the units of the totals.
        back: periods of each try, counted from the end of the bad one (1 repeats that alone); 0 for the first state.
        cap: a line goes back no more once it has repeated this many times its own length.
        renew: ``renew(state, attempt) -> state`` makes the state [R, 1] that lines go on from. It gets the kept
            entries of the step they go back to and how often each line [R] has gone back so far. It must give them
            other random numbers than before, and add the entries of the start state that were not kept. None where
            everything is kept and numbers come from a global generator.
        width: lines simulated at a time; a waiting line begins whenever one ends, so that few steps have few lines.
            None for all at once. It changes memory and speed only.
        lengths: steps of each line [M], where some end before the others; None if all are equally long.
    """

    threshold: float
    back: tuple[int, ...] = (3, 5, 10, *[0] * 9)
    cap: float = 6.0
    renew: Renew | None = None
    width: int | None = None
    lengths: Int[Tensor, " M"] | None = None

    def __post_init__(self) -> None:
        back = bool(self.back) and min(self.back) >= 0 and self.back[0] >= 1
        width = self.width is None or self.width >= 1
        if not (back and width and self.cap >= 0) or self.threshold != self.threshold:  # NaN
            raise ValueError(f"back and width begin at 1, cap at 0, and the threshold is a number: {self}")


class Course:
    """Where each line [M] is: `at` is its next period, `times` how often it went back, `excused` marks agents that no
    longer count against it, and `blame` those that were bad at all its tries so far and may be excused next.
    """

    def __init__(self, rule: Backtrack, most: Int[Tensor, " M"], agents: int) -> None:
        self.rule, self.most, lines, device = rule, rule.cap * most, len(most), most.device
        self.back = torch.tensor(rule.back, device=device)
        # Tries since it passed its last bad period, the place of that, and periods simulated again.
        self.at, self.times, self.tries, self.front, self.again = torch.zeros(
            5, lines, dtype=torch.int64, device=device
        )
        self.excused, self.blame = torch.zeros(2, lines, agents, dtype=torch.bool, device=device)

    def judge(
        self, line: Int[Tensor, " R"], bad: Bool[Tensor, " R"], worst: Bool[Tensor, "R N"]
    ) -> Bool[Tensor, " R"]:
        """Move lines to new periods, given which ended badly and whose trouble that was; return which go back."""
        at, tries, front = self.at[line], self.tries[line], self.front[line]
        blame = torch.where((tries == 0)[:, None], worst, worst & self.blame[line])
        failed = bad & (tries >= len(self.back))
        # Those who were bad at every try; the others are in trouble for the first time.
        excused = torch.where(blame.any(-1, keepdim=True), blame, worst) & failed[:, None]
        rest, tries = worst & ~excused, torch.where(failed, 0, tries)
        goes = bad & rest.any(-1) & (self.again[line] < self.most[line])
        back = self.back[tries.clamp_max(len(self.back) - 1)]
        to = torch.where(back == 0, 0, (at + 1 - back).clamp_min(0))
        past = ~bad & (at >= front + self.rule.back[0])
        self.excused[line] |= excused
        self.blame[line] = torch.where(failed[:, None], rest, torch.where(bad[:, None], blame, self.blame[line]))
        self.tries[line] = torch.where(past, 0, tries + goes)
        self.front[line] = torch.where(goes, torch.maximum(front, at), front)
        self.again[line] += torch.where(goes, at + 1 - to, 0)
        self.times[line] += goes
        self.at[line] = torch.where(goes, to, at + 1)
        return goes


class Run(NamedTuple):
    """A simulated period of branches [*b, S] or lines [R, 1]: `records` are the kept entries of its steps; `scores`
    are 0 after the end of an episode; `alive` marks the steps up to that end, of each agent's episode or of the one
    of all agents (K = 1); `ended` marks episodes that have ended, `terminated` those that terminated; `after` are the
    last states, and `worth` are their values, or those of the states in which episodes ended.
    """

    records: list[TensorDictBase]
    scores: Float[Tensor, "*b S T N"]
    alive: Bool[Tensor, "*b S T K"]
    ended: Bool[Tensor, "*b S K"]
    after: TensorDictBase
    worth: Float[Tensor, "*b S"] | None = None
    terminated: Bool[Tensor, "*b S K"] | None = None


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
    """Simulate lines [*b, S] until all have ended.

    Returns their kept entries and scores [*b, S, T, N], which steps counted [*b, S, T], totals [*b, P, S], and how
    many line-steps were simulated, those that were done again included.
    """
    lines, device = start.numel(), ended.device
    periods, short = -(-steps // every), steps % every
    entries, length = list(start.keys(True, True)), periods * every
    if rule.lengths is not None and len(rule.lengths) != lines:
        raise ValueError(f"lengths are those of {len(rule.lengths)} lines, there are {lines}")
    order = torch.arange(lines, device=device)
    line, waiting = order[: rule.width], order[rule.width or lines :]
    now, over = take(start, line[:, None]), take_values(ended, line[:, None], start.ndim)
    simulated = line.new_zeros(())
    history: TensorDictBase | None = None
    while len(line):
        run = simulate(now, over, every)
        if history is None:
            own = torch.full_like(order, steps) if rule.lengths is None else rule.lengths
            course = Course(rule, -(-own // every), run.scores.shape[-1])
        at, excused = course.at[line], course.excused[line]
        ending = (at == periods - 1) & (short > 0)
        judged = run._replace(scores=run.scores.masked_fill(excused[:, None, None], 0.0))
        totals, those = total(run)[:, 0], total(judged)[:, 0]
        counted = run.scores[:, 0].masked_fill(excused[:, None], -torch.inf)
        worst = counted.amax(1)
        if short:
            # The last period is simulated as long as the others: what lies past its end is neither counted nor kept.
            totals = torch.where(ending, total(run, short)[:, 0], totals)
            those = torch.where(ending, total(judged, short)[:, 0], those)
            worst = torch.where(ending[:, None], counted[:, :short].amax(1), worst)
        simulated = simulated + every * len(line) - ending.sum() * (every - short)
        alive, period = run.alive[:, 0].any(-1), line * periods + at
        if history is None:
            nowhere = line.new_zeros(lines * length)
            history = take(run.records[0], nowhere)
            all_scores, all_totals = run.scores[:, 0, 0][nowhere], totals[nowhere[: lines * periods]]
            all_alive, all_over = alive[:, 0][nowhere], over[nowhere[: lines * periods]]
        for place, record in enumerate(run.records):
            for key in record.keys(True, True):
                history.get(key).index_copy_(0, period * every + place, record.get(key).flatten(0, 1))
            all_scores.index_copy_(0, period * every + place, run.scores[:, 0, place])
            all_alive.index_copy_(0, period * every + place, alive[:, place])
        all_totals.index_copy_(0, period, totals)
        all_over.index_copy_(0, period, over)
        # An episode that has ended can't be bad any more; a line that goes back goes to before its end.
        bad = ~(those <= rule.threshold) & alive[:, 0] & ~excused.all(-1)
        goes = course.judge(line, bad, ~(worst < worst.amax(-1, keepdim=True))).nonzero().squeeze(-1)
        now, over = run.after.select(*entries), run.ended
        if len(goes):
            who = line[goes]
            first = who * periods + course.at[who]
            root = take(history.exclude("next"), every * first[:, None])
            over = over.index_copy(0, goes, all_over[first])
            root = root if rule.renew is None else rule.renew(root, course.times[who])
            now = _with_rows(now, goes, root, entries)
        on = (course.at[line] < periods).nonzero().squeeze(-1)
        finished = len(line) - len(on)
        if finished:
            others, waiting = waiting[:finished, None], waiting[finished:]
            line, now, over = torch.cat([line[on], others[:, 0]]), take(now, on[:, None]), over[on]
            if len(others):
                now = torch.cat([now, take(start, others).select(*entries)])
                over = torch.cat([over, take_values(ended, others, start.ndim)])
    assert history is not None  # noqa: S101  (a search has a line and a step)
    order = torch.arange(lines * length, device=device).reshape(*start.shape, length)[..., :steps]
    return (
        take(history, order),
        take_values(all_scores, order, 1),
        take_values(all_alive, order, 1),
        all_totals.reshape(*start.shape, periods).transpose(-1, -2),
        int(simulated),
    )


def _with_rows(
    state: TensorDictBase, rows: Int[Tensor, " K"], other: TensorDictBase, entries: Sequence[NestedKey]
) -> TensorDictBase:
    """Return a state [R, 1] in which some rows are replaced by another's [K, 1]."""
    for key in entries:
        value = other.get(key, None)
        if value is None:
            raise ValueError(f"lines can't go back: their kept states have no {key!r}, and `renew` gave none")
        # Not in place: an environment may hand out one tensor for several states.
        state.set(key, state.get(key).index_copy(0, rows, value))
    return state
