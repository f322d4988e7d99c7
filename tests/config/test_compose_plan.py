"""What a kept plan depends on. (What it is used for is in tests/cli/test_sweep.)"""

from dataclasses import replace
from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.config.build_request import build_request, build_requests
from memmlp.config.compose import compose_checked, compose_config
from memmlp.config.compose_plan import find_sweep, get_sweep_folder

NO_MEMORY = "variants: {a: [], b: [experiment=no_memory]}"
REPLACED = "experiment=no_memory would replace experiment=paper; use experiment=[paper,no_memory]"
SWEEPS: list[tuple[str, list[str], str | None]] = [
    (NO_MEMORY, ["memory=gru"], "variant 'b': experiment=no_memory sets memory, and memory=gru would"),
    (f"base: [memory=gru]\n{NO_MEMORY}", [], "memory=gru would override it"),
    ("variants: {a: [], b: [experiment=paper]}", ["data.drawn_by=frames"], "sets data.drawn_by, and"),
    (f"base: [experiment=paper]\n{NO_MEMORY}", [], REPLACED),
    ("variants: {a: [memory=gru]}\naxes: {experiment: [no_memory]}", [], "memory=gru would"),
    ("base: [experiment=paper]\nvariants: {a: [], b: ['experiment=[paper,no_memory]']}", [], None),
    ("base: [memory=gru]\nvariants: {a: [], b: [experiment=no_memory, memory=none]}", ["optim=muon"], None),
    ("base: [memory=gru]\nvariants: {a: [], b: [memory=none]}", ["experiment=paper"], None),
]


@pytest.mark.parametrize(("content", "words", "said"), SWEEPS)
def test_nothing_undoes_the_experiment_of_an_variant(tmp_path, content, words, said):
    """Hydra lets a group on the command line win over an experiment's, and the label would be wrong."""
    path = tmp_path / "s.yaml"
    path.write_text(content)
    if said is None:
        assert find_sweep(str(path), words).command_line == tuple(words)
        return
    with pytest.raises(InputError) as caught:
        find_sweep(str(path), words)
    assert said in str(caught.value)


def test_a_sweep_has_one_folder_in_whatever_order_it_is_asked_for(tmp_path: Path):
    """Rounds of seeds that were looked at once would else be looked at again, and counted as the first."""
    sweep = find_sweep("14", [])
    a, b, c = (
        get_sweep_folder(replace(sweep, command_line=words), tmp_path)
        for words in (("threads=1", "seed=3"), ("seed=3", "threads=1"), ("seed=3", "seed=4", "threads=1"))
    )
    assert a == b != c
    assert get_sweep_folder(replace(sweep, command_line=("seed=4", "seed=3", "threads=1")), tmp_path) != c
    assert get_sweep_folder(sweep, tmp_path) == tmp_path / "sweeps" / sweep.name


def test_requests_of_several_seeds_are_those_of_each_seed(tmp_path: Path):
    words = ["memory=vq", "data.synth.minutes=0.5", "vqvae.batch=${vqvae.codes}", "vqvae.codes=${vqvae.seed}"]
    checked = compose_checked(["vqvae.seed=${seed}", "seed=4", *words])
    requests = list(build_requests(checked, tmp_path, [4, 9, 7]))
    assert [request.config["vqvae"]["batch"] for request in requests] == [4, 9, 7]
    for seed, request in zip([4, 9, 7], requests, strict=True):
        alone = [f"vqvae.seed={seed}", f"seed={seed}", *words, f"paths.outputs={tmp_path}"]
        expected = build_request(compose_config(alone))
        assert (request.config, request.motion.clips) == (expected.config, expected.motion.clips)
    checked.cfg.data.synth.seed = "${seed}"
    requests = list(build_requests(checked, tmp_path, [1, 2]))
    assert [one.config["data"]["synth"]["seed"] for one in requests] == [1, 2]
    assert len({str(one.motion.clips.root) for one in requests}) == 2
