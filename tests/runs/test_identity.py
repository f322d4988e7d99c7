"""What counts for the id of a run, an evaluation and a deployment."""

import pytest
from begun_runs import CONFIG, identity

import memmlp.runs.identity
from memmlp.runs.identity import (
    NEUTRAL,
    Identity,
    affects_training,
    compute_deployment_id,
    compute_evaluation_id,
    describe_export_difference,
)


def test_an_id_is_stable():
    assert identity() == "8efa5d6f30eca72e"


def test_everything_that_affects_the_result_changes_the_id():
    changed = {"seed": 1}, {"model": {"width": 16, "layers": [4, 2]}}, {"new": 0}, {"database": 1}
    changed += tuple({"data": {key: value}} for key, value in (("mirror", True), ("drawn_by", "clips")))
    changed += ({"data": {"sources": {"a": {"weight": 2}}}}, {"optim": {**CONFIG["optim"], "name": "muon"}})
    others = [{"config": CONFIG | one} for one in changed]
    others += [{"kind": "vqvae"}, {"data": "e"}, {"prerequisite": Identity("vqvae", {}, "d")}]
    assert len({identity(), *(identity(**other) for other in others)}) == len(others) + 1


def test_a_new_component_version_changes_the_runs_that_use_it(monkeypatch: pytest.MonkeyPatch):
    gru, lstm = ({**CONFIG, "memory": {"name": name}} for name in ("gru", "lstm"))
    codes = Identity("vqvae", {"vqvae": {"codebook": "ema"}}, "d")
    own = Identity("memmlp", gru, "d", codes)
    before = identity(gru), identity(lstm), own.id
    monkeypatch.setitem(memmlp.runs.identity.VERSIONS, "memory.gru", 2)
    assert identity(gru) != before[0]
    assert identity(lstm) == before[1]
    monkeypatch.undo()
    monkeypatch.setitem(memmlp.runs.identity.VERSIONS, "vqvae", 2)
    assert own.id != before[2]


def test_a_stage_has_an_id_of_its_own_keys():
    def of(**changes: object) -> tuple[str, str, str]:
        config = {**CONFIG, "evaluation": {"ik": "off", "ik_iterations": 15, "batch": 4}, "export": {"a": 1}}
        for key, value in changes.items():
            group, name = key.split("__")
            config[group] = {**config.get(group, {}), name: value}
        return identity(config), compute_evaluation_id(config, "stream"), compute_deployment_id(config)

    def moved(**changes: object) -> list[bool]:
        return [a != b for a, b in zip(of(), of(**changes), strict=True)]

    assert moved(evaluation__ik="lbfgs") == [False, True, False]
    assert moved(evaluation__ik_iterations=3) == [False, False, False]  # there is no inverse kinematics
    assert moved(evaluation__batch=1) == [False, False, False]
    assert (moved(export__a=2), moved(optim__lr=1)) == ([False, False, True], [True, False, False])
    assert describe_export_difference({"opset": 18}, {"export": {"graph": "off"}}) == ""
    assert moved(memory__blend=1) == [False, True, True]
    rolled = {"rollout": {"name": "own_predictions"}, "memory": {"blend": 1}}
    assert identity(CONFIG | rolled) != identity(CONFIG | {**rolled, "memory": {"blend": 0}})


def test_neutral_keys_do_not_count():
    for key in set(NEUTRAL) - {"data"}:
        top, *inner = key.split(".")
        tree: object = "anything"
        for name in reversed(inner):
            tree = {name: tree}
        merged = CONFIG | {top: {**CONFIG.get(top, {}), **tree} if isinstance(tree, dict) else tree}
        assert identity(merged) == identity(), key
    here, elsewhere = (identity(CONFIG | {"data": {"root": root}}) for root in ("here", "elsewhere"))
    assert here == elsewhere


def test_equal_numbers_and_orders_are_one_identity():
    same = {"optim": {"log_every": 5, "lr": 0.001}, "model": {"layers": (2.0, 4), "width": 16.0}, "seed": 0}
    assert identity(same) == identity()


def test_keys_of_later_stages_and_neutral_keys_cannot_change_a_training():
    config = {**CONFIG, "evaluation": {"ik": "off"}, "loggers": {"mlflow": {"name": "mlflow"}}}
    keys = ("model.width", "model", "data.root", "optim.log_every", "evaluation.ik", "loggers")
    assert [affects_training(key, config) for key in keys] == [True, True, True, False, False, False]


def test_a_budget_counts_instead_of_steps_and_validations_where_they_choose_the_weights():
    def moved(base: dict[str, object], **changes: object) -> bool:
        return identity(CONFIG | {"optim": base | changes}) != identity(CONFIG | {"optim": base})

    steps = {"lr": 1e-3, "steps": 5, "validate_every": 2}
    assert moved(steps, steps=6)
    assert not moved(steps, validate_every=3)
    assert moved(steps, tflop=5.0)
    assert not moved(steps | {"tflop": 5.0}, steps=6)
    assert moved(steps | {"tflop": 5.0}, tflop=6.0)
    for changes in ({"validate_every": 3}, {"validation_pieces": 3}):
        assert moved(steps | {"best_by": "rotation"}, **changes)
        assert not moved(steps, **changes)
