"""Golden numbers of a few training steps: losses, then weights."""

import tiny
import torch
from tiny_tasks import part_task
from torch import Tensor, nn

from memmlp.evaluation import modes as evaluation
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.dataset import MotionDataset
from memmlp.motion.network_coordinates import World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.motion_model import MotionModel, State, TrainingOutputs
from memmlp.networks.refiner import SAGERefinerSettings
from memmlp.networks.sage_parts import LATENT, ProductQuantiser
from memmlp.networks.vqvae import VQVAE
from memmlp.training.loop import seed_step, train_step
from memmlp.training.losses import FixedWeights, Loss, Terms
from memmlp.training.optim import Optim, make_vqvae_optim
from memmlp.training.rollout import TeacherForcing
from memmlp.training.train_network import MotionTask, VQVAETask
from memmlp.training.train_refiner import LOSSES, RefinerTask, RefinerTraining
from memmlp.training.train_sage import PARTS, DroppingOptim, SAGEPartTask

ROUNDED = ("quantiser.vectors", "key.bias")
"""Parameters that follow a processor's rounding: the nearest of similar codes, and attention's key biases,
which have no gradient.
"""


Numbers = dict[str, float]


def summary(name: str, values: Tensor) -> Numbers:
    """Four numbers of a tensor that change with nearly every change of it."""
    flat = values.detach().double().flatten()
    ramp = torch.linspace(-1, 1, len(flat), dtype=torch.double)
    return {
        f"{name} mean": float(flat.mean()),
        f"{name} size": float(flat.abs().mean()),
        f"{name} spread": float(flat.square().mean()),
        f"{name} tilt": float((flat * ramp).mean()),
    }


def frames() -> MotionDataset:
    return tiny.frames((60, 45, 80))


def vqvae(codebook: str = "ema") -> Numbers:
    torch.manual_seed(3)
    model = VQVAE(codes=8, width=12, encoder_depth=2, codebook=codebook)
    optim = make_vqvae_optim(3, batch=16, lr=1e-3, weight_decay=0.1)
    task = VQVAETask(model, tiny.normalizer(), frames(), frames(), optim, seed=0)
    return _trained(task, optim) | task.validate()


def _trained(task: VQVAETask | MotionTask | RefinerTask | SAGEPartTask, optim: Optim) -> Numbers:
    """The losses of three steps, and the weights after them."""
    optimiser, found = optim.build(task.parameter_groups()), {}
    average = optim.make_average(task.module, optimiser)
    for step in range(optim.steps):
        seed_step(0, step)
        result = train_step(task, optim, optimiser, step)
        average.update(step + 1)
        found |= {f"{name} {step}": float(term.detach()) for name, term in result.terms.items()}
    average.write_into_module()
    named = task.module.named_parameters()
    weights = torch.cat([p.detach().flatten() for name, p in named if not name.endswith(ROUNDED)])
    return found | summary("weights", weights)


class Line(MotionModel):
    """A linear map of each frame: a network for the training loop alone."""

    branches = frozenset({"rotation", "position"})

    def __init__(self) -> None:
        super().__init__(tiny.normalizer(World()), 7)
        self.map = nn.Linear(SPARSE_DIM, 198)

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        inputs, kept = self.append_inputs(sparse, state)
        return self.map(inputs[:, -(newest or self.frames) :]), kept

    def compute_training_outputs(self, sparse: Tensor, state: State, true_frames: Tensor) -> TrainingOutputs:
        return TrainingOutputs(*self.advance(sparse, state), {"own": self.map.bias.square().sum()})


class Squares(Loss):
    """The mean square: a loss for the training loop alone."""

    def __init__(self) -> None:
        super().__init__()
        self.weighting = FixedWeights({"square": 2.0})

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        return {"square": (motion - truth).square().mean()}


def training() -> Numbers:
    """Three steps of the loop, with AdamW, Adam and gradient clipping."""
    found = {}
    for name, changes in {"adamw": {}, "adam": {"decoupled": False}, "clipped": {"clip_norm": 0.1}}.items():
        found |= {f"{name} {key}": value for key, value in optimised(**changes).items()}
    return found


def optimised(kind: type[Optim] = Optim, **changes: float) -> Numbers:
    torch.manual_seed(2)
    optim = kind(steps=3, batch=4, lr=1e-2, final_lr=1e-3, weight_decay=0.1, **changes)
    task = MotionTask(Line(), Squares(), TeacherForcing(), frames(), optim, 0, lambda network: {})
    return _trained(task, optim)


def refiner() -> Numbers:
    """Three training steps behind a network with each loss, then the stream of both."""
    found = {}
    for kind, loss in LOSSES.items():
        model, split, optim = tiny.refined(), frames(), Optim(steps=3, batch=4, lr=1e-2)
        pieces = RefinerTraining(0, SAGERefinerSettings(6, 2, 20, 6), optim, "frames").draw_pieces(split)
        task = RefinerTask(model, loss(), split, pieces, optim, validate=lambda: {})
        numbers = _trained(task, optim)
        numbers |= summary("stream", evaluation.predict_stream(model.eval(), [tiny.clip(25)])[0])
        found |= {name if kind == "joints" else f"{kind} {name}": value for name, value in numbers.items()}
    return found


def parts() -> Numbers:
    """Three training steps of each part of SAGE-Net, then its errors; codes move towards distant latents."""
    optim = DroppingOptim(steps=3, batch=4, lr=1e-2, lr_drops_at=(0.5,), lr_drop=0.25)
    torch.manual_seed(4)
    quantiser = ProductQuantiser()
    for _ in range(3):
        quantiser(torch.randn(5, LATENT))
    found = summary("codes moved", quantiser.vectors) | summary("codes used", quantiser.usage)
    for kind in PARTS[:-1]:
        task = part_task(kind, optim)
        numbers = _trained(task, optim) | task.validate()
        found |= {f"{kind} {name}": value for name, value in numbers.items() if name != "codebook"}
    return found
