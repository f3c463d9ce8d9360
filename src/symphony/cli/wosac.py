"""Score rollouts as the Waymo Open Sim Agents Challenge does, make and check a submission to it."""

from __future__ import annotations

import tyro

from symphony.cli.wosac_evaluate import Evaluate
from symphony.cli.wosac_score import Score
from symphony.cli.wosac_submit import Submit
from symphony.cli.wosac_table import Table
from symphony.cli.wosac_validate import Validate

app = tyro.extras.SubcommandApp()
app.command(name="score")(Score)
app.command(name="evaluate")(Evaluate)
app.command(name="table")(Table)
app.command(name="submit")(Submit)
app.command(name="validate")(Validate)
