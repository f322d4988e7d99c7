"""`memmlp demo`: a picture of a shipped network, then an ablation, without a terminal."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.runs.lookup import DEFAULT, read_card

TINY = [
    "executor=debug", "profile=tiny", "model.depth=2", "data.synth.minutes=0.1", "threads=1",
    "optim.steps=2", "vqvae.steps=2", "optim.validate_every=2",
]  # fmt: skip


@pytest.mark.slow
def test_the_demo_ends_with_a_table_and_a_file(memmlp, tmp_path: Path):
    ran = memmlp("demo", *TINY, "--outputs", str(tmp_path))
    assert ran.code == 0, ran.err
    assert [line[:3] for line in ran.out.splitlines() if line[1:3] == ". "] == ["1. ", "2. ", "3. "]
    assert "Without memory" in ran.out
    assert f"sweep demo {TINY[0]}" in " ".join(ran.out.split())
    assert f"{read_card(DEFAULT)['clip']['errors']['rotation']['MPJPE']:.1f} cm" in ran.out
    picture = ElementTree.parse(tmp_path / "demo" / "clip.svg")
    assert picture.getroot().tag.endswith("svg")
    assert OnnxStream(tmp_path / "demo" / "mem_mlp.onnx").inputs["sparse"].shape == (1, 54)
