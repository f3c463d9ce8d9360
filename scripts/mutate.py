"""Change single operators, numbers and names in functions, and tell which changes no test notices. POSIX only.

Each change is made in a process of its own, forked from one that has imported everything, and the tests of that
module are run there until the first that fails. Changes outside of functions (constants, decorators) are not made.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import io
import json
import os
import random
import resource
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]

TESTED = {
    "geometry.boxes": "test_geometry_boxes.py",
    "geometry.frames": "test_geometry_frames.py",
    "geometry.polylines": "test_geometry_polylines.py",
    "geometry.cells": "test_cells.py",
    "geometry.edges": "test_cells.py",
    "geometry.nearest": "test_cells.py",
    "envs.flags": "test_env.py test_cells.py test_device_numbers.py",
    "envs.objects": "test_env_observation.py test_env_routes.py test_env.py test_env_not_finite.py"
    " test_device_numbers.py",
    "envs.observation": "test_env_observation.py test_env.py test_driving_inputs.py",
    "envs.points": "test_env_observation.py test_cells.py test_env.py test_driving_inputs.py test_device_numbers.py",
    "envs.road": "test_cells.py test_driving_inputs.py test_device_numbers.py",
    "envs.routes": "test_env_routes.py test_driving_inputs.py",
    "modules.pooling": "test_modules_pooling.py",
    "modules.rows": "test_modules_pooling.py test_modules_policy.py",
    "modules.winners": "test_modules_winners.py test_modules_pooling.py",
    "modules.displacement": "test_modules_displacement.py test_modules_histogram.py",
    "modules.goals": "test_modules_goals.py",
    "modules.sampling": "test_modules_sampling.py test_modules_histogram.py",
    "envs.dynamics": "test_dynamics.py test_perturbation.py",
    "envs.traffic": "test_traffic.py test_crowd.py",
    "envs.edge": "test_traffic.py test_crowd.py",
    "geometry.stations": "test_stations.py",
    "roadgraph.assign": "test_roadgraph_routes.py test_env_routes.py",
    "roadgraph.branches": "test_roadgraph_branches.py",
    "roadgraph.routes": "test_roadgraph_routes.py test_env_routes.py",
    "simulation.experts": "test_experts.py test_fit.py",
    "simulation.search": "test_search.py test_search_goals.py test_planner.py test_mgail_training.py",
    "simulation.rollouts": "test_search.py test_search_goals.py test_driving_inputs.py",
    "simulation.background": "test_crowd.py",
    "simulation.crowd": "test_crowd.py",
    "simulation.export": "test_export.py",
    "simulation.personas": "test_personas.py",
    "simulation.perturbation": "test_perturbation.py",
    "simulation.planned": "test_planner.py test_planner_kinds.py",
    "simulation.planner_view": "test_planner.py test_planner_kinds.py test_planners.py",
    "simulation.planners": "test_planners.py",
    "simulation.wosac": "test_wosac_rollouts.py",
    "training.alarms": "test_alarms.py",
    "agents.checkpoint": "test_checkpoint.py test_checkpoint_hostile.py",
    "agents.choice": "test_validation.py",
    "data.crop": "test_crop.py",
    "data.merge": "test_merge.py",
    "data.overlaps": "test_overlaps.py",
    "data.plausibility": "test_conformance.py test_segment.py",
    "data.segment": "test_segment.py test_conformance.py",
    "data.sources.argoverse2": "test_argoverse2.py",
    "data.sources.argoverse2_map": "test_argoverse2.py",
    "data.sources.commonroad": "test_commonroad.py",
    "data.sources.commonroad_map": "test_commonroad_map.py test_commonroad.py",
    "data.sources.commonroad_tracks": "test_commonroad.py",
    "data.sources.egos": "test_interaction.py test_commonroad.py",
    "data.sources.geodesy": "test_geodesy.py",
    "data.sources.interaction_motion": "test_interaction.py",
    "data.sources.interaction_signals": "test_interaction.py",
    "data.sources.interaction_tracks": "test_interaction.py",
    "data.sources.lanelet2": "test_lanelet2.py test_interaction.py",
    "data.sources.lanelet2_road": "test_lanelet2.py test_interaction.py",
    "data.sources.lines": "test_limits.py test_lanelet2.py test_commonroad_map.py",
    "data.sources.scenarionet": "test_scenarionet.py",
    "data.sources.scenarionet_map": "test_scenarionet.py",
    "data.sources.womd": "test_womd.py",
    "data.resample": "test_resample.py test_time_step.py",
    "data.context": "test_context.py",
    "evaluation.blocking": "truth",
    "evaluation.contacts": "test_report.py truth",
    "evaluation.driving": "test_report.py",
    "evaluation.fault": "truth",
    "evaluation.paired": "test_paired.py",
    "evaluation.report": "test_report.py",
    "evaluation.relations": "test_relations.py",
    "collectors.rules": "test_collectors_rules.py",
    "collectors.beam_search": "test_collectors_beam_search.py",
    "collectors.pruning": "test_collectors_weights.py",
    "collectors.scores": "test_collectors_beam_search.py",
    "objectives.base": "test_objectives_bc.py test_objectives_masks.py",
    "objectives.goal": "test_objectives_goal.py",
    "objectives.distillation": "test_objectives_distillation.py",
    "objectives.discriminator": "test_objectives_discriminator.py",
    "objectives.mgail": "test_objectives_mgail.py",
    "metrics.realism": "test_metrics_realism.py",
    "metrics.order": "test_metrics_order.py",
    "metrics.kinds": "test_metrics_kinds.py",
    "metrics.agents": "test_metrics_agents.py",
    "metrics.choices": "test_choices.py",
    "metrics.curvature": "test_metrics_summary.py test_choices.py",
    "metrics.summary": "test_metrics_summary.py test_metrics_kinds.py test_choices.py",
    "metrics.rates": "test_metrics_summary.py test_metrics_kinds.py test_choices.py",
    "metrics.wosac.boxes": "test_wosac_features.py test_wosac_parity.py",
    "metrics.wosac.composite": "test_wosac_scoring.py",
    "metrics.wosac.estimators": "test_wosac_scoring.py test_wosac_parity.py",
    "metrics.wosac.interaction": "test_wosac_features.py test_wosac_parity.py",
    "metrics.wosac.kinematics": "test_wosac_features.py test_wosac_parity.py",
    "metrics.wosac.lights": "test_wosac_features.py test_wosac_parity.py",
    "metrics.wosac.road": "test_wosac_features.py test_wosac_parity.py",
    "metrics.wosac.scoring": "test_wosac_scoring.py test_wosac_parity.py test_wosac_evaluation.py",
}
"""Modules of ``symphony`` and the files of tests that are to notice."""
SECONDS = 300
"""CPU time that the tests may take with a change: one that makes them go on for ever is noticed, too."""
QUIET = ("-W", "ignore::pytest.PytestAssertRewriteWarning")
OPERATORS: dict[type, type] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
NAMES = {"amax": "amin", "max": "min", "any": "all", "sin": "cos", "maximum": "minimum", "sum": "mean"}
NAMES |= {other: name for name, other in NAMES.items()}


def changes(tree: ast.Module) -> Iterator[tuple[str, int, Any]]:
    """Every possible change inside functions: what, in which line, and a function that makes it."""
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        for node in (inner for statement in function.body for inner in ast.walk(statement)):
            line = getattr(node, "lineno", function.lineno)
            if isinstance(node, ast.Compare) and type(node.ops[0]) in OPERATORS:
                new = OPERATORS[type(node.ops[0])]()
                yield (
                    f"comparison becomes {type(new).__name__}",
                    line,
                    lambda n=node, o=new: n.ops.__setitem__(0, o),
                )
            elif isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in OPERATORS:
                new = OPERATORS[type(node.op)]()
                yield (
                    f"operator becomes {type(new).__name__}",
                    line,
                    lambda n=node, o=new: setattr(n, "op", o),
                )
            elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
                yield (
                    f"{node.value} becomes {node.value + 1}",
                    line,
                    lambda n=node: setattr(n, "value", n.value + 1),
                )
            elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
                yield "sign or negation gone", line, lambda n=node: setattr(n, "op", ast.UAdd())
            elif isinstance(node, ast.Attribute) and node.attr in NAMES:
                yield (
                    f"{node.attr} becomes {NAMES[node.attr]}",
                    line,
                    lambda n=node: setattr(n, "attr", NAMES[n.attr]),
                )


def replace_code(module: ModuleType, source: ast.Module) -> None:
    """Give the functions of a module the code of those of a changed one, wherever they are known by now."""
    other = ModuleType(module.__name__)
    other.__file__, other.__package__ = module.__file__, module.__package__
    sys.modules["mutated"] = other
    exec(compile(ast.fix_missing_locations(source), str(module.__file__), "exec"), other.__dict__)  # noqa: S102
    places = [(module.__dict__, other.__dict__)]
    places += [
        (kind.__dict__, other.__dict__[name].__dict__)
        for name, kind in module.__dict__.items()
        if inspect.isclass(kind) and kind.__module__ == module.__name__
    ]
    for mine, new in places:
        for name in list(mine):
            if hasattr(mine[name], "cache_clear"):  # of what the tests have asked for before
                mine[name].cache_clear()
            plain, fresh = (_function(each.get(name)) for each in (mine, new))
            if plain is not None and fresh is not None and plain.__module__ == module.__name__:
                plain.__code__ = fresh.__code__


def _function(value: Any) -> FunctionType | None:
    value = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
    value = inspect.unwrap(value) if callable(value) else value
    return value if isinstance(value, FunctionType) else None


def noticed(module: ModuleType, number: int | None, test: str) -> bool:
    """Whether the tests fail with a change, or as it is; not here, where they could leave threads that forks lack."""
    child = os.fork()
    if child == 0:
        status = 1
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        try:
            if number is not None:
                tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
                list(changes(tree))[number][2]()
                replace_code(module, tree)
            status = tests(test)
        finally:
            os._exit(int(status != 0))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0


def tests(names: str) -> int:
    """Run files of tests quietly."""
    files = [str(ROOT / "tests" / name) for name in names.split()]
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        return int(pytest.main([*files, "-x", "-q", "-p", "no:cacheprovider", *QUIET]))


def main(args: list[str] | None = None) -> int:
    """Make changes in turns over the modules; status 1 if one was not noticed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--changes", type=int, default=10, help="of each module")
    parser.add_argument("--modules", nargs="+", choices=list(TESTED), default=list(TESTED))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--again", type=Path, help="earlier counts: make only the changes that were not noticed"
    )
    parser.add_argument("--out", type=Path, default=Path("out/mutate.json"), help="where the counts are kept")
    given = parser.parse_args(args)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    found: dict[str, dict[str, Any]] = {} if given.again is None else json.loads(given.again.read_text())
    for name in list(found) or given.modules:
        module = importlib.import_module(f"symphony.{name}")
        if noticed(module, None, TESTED[name]):
            raise SystemExit(f"{TESTED[name]} fails as it is")
        tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
        possible = [f"line {line}: {what}" for what, line, _ in changes(tree)]
        if name in found:
            chosen = [k for k, text in enumerate(possible) if text in found[name]["missed"]]
        else:
            number = min(given.changes, len(possible))
            chosen = random.Random(given.seed).sample(range(len(possible)), number)  # noqa: S311
            found[name] = {"possible": len(possible), "made": number}
        missed = [possible[k] for k in sorted(chosen) if not noticed(module, k, TESTED[name])]
        for text in missed:
            print(f"not noticed: {name}, {text}", flush=True)
        print(f"{name}: {len(chosen)} of {len(possible)} changes made", flush=True)
        found[name]["missed"] = missed
        given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    made = sum(each["made"] for each in found.values())
    lost = sum(len(each["missed"]) for each in found.values())
    print(f"{made} changes, {made - lost} noticed")
    return int(lost > 0)


if __name__ == "__main__":
    raise SystemExit(main())
