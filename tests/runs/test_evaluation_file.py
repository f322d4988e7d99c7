"""A run's evaluations: which of them count, joined without mixing two kinds of inverse kinematics."""

from pathlib import Path

import pytest
from begun_runs import begun
from fake_runs import write_evaluation

import memmlp.runs.identity
from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.report.ui.run_index import read_facts
from memmlp.runs.evaluation_file import ConfiguredEvaluations, write_report
from memmlp.runs.identity import hash_evaluation_settings
from memmlp.runs.query import build_record
from memmlp.runs.run import Run


def solved(run: Run, ik: str, value: float, iterations: int | None = None, made: str = "1") -> None:
    settings = {"mode": "stream", "ik": ik} | ({"ik_iterations": iterations} if iterations else {})
    errors = {"rotation": {"MPJPE": 9.0}, "combined": {"MPJPE": value, f"of {ik}": value}}
    clips = [{"name": "a", "frames": 60, **errors}]
    report = {"mode": "stream", "settings": settings, "mean": errors, "clips": clips, "made": made}
    run.evaluations.mkdir(exist_ok=True)
    write_evaluation(run.evaluation(hash_evaluation_settings(settings)), report)


def test_combined_is_of_one_inverse_kinematics_which_is_named(tmp_path: Path):
    """That of the run's config, or else the last one; nothing is joined of two."""
    run = begun(tmp_path)
    run.begin("memmlp", {"evaluation": {"ik": "off"}}, data="d", prerequisite=None)
    solved(run, "lbfgs", 1.0, 15, made="1")
    solved(run, "arms", 2.0, made="2")

    def found() -> tuple[dict, dict, dict, dict]:
        read = load_measured_run(run.folder)
        keys = {key: value for key, value in build_record(run).items() if "combined" in key}
        return (
            run.results["stream"]["combined"], read.means["stream"]["combined"],
            run.configured_evaluations.combined_solvers, keys,
        )  # fmt: skip

    both = {"MPJPE": 2.0, "of arms": 2.0}
    named = {f"stream.combined-arms.{key}": value for key, value in both.items()}
    assert found() == (both, both, {"stream": "arms"}, named)
    assert load_measured_run(run.folder).clips["a"]["stream"]["combined"] == both
    run.begin("memmlp", {"evaluation": {"ik": "lbfgs", "ik_iterations": 15}}, data="d", prerequisite=None)
    own = {"MPJPE": 1.0, "of lbfgs": 1.0}
    named = {f"stream.combined-lbfgs-15.{key}": value for key, value in own.items()}
    assert found() == (own, own, {"stream": "lbfgs-15"}, named)
    assert read_facts(run.folder)["metrics"] == {"stream.rotation.MPJPE": 9.0, **named}
    solved(run, "lbfgs", 3.0, 2, made="3")  # others of the same kind
    assert found()[0] == own


def test_a_mode_that_was_measured_by_an_earlier_recipe_says_so(tmp_path: Path, monkeypatch):
    settings = {"mode": "stream", "ik": "off"}
    report = {"mode": "stream", "settings": settings, "mean": {}, "clips": []}
    report["component_versions"] = {"mode.stream": 1}
    write_report(tmp_path / f"{hash_evaluation_settings(settings)}.json", report)
    monkeypatch.setitem(memmlp.runs.identity.VERSIONS, "mode.stream", 1)
    assert ConfiguredEvaluations(tmp_path, {}).outdated == {}
    monkeypatch.setitem(memmlp.runs.identity.VERSIONS, "mode.stream", 2)
    assert ConfiguredEvaluations(tmp_path, {}).outdated == {"stream": "mode.stream 1 -> 2"}


def test_a_damaged_file_is_named_by_what_reads_its_numbers(tmp_path: Path):
    write_json(tmp_path / "stream.json", {"mode": "stream"})
    found = ConfiguredEvaluations(tmp_path, {})
    assert found.paths == [tmp_path / "stream.json"]
    for read in (lambda: found.results, lambda: found.combined_solvers):
        with pytest.raises(InputError, match=r"stream\.json: cannot be read"):
            read()
