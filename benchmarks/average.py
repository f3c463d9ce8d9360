"""Average the weights of a run's checkpoints into a run of their own.

    python benchmarks/average.py RUN OUT [CHECKPOINT ...]

Of the checkpoints given (folders; a run keeps its last three, so copy more of them while it trains), or of all that
the run has. Averaged weights vary less from seed to seed than the last ones, as if the learning rate had gone to zero
(Izmailov et al., "Averaging weights leads to wider optima and better generalization", 2018).
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from symphony.agents import load_agent
from symphony.agents.checkpoint import checkpoints, load_checkpoint, save_checkpoint


def average(run: Path, out: Path, folders: Sequence[Path]) -> Path:
    """Write the run ``out`` and return its checkpoint; it has the settings of ``run``."""
    agent = load_agent(str(run))
    mean: dict[str, dict[str, torch.Tensor]] = {name: {} for name in agent.modules}
    for folder in folders:
        load_checkpoint(folder, modules=agent.modules, partial=True, restore_rng=False)
        for name, module in agent.modules.items():
            for key, value in module.state_dict().items():
                mean[name][key] = mean[name].get(key, 0) + value.double() / len(folders)
    for name, module in agent.modules.items():
        module.load_state_dict({key: mean[name][key].to(value) for key, value in module.state_dict().items()})
    out.mkdir(parents=True)
    for file in ("config.json", "agent.json"):
        shutil.copy(run / file, out / file)
    return save_checkpoint(out / "checkpoints", step=int(folders[-1].name[-12:]), modules=agent.modules)


def main() -> None:
    """Average the checkpoints and print where the result is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("checkpoints", type=Path, nargs="*")
    given = parser.parse_args()
    folders = given.checkpoints or checkpoints(given.run / "checkpoints")
    print(average(given.run, given.out, folders), "of", ", ".join(folder.name for folder in folders))


if __name__ == "__main__":
    main()
