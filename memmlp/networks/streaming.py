"""Streaming graphs, which are exported for live use and do not compute values twice.

Values that depend on a single frame are computed once, when the frame enters the window, and carried in the
state. The last layers compute only the newest frame.
"""

import copy
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.errors import InputError
from memmlp.motion.body import MOTION_DIM, POSITION, ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import step_gru
from memmlp.networks.motion_model import MotionModel, State, StreamingGraph, fill_past


def make_streaming_graph(model: MotionModel) -> StreamingGraph:
    """Make the streaming graph of a trained network, without changing the network.

    Raises:
        InputError: if the network does not have a streaming graph: estimates of past frames change at each
            step (`memory.history=latest`), it uses future frames, or a custom part does not have a graph.
    """
    if not model.settled:
        raise InputError(
            "export.graph=streaming: must be naive, since the memory's estimates of past frames change at "
            "each step; or set memory.history=first"
        )
    check_is_stream(model)
    if not has_streaming_graph(model):
        raise InputError(
            "export.graph=streaming: must be naive, since a custom part does not have a streaming graph"
        )
    graph = vars(type(model))["graph"]
    return graph(model)


def check_is_stream(model: MotionModel) -> None:
    """Raise InputError for an offline network, which uses future frames."""
    if not model.is_stream:
        raise InputError(
            "model.offline=true: must be false for a stream, since the network uses future frames"
        )


def has_streaming_graph(model: MotionModel) -> bool:
    """Return whether a network has a streaming graph; a network with custom parts may not have one."""
    graph: type[StreamingGraph] | None = vars(type(model)).get("graph")  # not the graph of a base class
    return graph is not None and model.settled and model.is_stream and graph.fits(model)


def make_linear(weight: Tensor, bias: Tensor | None = None) -> nn.Linear:
    """Make a linear layer from a weight (m, n) and a bias (m,)."""
    layer = nn.Linear(weight.shape[1], weight.shape[0], bias is not None).to(weight)
    layer.weight = nn.Parameter(weight.contiguous())
    if bias is not None:
        layer.bias = nn.Parameter(bias)
    return layer


class FrameGRU(nn.Module):
    """GRU layers for one frame, made of plain layers, because not every runtime has a GRU.

    Args:
        gru: the layers, batch first.
    """

    def __init__(self, gru: nn.GRU):
        super().__init__()
        self.gru = gru

    def forward(self, x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Map an input (B, 1, n) and states (layers, B, d) to the output (B, 1, d) and the new states."""
        h, after = x[:, 0], []
        for weights, state in zip(self.gru.all_weights, hidden.unbind(), strict=True):
            h = step_gru(weights, h, state)
            after.append(h)
        return h[:, None], torch.stack(after)


Conversion = Callable[[Tensor, Tensor], Tensor]


class OneFrameNormalizer(Normalizer):
    """A normalizer for single frames, which converts by matrix products.

    For a given heading of the coordinates the conversions are linear. Their matrices are linear in the
    heading's cosine and sine. Converting a basis therefore gives the matrices.

    Args:
        normalizer: the normalizer to reproduce.
    """

    def __init__(self, normalizer: Normalizer):
        super().__init__(normalizer.coordinates, normalizer.rest, normalizer.mean, normalizer.std)
        exact = copy.deepcopy(normalizer).double()
        turns = exact.find_origin(torch.zeros(1, SPARSE_DIM)).shape[-1] - 3

        def encode(x: Tensor, turn: Tensor) -> Tensor:
            return exact.encode_sparse(
                x, torch.cat([exact.find_origin(x)[..., :3], turn.expand(len(x), -1)], -1)
            )

        def decode(x: Tensor, turn: Tensor) -> Tensor:
            return exact.decode_motion(
                x[:, :MOTION_DIM], torch.cat([x[:, MOTION_DIM:], turn.expand(len(x), -1)], -1)
            )

        def decode_rotations(x: Tensor, turn: Tensor) -> Tensor:
            padded = F.pad(x, (0, MOTION_DIM + 3 - ROTATION.stop))
            return decode(padded, turn)[:, ROTATION]

        self.encoder = OneFrameConversion(encode, SPARSE_DIM, turns)
        self.decoder = OneFrameConversion(decode, MOTION_DIM + 3, turns)
        self.rotation_decoder = OneFrameConversion(decode_rotations, ROTATION.stop, turns)
        turned = [
            exact.convert_rotations_to_world(torch.eye(6).double(), F.pad(turn, (3, 0)).expand(6, -1))
            for turn in (torch.zeros(turns).double(), *torch.eye(turns).double())
        ]
        turned[1:] = [matrix - turned[0] for matrix in turned[1:]]
        self.rotation_turner = nn.Parameter(torch.stack(turned)[:, :3, :3].flatten(1))
        self.to(normalizer.mean)

    def encode_sparse(self, sparse: Tensor, origin: Tensor) -> Tensor:
        """Convert world inputs (1, 54) to network space (1, 54)."""
        return self.encoder(sparse, with_one(origin[:, 3:]))

    def decode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Convert motion (1, 198) in network space to the world (1, 198)."""
        return self.decoder(torch.cat([motion, origin[:, :3]], -1), with_one(origin[:, 3:]))

    def convert_rotations_to_world(self, rotations: Tensor, origin: Tensor) -> Tensor:
        """Convert joints' global rotations (1, 132), 6D, from the coordinates of an origin to the world."""
        return self.turn_columns(rotations.view(-1, 3), with_one(origin[:, 3:])).view(1, -1)

    def turn_columns(self, columns: Tensor, turn: Tensor) -> Tensor:
        """Convert columns (n, 3) of global rotations to the world. `turn` (1, 1 or 3) is 1 and the origin's
        turn."""
        return columns @ (turn @ self.rotation_turner).view(3, 3)

    def decode_rotations(self, rotation: Tensor, sparse: Tensor) -> Tensor:
        """Make world motion (1, 198) from rotations (1, 132) in network space at world inputs (1, 54)."""
        world = self.rotation_decoder(rotation, with_one(self.find_origin(sparse)[:, 3:]))
        motion = F.pad(world, (0, POSITION.stop - ROTATION.stop))
        return torch.cat([world, self.compute_positions(motion, sparse).flatten(-2)], -1)


class OneFrameConversion(nn.Module):
    """A conversion of one frame that is linear for a given turn of the coordinates.

    Args:
        convert: the conversion, of vectors (n, in) and a turn (turns,) to vectors (n, out), in float64.
        size: in.
        turns: number of values in a turn.
    """

    def __init__(self, convert: Conversion, size: int, turns: int):
        super().__init__()
        tried = [torch.zeros(turns).double(), *torch.eye(turns).double()]
        offsets = torch.stack([convert(torch.zeros(1, size).double(), turn) for turn in tried])
        basis = torch.eye(size).double()
        matrices = torch.stack(
            [convert(basis, turn) - offset for turn, offset in zip(tried, offsets, strict=True)]
        )
        offsets[1:] -= offsets[:1]  # what each of the turn's numbers adds
        matrices[1:] -= matrices[:1]
        self.parts, self.out = len(matrices), matrices.shape[-1]
        self.weight = nn.Parameter(matrices.transpose(1, 2).reshape(self.parts * self.out, size))
        self.bias = nn.Parameter(offsets.reshape(-1))

    def forward(self, x: Tensor, turn: Tensor) -> Tensor:
        """Convert x (1, in) to (1, out); `turn` (1, 1 or 3) is 1 and the origin's turn."""
        return turn @ F.linear(x, self.weight, self.bias).view(self.parts, self.out)


def with_one(turn: Tensor) -> Tensor:
    """Return a turn (1, n) after a 1: (1, 1 + n)."""
    return torch.cat([torch.ones(1, 1).to(turn), turn], -1)


class StemGraph(StreamingGraph):
    """The base class of windowed networks' streaming graphs. The state has a stem's output for each frame.

    Attributes:
        width: d, the number of values carried for each frame.
    """

    float32_modules: tuple[str, ...] = ("model.stem", "model.head")
    width: int

    def windows(self) -> State:
        """Return zeros (T - 1, d) for the carried values of earlier frames, oldest first."""
        return {"stem": torch.zeros(self.frames - 1, self.width)}

    def step(self, sparse: Tensor, state: State, is_first_step: Tensor) -> tuple[Tensor, State]:
        encoded = self.normalizer.encode_sparse(sparse, self.normalizer.find_origin(sparse))
        entering = self.embed_frame(encoded)
        window = torch.cat([fill_past(state["stem"], entering, is_first_step), entering])
        return self.normalizer.decode_rotations(self.predict_rotation(window, encoded), sparse), {
            "stem": window[1:]
        }

    def embed_frame(self, encoded: Tensor) -> Tensor:
        """Map one frame's inputs (1, 54) in network space to its carried values (1, d)."""
        raise NotImplementedError

    def predict_rotation(self, window: Tensor, encoded: Tensor) -> Tensor:
        """Map a window (T, d) and its newest frame's inputs (1, 54) to rotations (1, 132)."""
        raise NotImplementedError
