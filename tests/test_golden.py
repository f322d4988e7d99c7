"""What components compute is what their versions stand for."""

from __future__ import annotations

import golden
import pytest
from golden_numbers import changed, tolerance

from memmlp.common.components import declared
from memmlp.runs.identity import VERSIONS, version_of


@pytest.mark.slow
@pytest.mark.parametrize("case", golden.CASES)
def test_a_component_computes_what_its_recipe_number_stands_for(case: str):
    """Where this fails, numbers of finished runs and of new ones would be mixed under one identity."""
    known = golden.stored()[case]
    assert known["recipe"] == version_of(case), f"record the numbers of {case}: make golden"
    now = golden.numbers(case)
    wrong = changed(now, known["numbers"], tolerance(case))
    assert not wrong, f"raise the version of {case}: it differs in {wrong[:4]}"


def test_every_component_has_numbers():
    named = {f"{slot}.{name}" for slot, name in declared() if slot != "loggers"}
    named -= {"optim.adamw"}  # its numbers are those of training
    assert set(golden.CASES) | set(golden.UNSEEN) == set(VERSIONS) | named


def test_numbers_are_recorded_only_under_another_recipe(monkeypatch, tmp_path):
    monkeypatch.setattr(golden, "PATH", tmp_path / "golden.json")
    monkeypatch.setattr(golden, "CASES", {"hand.off": lambda: {"a": 1.0}})
    golden.record()
    monkeypatch.setattr(golden, "CASES", {"hand.off": lambda: {"a": 1.001}})
    with pytest.raises(SystemExit, match=r"raise the version of hand\.off"):
        golden.record()
    assert golden.stored()["hand.off"]["numbers"] == {"a": 1.0}
    monkeypatch.setattr(golden, "CASES", {"hand.off": lambda: {"b": 1.0}})
    with pytest.raises(SystemExit, match=r"raise the version of hand\.off"):
        golden.record()
    monkeypatch.setattr(golden, "CASES", {"hand.off": lambda: {"a": 1.0000001, "b": 2.0}})
    golden.record()
    assert golden.stored()["hand.off"]["numbers"] == {"a": 1.0, "b": 2.0}  # what is new is no change
    monkeypatch.setattr(golden, "CASES", {"hand.off": lambda: {"a": 1.001}})
    monkeypatch.setitem(VERSIONS, "hand.off", 99)
    golden.record()
    assert golden.stored()["hand.off"] == {"recipe": 99, "numbers": {"a": 1.001}}
