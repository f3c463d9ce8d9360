"""Simulate agents; view the rollouts, evaluate them one by one, export them to other tools."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from dataclasses import field
from pathlib import Path
from shlex import quote
from typing import Annotated, Any, Literal

from tyro.conf import arg

import symphony
from symphony import errors, files, render
from symphony.cli import shared
from symphony.config import EvaluateConfig, checks, evaluation


class Simulate(shared.SimulationOptions):
    """Simulate the interactive agents of every run segment and keep the rollouts.

    An interrupted simulation is continued by the same command. View them with `symphony view`, evaluate them with
    `symphony report`, pass them on with `symphony export`.
    """

    out: Path  # Folder of the rollouts.
    #: Planner that drives the ego, while the agent drives the other interactive agents: `idm`, `log`, or one of your
    #: own, as a file `my.py:plan`, an import path `my.planner:Planner` or another process `pipe:COMMAND`. Planners of
    #: other agents follow, by ids in the source: `3=idm`. With `playback` as the agent, all others play back the log.
    #: There is no search unless --search, --branches or --trees ask for one, because every branch calls the planner;
    #: a tree then has 4 branches by default, or as many as it gives rollouts if that is more.
    planner: Annotated[tuple[str, ...], arg(metavar="NAME [ID=NAME ...]")] = ()
    planner_seconds: float = 60.0  # Seconds that a planner has for one answer; a longer one fails the run.
    #: Simulate at least this many runs (rollouts) in all, equally many of each segment used; 0: `--rollouts` of each.
    runs: checks.Natural = 0
    #: Goals of agents, by their ids in the source: `7=lane:103` for a route over the lane of that id, `7=12.5,-40`
    #: for one that passes a point (metres, in the frame of the segment); all others as the agent draws them.
    goal: Annotated[tuple[str, ...], arg(metavar="ID=PLACE ...")] = ()
    tree: bool = True  # Also save the branches that a search pruned; `--no-tree` leaves them out.
    config: Annotated[evaluation.SimulateConfig, arg(name="")] = field(default_factory=evaluation.SimulateConfig)

    def __post_init__(self) -> None:
        evaluation.check_planner_seconds(self.planner_seconds)
        if self.planner_seconds != Simulate.planner_seconds and not self.planner:
            raise errors.ConfigError("--planner-seconds has no effect without --planner")
        if self.runs and (self.segments or self.config.rollouts != EvaluateConfig.rollouts):
            raise errors.ConfigError("--runs decides the segments and rollouts: omit --segments, --rollouts")

    def __call__(self) -> None:
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.planners.interface import named_planners
        from symphony.rollouts.crowd import crowd_dataset
        from symphony.rollouts.driving import beside_planner, spread_runs
        from symphony.saved.saving import save_simulation

        agent = symphony.load_agent(self.agent, self.config.device, trust_code=self.trust_code)
        store, (planner, drives) = symphony.SegmentStore(self.data).filled(), named_planners(self.planner)
        config: EvaluateConfig = self.config
        config = dataclasses.replace(config, rollouts=config.trees) if self.runs else config
        shared.check_search(agent, beside_planner(config) if planner and agent.policy is not None else config)
        config = beside_planner(config) if planner else config
        chosen = shared.segment_indices(store, self.segments)
        if self.runs:
            count, config = spread_runs(agent, config, self.runs, len(store), planned=bool(planner))
            chosen = evenly_spaced(len(store), count)
        # Beside log playback no other agent is simulated.
        crowd: dict[str, Any] = {"default": 1 if planner and agent.policy is None else agent.interactive}
        crowd |= {"routes": bool(planner or self.goal), "also": drives}
        dataset = crowd_dataset(store, agent, config, chosen or None, **crowd)
        how: dict[str, Any] = {"planner": planner, "drives": drives, "goals": self.goal}
        with shared.progress(f"simulating {agent.name}") as advance:
            how |= {"keep_tree": self.tree, "planner_seconds": self.planner_seconds, "progress": advance}
            found = save_simulation(self.out, agent, dataset, config, **how)
        shared.say(f"{len(found)} run segments in {self.out}: symphony view {quote(str(self.out))}")
        why = [f"{saved.segment.segment_id}, {reason}" for saved in found for reason in saved.failed.values()]
        why += [f"{entry.segment}, {entry.failed}" for entry in found.failures for _ in range(entry.rollouts)]
        runs = sum(entry.rollouts for entry in [*found.entries, *found.failures])
        if why and len(why) == runs:
            raise errors.AllFailedError(f"all {runs} runs failed, the first: {why[0]}")
        if why:
            shared.tell(f"{len(why)} of {runs} runs failed, the first: {why[0]}")


class View(shared.Command):
    """Make a page that plays saved rollouts: it opens from disk in any browser, without a network.

    Several folders play side by side, with metrics over time below; rollouts can be chosen by their events, plans and
    branches of a search are drawn. With --out, make a picture or a film instead, by default of the first segments;
    all folders must hold each.
    """

    folders: shared.SavedFolders
    #: File to write: .html (a page), .png, .pdf, .svg, .gif or .mp4 (extra `video`); by default view.html in SIM.
    out: shared.ResultFile = None
    segments: shared.Ids = ()
    rollouts: checks.Natural = 0  # Rollouts of a segment in a picture (0: all) or a film (0: one), at most.

    def __call__(self) -> None:
        from symphony.render.style import FORMATS
        from symphony.saved.folder import load_rollouts

        folders, clips = [load_rollouts(path) for path in self.folders], []
        names = list(dict.fromkeys(self.segments or (name for folder in folders for name in folder.ids)))
        if lost := [name for name in names if not any(name in folder.ids for folder in folders)]:
            folders[0].of(lost[0])  # says that there is none
        folders = [folder.only(names) for folder in folders]
        out = self.folders[0] / "view.html" if self.out is None else self.out
        if self.rollouts and out.suffix.lower() == ".html":
            raise errors.ConfigError("--rollouts is of pictures and films: a page plays all rollouts")
        with files.lock_file(out) if self.out is None else nullcontext():
            if out.suffix.lower() == ".html":
                from symphony.evaluation.report import report

                write_view(folders, [report(folder, picked=True) for folder in folders], out)
            elif not (names := [n for n in names if self.segments or all(n in folder.ids for folder in folders)]):
                raise errors.ConfigError("no run segment has rollouts to draw in every folder")
            else:
                count = self.rollouts or (None if out.suffix[1:].lower() in FORMATS else 1)
                for name in names if self.segments else names[:6]:
                    for place, folder in zip(places(folders), folders, strict=True):
                        title = errors.printable(f"{place}{shared.short_name(folder.about.agent)}: {name}")
                        clips.append(render.saved_clip(folder.of(name), count, title))
                render.draw_clips(clips, out, columns=len(folders) if len(folders) > 1 else 3)
        shared.say(f"written: {out}")


def places(folders: list[Any]) -> list[str]:
    """Return a label for each folder of rollouts: ends of their paths, as short as tells them apart; none for one."""
    parts = [one.path.resolve().parts for one in folders]
    ends = [["/".join(part[-n:]) for part in parts] for n in range(1, 1 + max(map(len, parts)))]
    shortest = next(end for end in ends if len(set(end)) == len(set(parts)))
    return [f"{place}: " for place in shortest] if len(folders) > 1 else [""]


def write_view(folders: list[Any], reports: list[Any], out: Path) -> None:
    """Write the page that plays the rollouts of folders, with the findings of their reports marked in it."""
    from symphony.render.viewer import view_page

    pairs = list(zip(folders, reports, strict=True))
    names = [f"{place}{one.about.agent}" for place, one in zip(places(folders), folders, strict=True)]
    ids = dict.fromkeys(name for folder in folders for name in folder.ids)
    found = ([report.replay(of.of(name)) if name in of.ids else None for of, report in pairs] for name in ids)
    files.write_file(out, view_page(names, found))


class Report(shared.Command):
    """Report what happened in saved rollouts: collisions and whose fault they were, red lights, progress, comfort.

    Writes report.html (one page, worst runs first, each a click away from its replay), report.json and report.csv.
    """

    folder: shared.Saved
    out: shared.Folder = None  # Folder of the report; by default the same folder.
    evaluated: Literal["interactive", "ego"] = "interactive"  # Evaluate all driven agents, or the ego.
    view: bool = True  # Whether the page that plays the rollouts is written.

    def __call__(self) -> None:
        from symphony.evaluation.report import report
        from symphony.render.report_page import report_page
        from symphony.saved.folder import load_rollouts

        folder, out = load_rollouts(self.folder), self.out or self.folder
        if not folder.entries and not folder.failures:
            raise errors.DataError("holds no rollouts: nothing to judge", file=self.folder)
        with files.Lock(out / "report.lock"):
            with shared.progress("evaluating") as advance:
                found = report(folder, self.evaluated, advance)
            plain, totals = found.plain(), found.totals()
            files.write_json(out / "report.json", plain)
            files.write_file(out / "report.csv", found.csv())
            files.write_file(out / "report.html", report_page(plain, "view.html" if self.view else None))
            if self.view:
                write_view([folder], [found], out / "view.html")
        rows, runs, failed, segments = [], plain["runs"], plain["failed_runs"], totals["segments"]
        for name in (name for name in totals if f"{name}_se" in totals):
            cell = shared.number_cell(totals[name], totals[f"{name}_se"], 2, totals.get(f"{name}_bound"))
            count = totals.get(f"{name}_segments", segments)
            rows.append([name, cell, "" if count == segments else f"{count} of {segments} segments"])
        shared.print_table(rows, f"{found.agent}: {runs} runs, {failed} failed")
        if "parts" in plain:
            shared.print_facts(plain["parts"], "the log, which ends before the runs do, and what is past it")
        shared.say(f"written: {out / 'report.html'}")
        if runs and runs == failed:
            raise errors.AllFailedError(f"all {runs} runs failed; report.json says why each did")


class Export(shared.Command):
    """Write saved rollouts in a format of other tools, one file each."""

    folder: shared.Saved
    #: Format: CommonRoad scenarios (XML 2020a) or OpenSCENARIO (XML 1.2).
    format: Literal["commonroad", "openscenario"] = "commonroad"
    out: shared.Folder = None  # Folder of the files; by default the folder `export` within SIM.
    segments: shared.Ids = ()
    #: Numbers of the rollouts to export of each run segment, counted from 0; by default all.
    rollouts: Annotated[tuple[int, ...], arg(metavar="K ...")] = ()

    def __call__(self) -> None:
        from symphony.saved import export, folder, openscenario

        held, count = folder.load_rollouts(self.folder), 0
        road = self.format == "commonroad"
        write, suffix = (export.commonroad, "xml") if road else (openscenario.openscenario, "xosc")
        with files.Lock((out := self.out or self.folder / "export") / "export.lock"):
            for name in dict.fromkeys(self.segments or held.ids):
                saved = held.of(name)
                for k in dict.fromkeys(self.rollouts or range(saved.rollouts)):
                    if not 0 <= k < saved.rollouts:
                        raise errors.ConfigError(f"{name} has rollouts 0 to {saved.rollouts - 1}, not {k}")
                    with files.replacing(out / f"{folder.file_stem(name)}-{k}.{suffix}") as draft:
                        draft.write_text(write(saved, k), encoding="utf-8")
                    count += 1
        shared.say(f"written: {count} file{'s' * (count != 1)} in {out}")
