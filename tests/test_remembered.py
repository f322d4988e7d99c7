"""What is remembered of Hydra's work is what Hydra makes anew."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest
import torch
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from onnx_ir import schemas
from remembered import _without_code, remember
from torch.export import exported_program

from memmlp.config import compose
from memmlp.motion import synthetic

REMEMBERED = [
    (ConfigLoaderImpl, "_load_single_config"),
    (ConfigLoaderImpl, "_compose_config_from_defaults_list"),
    (defaults_list, "_create_defaults_list"),
    (defaults_list, "_create_interpolation_map"),
]


def composed(overrides: list[str]) -> str:
    """What Hydra composes, its own settings included, or its complaint."""
    args = compose.parse(overrides)
    with compose._hydra(args):
        loader = GlobalHydra.instance().config_loader()
        try:
            cfg = loader.load_configuration(compose.CONFIG, args.overrides, RunMode.RUN)
        except Exception as error:
            return str(error)
        assert isinstance(cfg, DictConfig)
        return OmegaConf.to_yaml(cfg)


CASES = [
    ["memory=none", "optim.steps=3"],
    ["memory=none", "optim.steps=4", "hydra.job.name=other"],
    ["model=avatar_poser", "loss=avatar_poser"],
    ["memory=nothing"],
    ["memory=lstm", "memory=gru"],
    ["~refiner"],
]


@pytest.mark.slow
def test_the_same_is_composed_anew(monkeypatch: pytest.MonkeyPatch):
    twice = [[composed(overrides) for overrides in CASES] for _ in range(2)]
    for owner, name in REMEMBERED:
        monkeypatch.setattr(owner, name, getattr(owner, name).__wrapped__)
    assert [composed(overrides) for overrides in CASES] == twice[0] == twice[1]


def test_a_file_that_changes_is_read_again(tmp_path: Path):
    (tmp_path / "memory").mkdir()
    found = []
    for layers in ("[2]", "[4]"):
        (tmp_path / "memory" / "own.yaml").write_text(f"defaults: [vq]\nlayers: {layers}\n")
        found.append(composed(["--config-dir", str(tmp_path), "memory=own"]))
    assert [OmegaConf.create(text).memory.layers for text in found] == [[2], [4]]


def test_signatures_of_operators_are_those_that_onnx_makes():
    made = schemas.OpSignature.from_op_schema
    for name, version in (("Gemm", 13), ("Split", 13), ("Split", 18), ("Split", 13)):
        schema = onnx.defs.get_schema(name, version)
        anew = made.__wrapped__(schemas.OpSignature, schema)
        assert repr(made(schema)) == repr(anew)
        assert made(schema) is made(schema)


def test_operators_that_are_made_of_others_are_those_that_torch_collects():
    exported_program._collect_all_valid_cia_ops()  # which may itself make more of them known
    found = [exported_program._collect_all_valid_cia_ops() for _ in range(2)]
    assert found[0] is found[1]
    assert found[0] == exported_program._collect_all_valid_cia_ops.__wrapped__() != set()


def test_motion_is_made_once_and_is_that_of_its_seed(monkeypatch: pytest.MonkeyPatch):
    cases = [("walking", 1, 60.0), ("walking", 2, 60.0), ("walking", 1, 30.0), ("waving", 1, 60.0)]

    def clips() -> list[bytes]:
        made = (synthetic.synthesize_clip(kind, seed, seconds=1.0, fps=fps) for kind, seed, fps in cases)
        return [clip.poses.tobytes() + clip.trans.tobytes() for clip in made]

    twice = clips(), clips()
    changed = synthetic.synthesize_clip("walking", 1, seconds=1.0)
    changed.poses[:] = 0.0
    again = clips()
    monkeypatch.setattr(synthetic, "solve", synthetic.solve.__wrapped__)
    assert clips() == twice[0] == twice[1] == again
    assert len(set(again)) == len(cases)


def test_functions_that_the_exporter_knows_are_those_that_it_finds():
    from torch.onnx._internal.exporter import _registration

    remember()
    made = _registration.ONNXRegistry.from_torchlib
    found, anew = made(), made.__wrapped__(_registration.ONNXRegistry)
    assert found.opset_version == anew.opset_version
    assert repr(found.functions) == repr(anew.functions)
    found.functions.clear()
    assert repr(made().functions) == repr(anew.functions)


class Promoting(torch.nn.Module):
    """Adds what has other types of numbers."""

    def forward(self, frames: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
        return torch.cat([frames + count, frames / count, torch.pow(count, 0.5)]).softmax(-1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # as memmlp does
def test_what_the_exporter_does_without_changes_no_file(monkeypatch: pytest.MonkeyPatch):
    inputs = torch.zeros(2, 3), torch.tensor([[1, 2, 3]])
    options = {"dynamo": True, "verbose": False, "optimize": False, "input_names": ["frames", "count"]}

    def text(export: Callable[..., Any]) -> str:
        program = export(Promoting().eval(), inputs, **options)
        return onnx.printer.to_text(program.model_proto.graph)

    short = torch.onnx.export.__wrapped__
    made = text(short)
    from torch.onnx._internal.fx.passes import type_promotion

    interpreter = type_promotion._TypePromotionInterpreter
    monkeypatch.setattr(interpreter, "run_node", interpreter.run_node.__wrapped__)
    assert made == text(short.__wrapped__)
    assert "Cast" in made


def test_a_graph_has_its_code_once_it_is_called():
    with _without_code(torch.fx):
        graph = torch.fx.symbolic_trace(Promoting())
        assert graph.code == ""
        inputs = torch.ones(2, 3), torch.tensor([[1, 2, 3]])
        torch.testing.assert_close(graph(*inputs), Promoting()(*inputs))
    assert "softmax" in graph.code
