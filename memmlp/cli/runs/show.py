"""`memmlp runs show`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from memmlp.cli.options import outputs_option
from memmlp.cli.runs.printing import console, measured_numbers, older_results, pairs, recorded

if TYPE_CHECKING:
    from memmlp.runs.run import Run

SUMMARY = ("kind", "started", "finished")
LEFT_OUT = (
    "id", "name", "what", "data", "upstream", "upstream_runs", "sources", "attempts", "forgiven", "stages",
    *SUMMARY,
)  # fmt: skip


@click.command("show")
@click.argument("run")
@click.option("--config", "config", is_flag=True, help="Print the run's resolved config, too.")
@outputs_option
def show(run: str, config: bool, outputs: Path) -> None:
    """Show one run and its results.

    RUN is its id, the beginning of it, or its folder.
    """
    from memmlp.runs.evaluation_file import with_solvers
    from memmlp.runs.identity import flatten
    from memmlp.runs.lookup import find_run, is_trained
    from memmlp.tables.measured_run import load

    found = find_run(outputs, run)
    console().print(pairs(_summary(found)))
    if is_trained(found):
        for source, measured in load(found.folder).by_source().items():
            means = with_solvers(measured.means, found.evaluations_as_configured.combined_by)
            console().print(pairs(flatten(means), title=f"results on {source}"))
    if found.results:
        console().print(pairs(measured_numbers(found), title="results"))
    console().print(pairs(_origin(found), title="made by"))
    if config and found.config:
        console().print(pairs(flatten(found.config), title="config"))


def _summary(run: Run) -> dict[str, Any]:
    """Return in words what a run is, and its progress."""
    one, manifest = recorded(run), run.manifest
    facts = {"run": run.id, "name": one.get("name"), "folder": run.folder, "status": run.status}
    if why := run.failure:
        facts["failed with"] = why
    facts |= {key: manifest[key] for key in SUMMARY if key in manifest}
    facts["data"] = " ".join(dict.fromkeys([str(one.get("data", "-")), str(one.get("data_digest", ""))[:8]]))
    if above := manifest.get("upstream"):
        facts["builds upon"] = above
    attempts = [f"{one['stage']} from step {one['step']}, {one['started']}" for one in _attempts(manifest)]
    if attempts:
        facts["worked on"] = "\n".join(attempts)
    facts |= older_results(run)
    if changed := run.verify():
        facts["changed since"] = ", ".join(changed)
    return facts


def _attempts(manifest: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the stages that processes began, from those records that are complete."""
    return [one for one in manifest.get("attempts", []) if {"stage", "step", "started"} <= one.keys()]


def _origin(run: Run) -> dict[str, Any]:
    """Return the code and the machine with which a run was made, with recipe versions last."""
    from memmlp.runs.identity import flatten

    facts = {key: value for key, value in run.manifest.items() if key not in LEFT_OUT}
    recipes = facts.pop("recipes", {})
    return flatten(facts | {"recipes": recipes})
