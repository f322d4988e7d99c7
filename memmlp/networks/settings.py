"""The common settings of networks without slots. This module does not import torch."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from memmlp.common.components import find_chosen_settings
from memmlp.common.settings import Settings, at_least, setting


@dataclass(frozen=True)
class Release:
    """The format of the checkpoints that a network's authors publish; `memmlp import-weights` reads them.

    Names may contain `*` for any part between dots. A name of the authors may end in `[I/N]`: the I-th of N
    equal parts of its rows.

    Attributes:
        source: the repository and the commit whose checkpoints these are.
        names: the authors' name for the name of each parameter here.
        sizes: for a config key the authors' parameter and the axis with its size, or names with `*` to count.
        unused: names of the authors that their network does not use.
        config: config values of the release.
    """

    source: str
    names: dict[str, str]
    sizes: Mapping[str, tuple[str, int] | str]
    unused: tuple[str, ...] = ()
    config: Mapping[str, Any] = field(default_factory=dict)


def name_encoder(ours: str, theirs: str) -> dict[str, str]:
    """Return the names of encoder layers for a Release: ours, and those of `torch.nn.TransformerEncoder`."""
    parts = {"attention.out": "self_attn.out_proj", "attention_norm": "norm1", "norm": "norm2"}
    parts |= {"widen": "linear1", "narrow": "linear2"}
    names = {f"{ours}.{mine}.*": f"{theirs}.{part}.*" for mine, part in parts.items()}
    for index, part in enumerate(("query", "key", "value")):
        names[f"{ours}.attention.{part}.*"] = f"{theirs}.self_attn.in_proj_*[{index}/3]"
    return names


def name_dit_blocks(ours: str, theirs: str) -> dict[str, str]:
    """Return the names of DiT blocks for a Release: ours, and those of the DiT code with layers of timm."""
    parts = {"attention.out": "attn.proj", "mlp.0": "mlp.fc1", "mlp.2": "mlp.fc2"}
    parts |= {"modulation": "adaLN_modulation.1"}
    names = {f"{ours}.{mine}.*": f"{theirs}.{part}.*" for mine, part in parts.items()}
    for index, part in enumerate(("query", "key", "value")):
        names[f"{ours}.attention.{part}.*"] = f"{theirs}.attn.qkv.*[{index}/3]"
    return names


def make_strided_times(steps: int, count: int) -> list[int]:
    """Return `count` multiples of a stride below `steps`, the largest first; fewer if it does not divide."""
    return list(range(0, steps, -(-steps // count)))[::-1]


@dataclass
class NetworkSettings(Settings):
    """The settings of a network without slots, which needs memory, predictor, hand and term to be null.

    Attributes:
        learns_newest_frame: whether training learns only the newest frame of each window.
        carries_state: whether training can carry the network's state from step to step (`rollout=streams`).
        kinematic: the option of `loss` with this project's loss, and the overrides that go with it; searches
            use them.
        trains_by_itself: whether the network's own loss is enough to train it (`loss=of_network`).
        release: the format of the authors' checkpoints; None if they cannot be imported.
    """

    frames: int = setting(at_least(2))  # T, the number of frames in a training window

    learns_newest_frame: ClassVar[bool] = False
    carries_state: ClassVar[bool] = False
    trains_by_itself: ClassVar[bool] = False
    release: ClassVar[Release | None] = None
    kinematic: ClassVar[str] = "kinematic normalizer.coordinates=heading"
    defaults: ClassVar = {"memory": None, "predictor": None, "hand": None}
    recipe: ClassVar = {
        "normalizer.coordinates": "world",
        "normalizer.z_scores": False,
        "evaluation.ik": "off",  # there is no position branch
    }

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        """Yield problems of config keys that do not fit the network; see Settings."""
        model, name = config["model"], config["model"]["name"]
        for slot in ("memory", "predictor", "hand", "term"):
            if config[slot] is not None:
                yield f"{slot}: must be null with model={name}, which does not have this slot"
        loss, rollout = config["loss"]["name"], config["rollout"]["name"]
        if loss == "of_network" and not cls.trains_by_itself:
            yield f"loss=of_network: must be another loss, since model={name} does not have its own loss"
        if not getattr(find_chosen_settings(config, "loss"), "complete", False):
            yield f"loss={loss}: must be a complete loss, such as the default of model={name}"
        if rollout not in ("teacher_forcing", *(["streams"] if cls.carries_state else [])):
            yield f"rollout={rollout}: must be teacher_forcing with model={name}"
        if config["evaluation"]["ik"] == "lbfgs":
            yield f"evaluation.ik=lbfgs: must be off or arms, since model={name} does not predict positions"
        for heads, width in (("heads", "width"), ("code_heads", "code_width")):
            if heads in model and model[width] % model[heads]:
                yield f"model.{heads}={model[heads]}: must be a divisor of model.{width}={model[width]}"
        if model.get("offline"):
            yield from _find_offline_conflicts(config)
        calls, steps = model.get("sampling_steps", 1), model.get("diffusion_steps", 1)
        if calls > steps:
            yield f"model.sampling_steps={calls}: must be at most model.diffusion_steps={steps}"
        needed = cls.defaults.get("prerequisite")
        if needed is None and config["prerequisite"] is not None:
            yield f"prerequisite={config['prerequisite']['name']}: must be null with model={name}"
        if needed and (config["prerequisite"] is None or config["prerequisite"]["name"] != needed):
            yield f"prerequisite: must be {needed} with model={name}"


def _find_offline_conflicts(config: Any) -> Iterator[str]:
    if list(config["evaluation"]["modes"]) != ["window"] or config["export"]["graph"] != "off":
        yield (
            "model.offline=true: needs evaluation.modes=[window] and export.graph=off, since it uses "
            "future frames"
        )
    if config["refiner"] is not None:
        yield "refiner: must be null with model.offline=true, since a refiner corrects a stream"
