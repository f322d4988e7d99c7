"""The page's questions, by address, and the answers to them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.report.ui import runs
from memmlp.report.ui.curves import Curves
from memmlp.report.ui.index import Index
from memmlp.report.ui.replay import Predict, Replays, body
from memmlp.report.ui.runs import Rows
from memmlp.report.ui.searches import Searches
from memmlp.report.ui.sweeps import Sweeps
from memmlp.report.ui.uses_of_run import uses_by_run
from memmlp.runs.identity import ID
from memmlp.sweep.definition import MODES

MOST_CURVES = 60  # runs whose curves are told at once


class Answers:
    """Answers the page's questions about an outputs folder.

    Args:
        outputs: the folder of runs and caches.
        predict: computes a run's prediction for a test clip; None to compute nothing.
        kept: whether parsed facts are stored in the cache folder for the next start.
    """

    def __init__(self, outputs: Path, predict: Predict | None = None, kept: bool = True):
        self.outputs = outputs
        self.index = Index(outputs, outputs / "cache" / "ui" / "runs.sqlite" if kept else None)
        self.sweeps, self.searches = Sweeps(self.index), Searches(outputs)
        self.curves, self.replays = Curves(outputs), Replays(outputs, predict)
        self.rows = Rows(self.index, self.places)
        self.looked = False

    def look(self) -> str:
        """Look at everything again, and return a text that changes whenever anything has changed."""
        generation = self.index.refresh()
        self.index.keep()
        self.looked = True
        self.sweeps.known()
        return f"{generation} {hash((self.sweeps.stamp(), self.searches.stamp()))}"

    def places(self) -> dict[str, list[dict[str, Any]]]:
        """Return, by run id, the sweeps and searches that use a run."""
        return uses_by_run(self.sweeps.known(), self.searches.runs())

    def of(self, name: str, query: Mapping[str, str]) -> Mapping[str, Any]:
        """Return the answer to a question.

        Raises:
            KeyError: if there is nothing with that name.
            ValueError: for a text that should be a number.
        """
        if not self.looked:
            self.look()
        room, _, rest = name.partition("/")
        if room == "runs" and not rest:
            return {
                **self.rows.since(int(query.get("since", 0)), query.get("heads", "")),
                "outputs": str(self.outputs.absolute()),
            }
        if room == "curves" and not rest:
            return self._curves(query)
        if room == "body" and not rest:
            return body()
        if room in ("sweeps", "searches"):
            pages: Any = self.sweeps if room == "sweeps" else self.searches
            return pages.page(rest) if rest else pages.rows()
        if not ID.fullmatch(rest) or rest not in self.index.runs:
            raise KeyError(name)
        if room == "run":
            return runs.page(self.index, self.sweeps.control_of(rest), self.places(), rest)
        if room == "replay":
            return self._replay(rest, query)
        raise KeyError(name)

    def missing(self, name: str) -> str:
        """Say that there is nothing with that name, and where it would be."""
        room, _, rest = name.partition("/")
        folder = {"run": "runs", "replay": "runs", "sweeps": "sweeps", "searches": "tune"}.get(room)
        if folder is None or not rest:
            return f"{name}: there is no such page"
        what = {"runs": "run", "sweeps": "sweep", "tune": "search"}[folder]
        return f"{what} {rest}: it is not in {self.outputs / folder}; is it in another folder of outputs?"

    def _curves(self, query: Mapping[str, str]) -> dict[str, Any]:
        wanted = [one for one in re.findall(ID, query.get("runs", "")) if one in self.index.runs][
            :MOST_CURVES
        ]
        names = query["names"].split("|") if query.get("names") else None
        return {"curves": {run_id: self.curves.of(run_id, names) for run_id in wanted}}

    def _replay(self, run_id: str, query: Mapping[str, str]) -> dict[str, Any]:
        mode = query.get("mode", MODES[0])
        if mode not in MODES or "clip" not in query:
            raise ValueError(f"mode={mode}: allowed are {', '.join(MODES)}, with a clip")
        begin = float(query["from"]) if query.get("from") else None
        return self.replays.get(run_id, query["clip"], mode, begin)

    def close(self) -> None:
        """Cancel the computations that are still waiting."""
        self.replays.close()
