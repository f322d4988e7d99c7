"""The stage that trains a VQ-VAE on single frames (App. A)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from memmlp.common import distributed
from memmlp.motion.dataset import MirroredDataset, MotionDataset, WindowSampler
from memmlp.motion.motion_source import Prepared
from memmlp.motion.normalizer import Normalizer
from memmlp.networks import checkpoint
from memmlp.networks.architectures import Architecture
from memmlp.networks.vqvae import VQVAE, measure_rotation_error
from memmlp.runs.run import Run
from memmlp.training.loop import StepResult, TrainingTask, train
from memmlp.training.optim import Optim


@dataclass(frozen=True)
class VQVAETraining:
    """How a VQ-VAE is trained.

    All frames of the training part are equally likely, whatever `data.drawn_by` and the sources' weights are,
    since an epoch has each once (reading 5). So networks that draw windows in other ways share their VQ-VAE.

    Attributes:
        seed: seed of the weights and batches.
        optim: makes the optimisation, given the number of training frames.
        mirror: whether half of the training frames are mirrored (see MirroredDataset).
    """

    seed: int
    optim: Callable[[int], Optim]
    mirror: bool = False
    kind: ClassVar[str] = "vqvae"
    description: ClassVar[str] = "VQ-VAE: train it, since the network's memory uses its code-vectors"

    def train(
        self,
        architecture: Architecture,
        data: Prepared,
        prerequisite: Path | None,
        run: Run,
        device: torch.device,
    ) -> dict[str, float]:
        """Train the architecture's VQ-VAE, from the run's checkpoint if there is one, and write its weights.

        A VQ-VAE builds upon no other run, so `prerequisite` is None. For the other arguments see
        `NetworkTraining.train`.

        Returns:
            The VQ-VAE's errors on the validation frames.
        """
        dataset, validation = (data.open(split).to(device) for split in ("train", "val"))
        torch.manual_seed(self.seed)
        normalizer = architecture.make_normalizer(data.manifest, dataset.frames).to(device)
        model = architecture.vqvae().to(device)
        optim = self.optim(len(dataset.frames))
        training = MirroredDataset(dataset) if self.mirror else dataset
        task = VQVAETask(model, normalizer, training, validation, optim, self.seed)
        train(task, optim, run, self.seed, "VQ-VAE")
        if distributed.is_first():
            checkpoint.write(run.model, checkpoint.module_tensors("model", model), {})
        return task.validate()


class VQVAETask(TrainingTask):
    """The training task of a VQ-VAE: Eq. 1 on the reconstructed rotations, and the codebook loss (App. A)."""

    def __init__(
        self,
        model: VQVAE,
        normalizer: Normalizer,
        dataset: MotionDataset,
        validation: MotionDataset,
        optim: Optim,
        seed: int,
    ):
        self.model, self.normalizer, self.dataset, self.validation = model, normalizer, dataset, validation
        self.module = model
        self.sampler = WindowSampler(dataset, batch=optim.batch, window=1, seed=seed)
        self.used = torch.zeros(len(model.codebook.vectors))

    def step(self, step: int) -> StepResult:
        """Compute the loss on a batch of single frames."""
        clips, end = map(distributed.local_rows, self.sampler.draw(step))
        frames = self.normalizer.encode(self.dataset.stretches(clips, end, 1))[:, 0]
        terms, indices = self.model.compute_losses(frames, self.normalizer)
        self.used = torch.bincount(distributed.gather_rows(indices), minlength=len(self.used)).float()
        return StepResult(torch.stack(list(terms.values())).sum(), terms, clips)

    def report(self) -> dict[str, float]:
        """Return the perplexity of the step's codes, the exponential of the entropy of their counts."""
        return {"perplexity": perplexity(self.used)}

    @torch.no_grad()
    def validate(self) -> dict[str, float]:
        """Compute Eq. 1 and the perplexity on the validation frames."""
        frames = self.normalizer.encode(self.validation.frames)
        vectors, index = self.model.codebook(self.model.encode(frames))
        used = torch.bincount(index, minlength=len(self.used)).float()
        error = measure_rotation_error(self.model.decoder(vectors), frames, self.normalizer)
        return {"rotation": float(error), "perplexity": perplexity(used)}


def perplexity(counts: Tensor) -> float:
    """Return the exponential of the entropy of counts (K,): K if all are equal, 1 if just one is not 0."""
    share = counts / counts.sum().clamp_min(1)
    return float(torch.special.entr(share).sum().exp())
