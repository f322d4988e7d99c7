"""The keys of `memmlp train`'s config, with types and limits. Components declare their own keys."""

import functools
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from omegaconf import DictConfig, OmegaConf

from memmlp.common.components import SLOTS, find_component, list_component_names
from memmlp.common.settings import (
    DEVICE,
    PRECISIONS,
    SIZES,
    Rule,
    Settings,
    at_least,
    each,
    existing,
    existing_clip_folders,
    fraction,
    group,
    matching,
    one_of,
    positive,
    seed,
    setting,
    text,
    within,
)
from memmlp.common.text_formats import escape_interpolations
from memmlp.evaluation.metric_facts import METRIC_SETS


@dataclass
class SplitConfig:
    """The keys of all splits except the split by person."""

    name: str = setting(text())  # the kind of split: seeded, lists or subsets
    val: float = setting(fraction())
    seed: int = setting(at_least(0), 0)
    groups: list[str] = setting(each(empty=True))
    groups_file: str | None = setting(existing("file"), None)
    train_fraction: float = setting(fraction(), 1.0)


@dataclass
class SeededSplitConfig(SplitConfig):
    name: str = setting(one_of("seeded"), "seeded")
    test: float = setting(fraction())
    per_group: int | None = setting(at_least(1), None)
    divide: str = setting(one_of("groups", "clips"), "groups")


@dataclass
class ListSplitConfig(SplitConfig):
    name: str = setting(one_of("lists"), "lists")
    folder: str = setting(existing("folder"))


@dataclass
class SubsetSplitConfig(SplitConfig):
    name: str = setting(one_of("subsets"), "subsets")
    train: list[str] = setting(each())
    test: list[str] = setting(each())


@dataclass
class KindConfig:
    """Persons with the same kind of motion, and the numbers of test and validation persons."""

    persons: list[str] = setting(each())
    test: int = setting(at_least(0))
    val: int = setting(at_least(0))


@dataclass
class PersonSplitConfig:
    """A split by person."""

    name: str = setting(one_of("persons"), "persons")
    persons: dict[str, str | None] = field(default_factory=dict)
    kinds: dict[str, KindConfig] = field(default_factory=dict)
    seed: int = setting(at_least(0), 0)


@dataclass
class DataConfig:
    """The keys of all options of conf/data. Each option adds the folder of the motion and the split."""

    name: str = setting(text())
    body: str = setting(existing("file", "builtin"))
    min_frames: int = setting(at_least(2))
    strict: bool = setting()
    interpolation: str = setting(one_of("splines", "lines"), "lines")
    drawn_by: str = setting(one_of("frames", "clips", "groups"))
    mirror: bool = setting(default=False)


@dataclass
class SynthDataConfig(DataConfig):
    root: str = setting(text())
    synth: Settings | None = None  # settings of the motion generator
    split: SeededSplitConfig = group(SeededSplitConfig)


@dataclass
class SourceConfig:
    """A motion folder, if the data has several."""

    root: str = setting(existing("folder"))
    groups: list[str] = setting(each(empty=True), [])
    groups_file: str | None = setting(existing("file"), None)
    weight: float | None = setting(positive(), None)
    test: float | None = setting(fraction(), None)
    val: float | None = setting(fraction(), None)


@dataclass
class SeededDataConfig(DataConfig):
    root: Any = setting(existing_clip_folders())
    sources: dict[str, SourceConfig] = field(default_factory=dict)
    synth: Settings | None = None
    split: SeededSplitConfig = group(SeededSplitConfig)


@dataclass
class ListDataConfig(DataConfig):
    root: str = setting(existing("folder"))
    synth: Settings | None = None
    partial: bool = False
    split: Any = group(ListSplitConfig)


@dataclass
class SubsetDataConfig(ListDataConfig):
    split: Any = group(SubsetSplitConfig)


@dataclass
class PersonDataConfig(ListDataConfig):
    split: Any = group(PersonSplitConfig)


@dataclass
class PathsConfig:
    """The folder of runs, caches and sweeps."""

    outputs: str = setting(text())


@dataclass
class ProfileConfig:
    """The scale of networks and trainings (tests, a CPU, a GPU), which sets the defaults of all other groups.

    Components declare their sizes for each scale. Each size can be overridden in its own group.
    """

    sizes: str = setting(one_of(*SIZES))  # the size of every component: tiny, small or paper
    # literal: follows the paper's text exactly
    reading: str = setting(one_of("default", "literal"), "default")
    # the width of the hidden states of Mem-MLP and AGRoL; the memory's width is proportional to it. null: the
    # width that `sizes` sets
    width: int | None = setting(at_least(1), None)
    # factor on the network's declared widths: width, code_width and feedforward of model and memory
    scale: float = setting(positive(), 1.0)
    synth_minutes: float | None = setting(positive(), None)
    steps: int = setting(at_least(1))
    batch: int = setting(at_least(1))
    lr: float = setting(positive())
    final_lr: float = setting(at_least(0))
    schedule: str = setting(one_of("step", "cosine"))
    ema: float | None = setting(within(0, 1, strict=True), None)
    checkpoint_every: int = setting(at_least(1))
    validate_every: int = setting(at_least(1))
    log_every: int = setting(at_least(1))
    evaluation_batch: int = setting(at_least(1))
    latency_steps: int = setting(at_least(1))


COORDINATES = Rule(
    "heading, head_relative or world, or coordinates that a plugin declares",
    lambda value: value in list_component_names("coordinates"),
)
METRIC = Rule(
    "one of the metrics that plugins=[NAME] declare", lambda value: value in list_component_names("metric")
)


@dataclass
class NormalizerConfig:
    """The coordinates and the normalisation of the network's inputs and outputs.

    The paper mentions neither. Both reduced the errors in our measurements.
    """

    # heading: rotated by the head's heading; head_relative: horizontal positions relative to the head; world:
    # world coordinates (docs/readings.md, no. 20)
    coordinates: str = setting(COORDINATES, "heading", literal="world")
    # true: normalise by mean and deviation of the training clips (docs/readings.md, no. 20)
    z_scores: bool = setting(None, True, literal=False)
    # true: inputs are not normalised, only the motion; null or false: both are
    raw_inputs: bool | None = setting(None, None)


@dataclass
class VQVAEConfig:
    """The VQ-VAE, which provides the memory's code-vectors (App. A; docs/readings.md, no. 5).

    It is trained in a separate stage, then frozen. Exactly one of `epochs` and `steps` is set. An epoch has
    each training frame once; data.drawn_by and the sources' weights apply only to windows.
    """

    codes: int = setting(at_least(1), tiny=8, small=64, paper=64)  # K, the number of code-vectors
    width: int = setting(at_least(1), tiny=16, small=128, paper=256)  # the width of latents and code-vectors
    encoder_depth: int = setting(at_least(0), 4)  # L_enc, the number of encoder blocks
    decoder_depth: int = setting(at_least(0), 1)  # L_dec, the number of decoder blocks
    commitment: float = setting(at_least(0), 0.25)  # the weight of the commitment loss
    # the decay of the running means with codebook: ema
    decay: float = setting(within(0, 1, strict=True), 0.99)
    # ema: codes are running means; gradient: the loss trains the codes, as in the paper, which tends to
    # collapse
    codebook: str = setting(one_of("ema", "gradient"), "ema")
    seed: int = setting(seed(), "${seed}")  # a fixed number makes all runs share one VQ-VAE
    # the training length in epochs over the training frames; null: `steps` sets the length
    epochs: float | None = setting(positive(), tiny=None, small=None, paper=100)
    steps: int | None = setting(at_least(1), tiny=20, small=2000, paper=None)  # the training length in steps
    batch: int = setting(at_least(1), tiny=32, small=256, paper=256)  # number of frames per step
    # the initial learning rate; it is multiplied by 0.2 at 20, 50 and 70 % of the steps
    lr: float = setting(positive(), tiny=1e-3, small=1e-3, paper=1e-4)
    weight_decay: float = setting(at_least(0), 1e-4)


@dataclass
class EvaluationConfig:
    """The evaluation of a trained network on the test clips."""

    # window: windows that do not overlap; stream: one frame at a time, with the network's own predictions as
    # history (docs/readings.md, no. 21)
    modes: list[str] = setting(each(one_of("window", "stream"), empty=True), ["window", "stream"])
    batch: int = setting(at_least(1), "${profile.evaluation_batch}")  # number of clips per batch
    # lbfgs: adds the result "combined", rotations fitted to the position branch (Table 6; docs/readings.md,
    # no. 11); arms: moves the hands to their trackers
    ik: str = setting(one_of("off", "lbfgs", "arms"), "off", literal="lbfgs")
    ik_iterations: int = setting(at_least(1), 15)  # maximum number of lbfgs iterations per frame (App. A)
    # paths of custom metrics (docs/guides/components.md)
    metrics: list[str] = setting(each(METRIC, empty=True), [])
    # the repository whose released test is measured, too, as the branch "authors"
    # (docs/guides/published-weights.md)
    metric_set: str | None = setting(one_of(*METRIC_SETS), None)


@dataclass
class ExportConfig:
    """The deployment of a trained network: ONNX export and timing."""

    # number of timed steps after a warm-up
    latency_steps: int = setting(at_least(1), "${profile.latency_steps}")
    # streaming: computes each frame's features once; naive: the network as trained; auto: streaming if
    # available, otherwise naive; off: no export
    graph: str = setting(one_of("auto", "streaming", "naive", "off"), "auto")
    # int8 and fp16 write an additional file beside the float32 file. memmlp live uses int8 if MPJPE grows by
    # at most 1 % and Jitter by at most 10 %
    precision: str = setting(one_of(*PRECISIONS), "fp32")
    alone: bool = setting(default=False)  # true: also time only the network, as papers do (Table 17)
    # the operator set of the ONNX files; older inference engines need 15
    opset: int = setting(within(15, 26), 18)


@dataclass
class Config:
    """The complete config of `memmlp train`."""

    seed: int = setting(seed())
    device: str = setting(DEVICE)
    threads: int = setting(at_least(0))
    force: bool = setting()
    plugins: list[str] = setting(each(empty=True), [])
    save_predictions: str | None = setting()
    # the start of the SHA-256 of published weights; only memmlp import-weights sets it
    imported_weights: str | None = setting(matching(r"[0-9a-f]{16}", "16 hex digits, or null"), None)
    paths: PathsConfig = group(PathsConfig)
    profile: ProfileConfig = group(ProfileConfig)
    data: DataConfig = group(DataConfig)
    normalizer: NormalizerConfig = group(NormalizerConfig)
    model: Settings = group(Settings)
    memory: Settings | None = None
    predictor: Settings | None = None
    vqvae: VQVAEConfig = group(VQVAEConfig)
    rollout: Settings = group(Settings)
    loss: Settings = group(Settings)
    hand: Settings | None = None
    term: Settings | None = None
    refiner: Settings | None = None
    prerequisite: Settings | None = None
    optim: Settings = group(Settings)
    evaluation: EvaluationConfig = group(EvaluationConfig)
    export: ExportConfig = group(ExportConfig)
    loggers: dict[str, Settings] = field(default_factory=dict)


SCHEMAS: dict[str, type] = {
    "config": Config,
    "profile": ProfileConfig,
    "data_synth": SynthDataConfig,
    "data_seeded": SeededDataConfig,
    "data_lists": ListDataConfig,
    "data_subsets": SubsetDataConfig,
    "data_persons": PersonDataConfig,
}
"""The schemas that config files in conf/ can include as /schema/NAME."""

ONLY = {
    "normalizer": NormalizerConfig,
    "vqvae": VQVAEConfig,
    "evaluation": EvaluationConfig,
    "export": ExportConfig,
}
"""The groups with a single option, `default`."""


def make_typed(schema: Any) -> Any:
    """Return the typed config of a schema. Unpickling is quicker than OmegaConf's way from a dataclass."""
    return pickle.loads(_pickle_typed(schema))


@functools.lru_cache(maxsize=256)
def _pickle_typed(schema: Any) -> bytes:
    return pickle.dumps(OmegaConf.structured(schema))


def restore_config(config: Mapping[str, Any]) -> DictConfig:
    """Convert a run's recorded config to a typed config. Raises InputError for an unknown component, and
    OmegaConfBaseException, KeyError, TypeError or ValueError if it does not match this version's schema."""
    cfg = make_typed(Config)
    for key, content in escape_interpolations(config).items():
        if not isinstance(content, Mapping):
            cfg[key] = content
        elif key == "loggers":
            cfg.loggers = {name: _restore_component(key, name, node) for name, node in content.items()}
        elif key == "data":
            synth = content.get("synth")
            schema = SCHEMAS["data_synth" if synth else f"data_{content['split']['name']}"]
            cfg.data = OmegaConf.merge(make_typed(schema), {**content, "synth": None})
            if synth:
                cfg.data.synth = _restore_component("generator", synth["name"], synth)
        elif key in SLOTS:
            cfg[key] = _restore_component(key, content["name"], content)
        else:
            cfg[key] = OmegaConf.merge(cfg[key], content)
    return cfg


def _restore_component(slot: str, name: str, content: Mapping[str, Any]) -> Any:
    return OmegaConf.merge(make_typed(find_component(slot, name).settings), content)
