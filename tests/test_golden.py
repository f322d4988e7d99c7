"""Components compute the numbers of their versions."""

import golden
import pytest
from golden import changed, tolerance

from memmlp.common.components import collect_components
from memmlp.runs.identity import VERSIONS, find_version


@pytest.mark.slow
@pytest.mark.parametrize("case", golden.CASES)
def test_a_component_computes_the_numbers_of_its_version(case: str):
    """Otherwise different numbers would share a run id."""
    known = golden.stored()[case]
    assert known["recipe"] == find_version(case), f"record the numbers of {case}: make golden"
    now = golden.numbers(case)
    wrong = changed(now, known["numbers"], tolerance(case))
    assert not wrong, f"raise the version of {case}: it differs in {wrong[:4]}"


def test_every_component_has_numbers():
    named = {f"{slot}.{name}" for slot, name in collect_components() if slot != "loggers"}
    named -= {"optim.adamw"}  # its numbers are those of training
    assert set(golden.CASES) | set(golden.UNSEEN) == set(VERSIONS) | named


def test_numbers_are_recorded_only_under_another_version(monkeypatch, tmp_path):
    def record(**numbers: float) -> dict:
        monkeypatch.setattr(golden, "CASES", {"hand.off": lambda: numbers})
        golden.record()
        return golden.stored()["hand.off"]

    monkeypatch.setattr(golden, "PATH", tmp_path / "golden.json")
    record(a=1.0)
    for wrong in ({"a": 1.001}, {"b": 1.0}):
        with pytest.raises(SystemExit, match=r"raise the version of hand\.off"):
            record(**wrong)
    assert record(a=1.0000001, b=2.0)["numbers"] == {"a": 1.0, "b": 2.0}  # new numbers are no change
    monkeypatch.setitem(VERSIONS, "hand.off", 99)
    assert record(a=1.001) == {"recipe": 99, "numbers": {"a": 1.001}}
