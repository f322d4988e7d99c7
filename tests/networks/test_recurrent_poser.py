"""RecurrentPoser: a stream whatever the calls, its graph, its sizes, its switches."""

import exported
import numpy as np
import onnx
import pytest
import tiny
import torch
from scipy.special import expit as sigmoid

from memmlp.config.build import build_untrained
from memmlp.deploy.export import export
from memmlp.deploy.lower_precision import write_lower_precision
from memmlp.deploy.parity import TOLERANCE, measure_differences
from memmlp.evaluation import modes as evaluation
from memmlp.motion.body import HANDS, POSITION, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.network_coordinates import Heading
from memmlp.networks.recurrent_poser import CELLS, RecurrentCell
from memmlp.networks.streaming import make_streaming_graph

CLIP = tiny.clip(24)
SPARSE = CLIP[None, :, :SPARSE_DIM]


@torch.no_grad()
def test_each_member_learns_by_itself_and_live_they_are_averaged():
    model = tiny.recurrent_poser(Heading(), members=2, output="global")
    truth = torch.stack([tiny.clip(7, seed) for seed in (1, 2)])
    sparse = truth[..., :SPARSE_DIM]
    learned, after, _ = model.compute_training_outputs(sparse, model.initial_state(2), truth)
    alone = tiny.recurrent_poser(Heading(), output="global")
    for index, name in enumerate(model.members):
        alone.members["member1"].load_state_dict(model.members[name].state_dict())
        motion, state = alone.advance(sparse, alone.initial_state(2))
        torch.testing.assert_close(learned[2 * index : 2 * index + 2], motion)
        for block, value in state.items():
            torch.testing.assert_close(after[block.replace("member1", name)], value)
    assert not torch.allclose(learned[:2], learned[2:], atol=1e-3)
    one, two = (list(member.parameters())[-1] for member in model.members.values())  # the heads' biases
    before = model.advance(sparse, model.initial_state(2))[0]
    one += 0.1
    two -= 0.1
    torch.testing.assert_close(model.advance(sparse, model.initial_state(2))[0], before, atol=1e-5, rtol=0)


@torch.no_grad()
def test_arms_reach_where_a_pose_is_made_and_not_where_it_is_learned():
    """So that training is that of global rotations."""
    models = [tiny.recurrent_poser(Heading(), output=output) for output in ("global", "reaching")]
    learned = [m.compute_training_outputs(SPARSE, m.initial_state(), CLIP[None])[0] for m in models]
    assert torch.equal(*learned)
    made = [model.advance(SPARSE, model.initial_state())[0] for model in models]
    hands = SPARSE[..., SPARSE_POSITION].unflatten(-1, (3, 3))[..., 1:, :]
    wrists = [motion[..., POSITION].unflatten(-1, (22, 3))[..., list(HANDS), :] for motion in made]
    assert torch.equal(made[0], learned[0])
    before, after = ((found - hands).norm(dim=-1) for found in wrists)
    assert (after <= before + 1e-5).all()
    assert after.mean() < 0.8 * before.mean()


@torch.no_grad()
def test_a_global_head_begins_at_the_mean_pose():
    """With no hidden state its rotations are those of the normalizer's mean, seen along the heading."""
    model = tiny.recurrent_poser(Heading(), output="global")
    model.members["member1"].head.weight.zero_()
    mean = model.normalizer.decode_rotations(torch.zeros(1, ROTATION.stop), SPARSE[0, :1])
    made = model.pose(model.members["member1"].head(torch.zeros(1, 16)), SPARSE[0, :1])
    found, expected = (evaluation.extract_rotations(motion) for motion in (made, mean))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("cell", CELLS)
@torch.no_grad()
def test_cells_stay_exact_where_layers_are_rounded(cell):
    model, calls = tiny.recurrent_poser(cell=cell, output="global"), []
    blocks = model.members["member1"].blocks
    block = blocks["block2"]
    block.cell.register_forward_hook(lambda of, given, made: calls.append((given, made)))
    with torch.autocast("cpu", torch.bfloat16):
        assert blocks["block1"].mlp(torch.zeros(1, 16)).dtype == torch.bfloat16
        model.compute_training_outputs(SPARSE, model.initial_state(), CLIP[None])
    given, made = calls[0]
    for found, expected in zip(made, block.cell(*given), strict=True):
        assert found.dtype == torch.float32
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("profile", "members", "width", "depth"), [("small", 3, 128, 4), ("paper", 2, 160, 2)]
)
def test_parameters(profile, members, width, depth):
    """A block's GRU is 6 d d + 6 d, its MLP of d hidden units 2 d d + 2 d, its two norms 4 d."""
    found = build_untrained(["model=recurrent_poser", f"profile={profile}"]).count_parameters()
    ends = 54 * width + width + 2 * width + 132 * width + 132
    assert found == members * (depth * (8 * width**2 + 12 * width) + ends) < 4_200_000


@pytest.mark.slow
def test_the_file_is_the_network_and_its_cells_become_int8(step_files, tmp_path):
    model, int8, exact = (
        exported.NETWORKS["recurrent_poser"](),
        tmp_path / "int8.onnx",
        step_files("recurrent_poser"),
    )
    assert measure_differences(model, exact, CLIP).max() <= TOLERANCE
    write_lower_precision("int8", exact, int8, make_streaming_graph(model), [CLIP[:20]])
    assert measure_differences(model, int8, CLIP).max() < 0.2
    export(make_streaming_graph(model), tmp_path / "old.onnx", "run", opset=15)
    assert measure_differences(model, tmp_path / "old.onnx", CLIP).max() <= TOLERANCE
    graph = onnx.load(int8).graph
    types = {tensor.name: tensor.data_type for tensor in graph.initializer}
    given = {node.output[0]: node.input[0] for node in graph.node if node.op_type == "DequantizeLinear"}
    kinds: dict[bool, set[int]] = {True: set(), False: set()}
    for node in graph.node:
        if node.op_type in ("Gemm", "MatMul") and (name := given.get(node.input[1], node.input[1])) in types:
            kinds[".cell." in name].add(types[name])
    assert kinds[True] == {onnx.TensorProto.INT8}
    assert kinds[False] == {onnx.TensorProto.FLOAT}


X = torch.randn(2, 9, 4, generator=torch.Generator().manual_seed(1)).double()


def cell(name: str) -> tuple[RecurrentCell, torch.Tensor]:
    """A cell of width 4 with random weights, and a random state."""
    torch.manual_seed(2)
    made = CELLS[name](4).double()
    return made, torch.randn(2, 4 * made.carried).double()


@pytest.mark.parametrize("length", [1, 2, 7, 8])
@pytest.mark.parametrize("name", ["mingru", "lru"])
@torch.no_grad()
def test_a_linear_cell_is_its_equation(name, length):
    """h = a h + new. mingru: a = 1 - z, new = z W x with z = sigmoid(V x). lru: a = exp(-softplus(decay) r),
    new = sqrt(1 - a^2) i W x, with gates r and i by sigmoids."""
    made, state = cell(name)
    inputs = torch.randn(2, length, 4).double()
    found, h = made(inputs, state)[0], state.numpy()
    for t, x in enumerate(made.linear(inputs).numpy().swapaxes(0, 1)):
        *gates, new = np.split(x, 2 if name == "mingru" else 3, -1)
        gate, enter = map(sigmoid, (gates[0], gates[-1]))
        keep = 1 - gate if name == "mingru" else np.exp(-np.log1p(np.exp(made.decay.numpy())) * gate)
        h = keep * h + (1 if name == "mingru" else np.sqrt(1 - keep**2)) * enter * new
        np.testing.assert_allclose(found[:, t], h, atol=1e-9)
