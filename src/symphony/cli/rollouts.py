"""Simulate agents, and look at the rollouts, evaluate them one by one, hand them to other tools."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

import symphony
from symphony import errors, files, render
from symphony.cli import shared
from symphony.config import EvaluateConfig, checks, evaluation


class Simulate(shared.Simulation):
    """Simulate the interactive agents of every run segment and keep the rollouts.

    An interrupted simulation is continued by the same command. See them with `symphony view`, evaluate them with
    `symphony report`, hand them on with `symphony export`.
    """

    out: Path  # Folder of the rollouts.
    #: Planner that drives the ego, while the agent drives the other interactive agents: `idm`, `log`, or one of your
    #: own: a file `my.py:plan`, an import path `my.planner:Planner`, another process `pipe:COMMAND`. Then planners of
    #: other agents, by their ids in the source: `3=idm`. With `playback` as the agent all others play back the log.
    #: There is no search unless --search, --branches or --trees say so.
    planner: Annotated[tuple[str, ...], arg(metavar="NAME [ID=NAME ...]")] = ()
    planner_seconds: float = 60.0  # Seconds that a planner has for one answer; a longer one fails the run.
    #: Number of runs to simulate (a run is one rollout of one segment) in place of `rollouts`: evenly spread over the
    #: segments, a few more where the number can't be divided so. 0: all segments, `rollouts` of each.
    runs: checks.Natural = 0
    #: Goals of agents, by their ids in the source: `7=lane:103` for a route over the lane of that id, `7=12.5,-40`
    #: for one that comes past a point (metres, in the frame of the segment); all others as the agent draws them.
    goal: Annotated[tuple[str, ...], arg(metavar="ID=PLACE ...")] = ()
    tree: bool = True  # Leave out the branches that a search pruned.

    def __post_init__(self) -> None:
        evaluation.check_planner_seconds(self.planner_seconds)
        if self.runs and (self.segments or self.config.rollouts != EvaluateConfig.rollouts):
            raise errors.ConfigError("--runs says which segments and rollouts: no --segments, no --rollouts")

    def __call__(self) -> None:
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.planners.interface import named_planners
        from symphony.rollouts.crowd import crowd_dataset
        from symphony.rollouts.driving import beside_planner, spread_runs
        from symphony.saved.saving import save_simulation

        agent = symphony.load_agent(self.agent, self.config.device, trust_code=self.trust_code)
        store, (planner, drives) = symphony.SegmentStore(self.data), named_planners(self.planner)
        config = beside_planner(self.config) if planner else self.config
        chosen = shared.segment_indices(store, self.segments)
        if self.runs:
            count, config = spread_runs(agent, config, self.runs, len(store))
            chosen = evenly_spaced(len(store), count)
        # Beside log playback nobody else is simulated.
        crowd: dict[str, Any] = {"default": 1 if planner and agent.policy is None else agent.interactive}
        crowd |= {"routes": bool(planner or self.goal), "also": drives}
        dataset = crowd_dataset(store, agent, config, chosen or None, **crowd)
        how: dict[str, Any] = {"planner": planner, "drives": drives, "goals": self.goal}
        with shared.progress(f"simulating {agent.name}") as advance:
            how |= {"keep_tree": self.tree, "planner_seconds": self.planner_seconds, "progress": advance}
            found = save_simulation(self.out, agent, dataset, config, **how)
        shared.say(f"{len(found)} run segments in {self.out}: symphony view {self.out}")
        why = [f"{saved.segment.segment_id}, {reason}" for saved in found for reason in saved.failed.values()]
        why += [f"{entry.segment}, {entry.failed}" for entry in found.failures for _ in range(entry.rollouts)]
        runs = sum(entry.rollouts for entry in [*found.entries, *found.failures])
        if why and len(why) == runs:
            raise errors.AllFailedError(f"all {runs} runs failed, the first: {why[0]}")
        if why:
            shared.tell(f"{len(why)} of {runs} runs failed, the first: {why[0]}")


class View(shared.Command):
    """Make a page that plays saved rollouts: it opens from disk in any browser, without a network.

    Play, scrub, zoom, follow, click an agent; collisions are marked and listed; where a search was kept, its branches
    with their scores and why they were pruned. With --out a picture or a film instead, by default of the first few
    run segments.
    """

    folder: shared.Saved
    #: File to write: a page (.html), a picture (.png, .pdf or .svg), an animation (.gif) or a film (.mp4, which
    #: needs `pip install 'symphony-traffic[video]'`). By default view.html in the folder.
    out: shared.ResultFile = None
    segments: shared.Segments = ()
    #: Rollouts of each run segment in a picture or film, at most; 0: all in a picture, the first one in a film.
    rollouts: checks.Natural = 0

    def __call__(self) -> None:
        from symphony.evaluation.report import report
        from symphony.render.style import FORMATS
        from symphony.saved.folder import load_rollouts

        folder = load_rollouts(self.folder)
        if self.segments:
            folder = folder.only(folder.of(name).segment.segment_id for name in self.segments)
        out = self.folder / "view.html" if self.out is None else self.out
        with files.lock_file(out) if self.out is None else nullcontext():
            if out.suffix.lower() == ".html":
                write_view(folder, report(folder, picked=True), out)
            elif not (names := self.segments or folder.ids[:6]):
                raise errors.ConfigError(f"{self.folder} holds no rollouts to draw")
            else:
                count = self.rollouts or (None if out.suffix[1:].lower() in FORMATS else 1)
                agent = " among ".join(map(shared.short_name, folder.about.agent.split(" among ")))
                clips = [render.saved_clip(folder.of(name), count, f"{agent}: {name}") for name in names]
                render.draw_clips(clips, out)
        shared.say(f"written: {out}")


def write_view(folder: Any, found: Any, out: Path) -> None:
    """Write the page that plays the rollouts of a folder, with what the report of them found marked in it."""
    from symphony.render.viewer import view_page

    replays = ((saved, found.events[saved.segment.segment_id]) for saved in folder)
    files.write_file(out, view_page(folder.about.agent, replays, folder.about.settings))


class Report(shared.Command):
    """Report what happened in saved rollouts: collisions and whose fault, red lights, progress, comfort and more.

    Writes report.html (one page, worst runs first, each a click away from its replay), report.json and report.csv.
    """

    folder: shared.Saved
    out: shared.Folder = None  # Folder of the report; by default the same folder.
    #: Agents that are evaluated: all that are driven, or only the ego.
    evaluated: Literal["interactive", "ego"] = "interactive"
    view: bool = True  # Leave the page that plays the rollouts unwritten.

    def __call__(self) -> None:
        from symphony.evaluation.report import report
        from symphony.render.report_page import report_page
        from symphony.saved.folder import load_rollouts

        folder, out = load_rollouts(self.folder), self.out or self.folder
        with files.Lock(out / "report.lock"):
            with shared.progress("evaluating") as advance:
                found = report(folder, self.evaluated, advance)
            plain, totals = found.plain(), found.totals()
            files.write_json(out / "report.json", plain)
            files.write_file(out / "report.csv", found.csv())
            files.write_file(out / "report.html", report_page(plain, "view.html" if self.view else None))
            if self.view:
                write_view(folder, found, out / "view.html")
        rows, runs, failed, segments = [], plain["runs"], plain["failed_runs"], totals["segments"]
        for name in (name for name in totals if f"{name}_se" in totals):
            cell = shared.number_cell(totals[name], totals[f"{name}_se"], 2, totals.get(f"{name}_bound"))
            count = totals.get(f"{name}_segments", segments)
            rows.append([name, cell, "" if count == segments else f"{count} of {segments} segments"])
        shared.print_table(rows, f"{found.agent}: {runs} runs, {failed} failed")
        shared.say(f"written: {out / 'report.html'}")
        if runs and runs == failed:
            raise errors.AllFailedError(f"all {runs} runs failed; report.json says why each did")


class Export(shared.Command):
    """Write saved rollouts in a format of other tools, a file for each."""

    folder: shared.Saved
    format: Literal["commonroad", "json"] = "commonroad"  # Format: CommonRoad scenarios (XML 2020a), or JSON.
    out: shared.Folder = None  # Folder of the files; by default the folder `export` within SIM.
    segments: shared.Segments = ()
    #: Numbers of the rollouts to export of each run segment, counted from 0; by default all.
    rollouts: Annotated[tuple[int, ...], arg(metavar="K ...")] = ()

    def __call__(self) -> None:
        from symphony.saved.export import commonroad, to_dict
        from symphony.saved.folder import file_stem, load_rollouts

        folder, count, suffix, write = load_rollouts(self.folder), 0, "xml", commonroad
        if self.format == "json":
            suffix = "json"
            write = lambda *of: json.dumps(to_dict(*of), ensure_ascii=False, allow_nan=False) + "\n"  # noqa: E731
        out = self.out or self.folder / "export"
        with files.Lock(out / "export.lock"):
            for name in self.segments or folder.ids:
                saved = folder.of(name)
                for k in self.rollouts or range(saved.rollouts):
                    if not 0 <= k < saved.rollouts:
                        raise errors.ConfigError(f"{name} has rollouts 0 to {saved.rollouts - 1}, not {k}")
                    text = write(saved, k)
                    files.write_file(out / f"{file_stem(name)}-{k}.{suffix}", text)
                    count += 1
        shared.say(f"written: {count} files in {out}")
