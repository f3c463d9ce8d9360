"""Draw how often runs visit branching regions of each average curvature."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from symphony.cli.helps import TrustCode
from symphony.config import EvaluateConfig
from symphony.errors import ConfigError, DataError


@dataclass(frozen=True)
class Curvature:
    """Draw how often the policy, and the log, visit branching regions of each average curvature.

    A panel for each run; left turns are positive (in the paper, right turns). With --data the runs are evaluated as
    `symphony evaluate` does, and keep it; without, what they keep already is drawn.
    """

    runs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="RUN ...", help_behavior_hint="(required)"),
    ]
    """Folders of runs, or `pretrained:NAME`."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Picture to write (.png, .pdf or .svg)."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Store of run segments to simulate."""
    evaluation: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Without --data: which evaluation of a run counts, as in `symphony table`."""
    trust_code: TrustCode = False
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def __post_init__(self) -> None:
        if not self.runs:
            raise ConfigError("no runs given")
        if self.data is not None and self.evaluation:
            raise ConfigError(
                "--evaluation chooses among what runs keep, --data evaluates them anew: give one"
            )
        if self.data is None and self.config != EvaluateConfig():
            raise ConfigError("settings of the simulation need --data, the run segments to simulate")

    def run(self) -> None:
        """Evaluate where it is asked for, and draw."""
        import numpy as np

        from symphony.agents.included import run_folder
        from symphony.cli.plot import run_names
        from symphony.evaluation.records import read_run
        from symphony.evaluation.table import method_name
        from symphony.metrics import jensen_shannon
        from symphony.render import plot_curvature
        from symphony.render.style import picture_path

        picture_path(self.out)
        panels = {}
        for run, name in zip(self.runs, run_names(self.runs), strict=True):
            folder = run_folder(run)
            if not (folder / "config.json").is_file():
                raise ConfigError(f"{folder} is no run: it has no config.json")
            config = read_run(folder)
            held = self._record(run, folder)["curvature"]
            try:
                policy, log = (np.array(held[part], dtype=np.int64) for part in ("policy", "log"))
                divergence = 1000 * float(jensen_shannon(policy, log))
            except (ValueError, TypeError) as error:
                raise DataError(f"no histogram ({error})", file=folder, field="curvature") from error
            score = f"JSD {divergence:.2f} · 10⁻³".replace(" ", "\N{NO-BREAK SPACE}")  # on one line
            title = f"{method_name(config['method'])} ({name}): {score}"
            panels[title] = policy, log
        try:
            plot_curvature(panels, self.out)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    def _record(self, run: Path, folder: Path) -> dict[str, Any]:
        from symphony.evaluation.records import choose_evaluation, kept_evaluations

        if self.data is None:
            return choose_evaluation(folder, kept_evaluations(folder), self.evaluation)[1]
        from symphony.agents import load_agent
        from symphony.cli.evaluate import evaluate_with_bar
        from symphony.data.store import SegmentStore
        from symphony.evaluation.records import evaluation_record, keep_evaluation

        agent = load_agent(str(run), self.config.device, trust_code=self.trust_code)
        store = SegmentStore(self.data)
        record = evaluation_record(agent, evaluate_with_bar(agent, store, self.config, baselines=True), store)
        keep_evaluation(agent.name, record)
        return record
