"""Builds the objects that a composed config describes."""

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memmlp.common.components import (
    SLOTS,
    Component,
    collect_components,
    find_chosen_settings,
    find_component,
)
from memmlp.common.errors import InputError, is_interruption
from memmlp.common.overrides import flatten, format_value
from memmlp.common.text_formats import escape_interpolations, make_override
from memmlp.config import plugins
from memmlp.config.build_request import build_request, read_source_weights
from memmlp.config.check import check
from memmlp.config.compose import compose_config, compose_unchecked, convert_errors, merge_override
from memmlp.config.schema import restore_config
from memmlp.deploy.deployment import Deployment
from memmlp.evaluation.ik import IK, LBFGS, Arms, NoIK
from memmlp.evaluation.metric_facts import METRIC_SETS
from memmlp.evaluation.metrics import UserMetric
from memmlp.evaluation.modes import Evaluation
from memmlp.motion.body import make_builtin_rest_joints
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.architectures import Architecture
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.vqvae import VQVAE
from memmlp.runs.identity import NETWORK, VQVAE_SHAPE, find_option, select_training_config
from memmlp.runs.loggers.logger import RunLogger
from memmlp.runs.lookup import (
    check_trained,
    describe_kind,
    find_outputs,
    find_shipped_clip,
    get_shipped_name,
)
from memmlp.runs.run import Run
from memmlp.training.devices import choose_device
from memmlp.training.losses import Loss, MotionLoss, Term
from memmlp.training.optim import Optim, make_vqvae_optim
from memmlp.training.run_stages import Experiment
from memmlp.training.train_network import NetworkTraining, Training, VQVAETraining, WeightsImport
from memmlp.training.train_refiner import RefinerTraining


def build_experiment(cfg: DictConfig, remote: bool = False) -> Experiment:
    """Build the experiment of a checked config. With `remote`, the device may be missing here. Raises
    InputError if the device, or the code of a custom component, is missing."""
    unrefined = None
    if cfg.refiner is not None and not cfg.imported_weights:
        bare = cfg.copy()
        bare.refiner, bare.force, bare.save_predictions = None, False, None
        unrefined = build_experiment(bare, remote)
    request = build_request(cfg)
    metrics = build_metrics(cfg.evaluation.metrics)
    return Experiment(
        config=request.config,
        motion=request.motion,
        device=torch.device("cpu") if remote else choose_device(cfg.device),
        architecture=build_architecture(cfg),
        prerequisites=build_prerequisites(cfg, request.config),
        training=build_training(cfg, metrics),
        evaluation=Evaluation(
            modes=list(cfg.evaluation.modes),
            batch=cfg.evaluation.batch,
            ik=build_ik(cfg),
            seed=cfg.seed,
            metrics=metrics,
            metric_set=METRIC_SETS.get(cfg.evaluation.metric_set),
        ),
        deployment=build_deployment(cfg),
        loggers=build_loggers(cfg),
        make_name=make_readable_name,
        unrefined=unrefined,
    )


def build_prerequisites(cfg: DictConfig, config: dict[str, Any]) -> tuple[Training, ...]:
    """Build the trainings of the prerequisite runs, in order, that a checked config (also given as plain
    dictionaries) needs. A refiner needs only the run of its network."""
    if cfg.refiner is not None or cfg.imported_weights:
        return ()
    if cfg.prerequisite is not None:
        training = build_training(cfg, {})
        assert isinstance(training, NetworkTraining)
        return tuple(build(cfg, "prerequisite").trainings(config, training))
    if getattr(find_chosen_settings(cfg, "memory"), "codes", "") != "frozen":
        return ()
    optim = partial(build_vqvae_optim, cfg)
    return (VQVAETraining(seed=cfg.vqvae.seed, optim=optim, mirror=cfg.data.mirror),)


def build_training(cfg: DictConfig, metrics: dict[str, UserMetric]) -> NetworkTraining | RefinerTraining:
    """Build the training of a checked config's refiner, or of its network if it has no refiner."""
    common = {"seed": cfg.seed, "optim": build(cfg, "optim"), "drawn_by": cfg.data.drawn_by}
    common |= {"shares": read_source_weights(cfg.data), "mirror": cfg.data.mirror, "metrics": metrics}
    if cfg.refiner is not None and not cfg.imported_weights:
        refiner = _make_settings(cfg, "refiner")
        return RefinerTraining(refiner=refiner, **common | {"optim": common["optim"].with_lr(refiner.lr)})
    kind = WeightsImport if cfg.imported_weights else NetworkTraining
    return kind(loss=build_loss(cfg), rollout=build(cfg, "rollout"), **common)


def build_untrained(overrides: Sequence[str]) -> MotionModel:
    """Build the network that overrides configure, with random weights, for the built-in body."""
    architecture = build_architecture(compose_config(list(overrides)))
    torch.manual_seed(0)
    codes = architecture.vqvae() if architecture.uses_codes else None
    rest = torch.as_tensor(make_builtin_rest_joints())
    normalizer = Normalizer.from_coordinates(architecture.coordinates, rest)
    return architecture.build(normalizer, codes).eval()


def build_loggers(cfg: DictConfig) -> tuple[RunLogger, ...]:
    """Build the loggers of a config, such as TensorBoard."""
    outputs = Path(cfg.paths.outputs)
    nodes = _convert_to_dict(cfg.loggers).items()
    return tuple(find_component("loggers", name).build(node, outputs=outputs) for name, node in nodes)


def build(cfg: DictConfig, slot: str) -> Any:
    """Build the component in a slot of a checked config. Raises InputError if its class rejects the keys."""
    component, keys = _read_component(cfg, slot)
    try:
        return component.build(keys)
    except TypeError as error:
        raise InputError(f"{slot}={component.name}: cannot be built: {error}") from error


def _read_component(cfg: DictConfig, slot: str) -> tuple[Component, dict[str, Any]]:
    keys = _convert_to_dict(cfg[slot])
    return find_component(slot, keys["name"]), keys


def _make_settings(cfg: DictConfig, slot: str) -> Any:
    component, keys = _read_component(cfg, slot)
    return component.make_settings(keys)


def _convert_to_dict(node: DictConfig) -> dict[str, Any]:
    return OmegaConf.to_container(node, resolve=True)  # type: ignore[return-value]


def build_architecture(cfg: DictConfig) -> Architecture:
    """Build the architecture of a checked config, which makes and loads the network."""
    vqvae = partial(VQVAE, **{name: cfg.vqvae[name] for name in VQVAE_SHAPE})
    coordinates = find_component("coordinates", cfg.normalizer.coordinates).kind()
    refiner = _make_settings(cfg, "refiner") if cfg.refiner is not None else None
    build_network, codes = _make_network_builder(cfg, vqvae)
    return Architecture(
        coordinates=coordinates,
        normalize=cfg.normalizer.z_scores,
        raw_inputs=bool(cfg.normalizer.get("raw_inputs")),
        vqvae=vqvae,
        network=build_network,
        uses_codes=codes == "frozen",
        trained_parts=None if cfg.prerequisite is None else (),
        refiner=refiner,
    )


def _make_network_builder(
    cfg: DictConfig, vqvae: Callable[[], VQVAE]
) -> tuple[Callable[[Normalizer, VQVAE | None], MotionModel], str]:
    network, settings = find_component("model", cfg.model.name).kind, _make_settings(cfg, "model")
    if cfg.memory is None:
        return lambda normalizer, codes: network(normalizer, settings), ""
    memory, memory_keys = _read_component(cfg, "memory")
    predictor, predictor_keys = _read_component(cfg, "predictor")
    codes = getattr(memory.settings, "codes", "")
    joint = {"vqvae": vqvae} if codes == "joint" else {}
    assemble = partial(
        network.assemble,  # type: ignore[attr-defined]
        settings=settings,
        memory=partial(memory.build, memory_keys, **joint),
        predictor=partial(predictor.build, predictor_keys),
    )
    return assemble, codes


def build_metrics(names: Iterable[str]) -> dict[str, UserMetric]:
    """Build the custom metrics with these names."""
    components: dict[str, Any] = {name: find_component("metric", name) for name in names}
    return {name: UserMetric(metric.kind, metric.settings.of) for name, metric in components.items()}


def build_loss(cfg: DictConfig) -> Callable[[frozenset[str]], Loss]:
    """Return a function that builds the loss for a network's branches. Mem-MLP's combines a weighting, a hand
    term and a custom term for these branches; a complete loss ignores them. Raises InputError if a custom
    term is combined with a complete loss, or needs a branch that the predictor does not have."""
    loss = build(cfg, "loss")
    if isinstance(loss, Loss):
        if cfg.term is not None:
            raise InputError(f"term={cfg.term.name}: must be null with the complete loss={cfg.loss.name}")
        return lambda branches: loss
    term = build(cfg, "term") if cfg.term is not None else Term()
    branches = find_component("predictor", cfg.predictor.name).kind.branches  # type: ignore[attr-defined]
    if cfg.term is not None and term.branch not in branches:
        raise InputError(
            f"term={cfg.term.name}: needs the {term.branch} branch, but predictor={cfg.predictor.name} has "
            f"only {' and '.join(branches)}"
        )
    return partial(MotionLoss, loss, build(cfg, "hand"), term=term)


def build_deployment(cfg: DictConfig) -> Deployment | None:
    """Build the deployment of a checked config; None with export.graph=off."""
    return None if cfg.export.graph == "off" else Deployment(**cfg.export)


def build_ik(cfg: DictConfig) -> IK:
    """Build the inverse kinematics of a checked config."""
    solvers: dict[str, IK] = {"off": NoIK(), "lbfgs": LBFGS(cfg.evaluation.ik_iterations), "arms": Arms()}
    return solvers[cfg.evaluation.ik]


def build_vqvae_optim(cfg: DictConfig, frames: int) -> Optim:
    """Build the optimisation of the VQ-VAE. An epoch has `frames` frames."""
    vqvae = cfg.vqvae
    keys = {name: vqvae[name] for name in ("batch", "lr", "weight_decay")}
    keys |= {name: cfg.optim[name] for name in ("checkpoint_every", "log_every")}
    return make_vqvae_optim(vqvae.steps or math.ceil(vqvae.epochs * frames / vqvae.batch), **keys)


def load_config(run: Run, overrides: Sequence[str] = (), outputs: Path | None = None) -> DictConfig:
    """Return the typed and checked config of a finished run of a motion network, with these overrides
    KEY=VALUE. A recorded config never decides where a command writes: `outputs` is by default the folder that
    contains the run. Raises InputError for an unfinished run, a config that this version cannot read, an
    invalid override, or a package with custom components that is not in use."""
    check_trained(run)
    plugins.activate(plugins.find_named_packages(overrides))
    plugins.check_allowed(run.config, run.manifest.get("plugins") or {}, f"run {run.id}")
    try:
        cfg = restore_config(run.config)
    except (OmegaConfBaseException, KeyError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{run.config_path}: this version cannot read the config ({reason})") from None
    _use_outputs(cfg, outputs or find_outputs(run))
    if get_shipped_name(run) and not Path(str(cfg.data.root)).exists():
        cfg.data.root = escape_interpolations(str(find_shipped_clip().parent))
    for word in overrides:
        _apply_override(cfg, word)
    check(cfg)
    return cfg


def _use_outputs(cfg: DictConfig, outputs: Path) -> None:
    """Replace the recorded places to write to: outputs, synthetic motion, predictions and loggers. Recorded
    motion below the recorded outputs is expected at the same place below `outputs`, if it is there."""
    recorded, cfg.paths.outputs = cfg.paths.outputs, escape_interpolations(str(outputs))
    cfg.force, cfg.save_predictions, cfg.loggers = False, None, {}

    def move(path: Any) -> str | None:
        path = Path(str(path))
        if not path.is_relative_to(recorded) or ".." in path.parts:
            return None
        return escape_interpolations(str(outputs / path.relative_to(recorded)))

    if cfg.data.synth is not None:
        cfg.data.root = move(cfg.data.root) or escape_interpolations(str(outputs / "data" / "synth"))
    for data in (cfg.data, *(cfg.data.get("sources") or {}).values()):
        before = data.root
        if moved := move(before):
            data.root = moved
            data.root = moved if Path(data.root).exists() else escape_interpolations(before)


def _apply_override(cfg: DictConfig, word: str) -> None:
    if "=" not in word or word.startswith(("+", "~")):
        raise InputError(f"{word}: must be KEY=VALUE")
    with convert_errors([word]):
        (override,) = OverridesParser.create().parse_overrides([word])
        if override.is_sweep_override():
            raise InputError(f"{word}: must be a single value, or a list in brackets: [A,B]")
        merge_override(cfg, override)


MAX_WORDS = 6
SEPARATOR = " · "
SET_BY_MODELS = ("ema",)
"""Keys of a profile that models set. They are omitted, because the groups that use them show the value."""


def make_readable_name(kind: str, config: Mapping[str, Any]) -> str:
    """Return a readable name for a run of this kind (see `Identity`) and resolved config: the options, and
    values of other keys, that differ from the defaults and affect results. Data is omitted."""
    words = [] if kind == NETWORK else [describe_kind(kind)]
    words += ["published weights"] if config.get("imported_weights") else []
    try:
        words += _list_differences(config)
    except (InputError, HydraException, OmegaConfBaseException) as error:  # a run must not fail by its name
        if is_interruption(error):
            raise
        words.append("own config")
    if len(words) > MAX_WORDS:
        words = [*words[:MAX_WORDS], f"{len(words) - MAX_WORDS} more"]
    seed = config.get("seed", (config.get("vqvae") or {}).get("seed"))
    return SEPARATOR.join([*(words or ["default"]), f"seed {seed}"])


def _list_differences(config: Mapping[str, Any]) -> Iterator[str]:
    """Yield the profile, slots and keys that differ from `memmlp train` without overrides."""
    chosen: list[str] = []
    if profile := config.get("profile"):
        sizes = f"profile={profile['sizes']}"
        usual = _compose_default((sizes,))["profile"]
        changed = [key for key in profile if key not in SET_BY_MODELS and profile[key] != usual.get(key)]
        chosen = [sizes, *(f"profile.{key}={format_value(profile[key])}" for key in changed)]
        yield from chosen[profile["sizes"] == "small" :]
    named = [slot for slot in SLOTS if slot in config and (config[slot] is None or "name" in config[slot])]
    options = {slot: find_option(config, slot) for slot in named}
    custom = [slot for slot, option in options.items() if option and not _is_shipped(slot, option)]
    for is_model in (True, False):  # a model may set options of other slots
        default = _compose_default(tuple(chosen))
        slots = [slot for slot in options if (slot == "model") == is_model]
        changed = [slot for slot in slots if options[slot] != find_option(default, slot)]
        yield from (f"{slot}={options[slot] or 'none'}" for slot in changed)
        chosen += [
            f"{slot}={options[slot]}" if options[slot] else f"~{slot}"
            for slot in changed
            if slot not in custom
        ]
    default = _compose_default(tuple(chosen))
    own, usual = flatten(config), {"data.drawn_by": "frames", "data.mirror": False} | flatten(default)
    counting = select_training_config(config) | select_training_config(default)  # a key may count in one only
    for key in counting:
        group, _, last = key.partition(".")
        unnamed = group in (*custom, "profile") or last == "name"
        if unnamed or key in ("seed", "vqvae.seed", "imported_weights"):
            continue
        if key in own and own[key] != usual.get(key):
            yield f"{key}={format_value(own[key])}"


def list_overrides(config: Mapping[str, Any]) -> list[str]:
    """Return the overrides with which `memmlp train` composes a recorded config of a network again, except
    loggers and other keys without an effect on results. Raises InputError if there are none."""
    own = flatten({key: value for key, value in config.items() if key not in NOT_REPEATED})
    plugins = [f"plugins={format_value(config['plugins'])}"] if config.get("plugins") else []
    if missing := [key for key in ("data", "model", "profile") if key not in config]:
        raise InputError(f"{missing[0]}: is not in the run's config; this version cannot compose it")
    words = [*plugins, f"data={config['data']['name']}"]
    if "data.root" in own and config["data"]["name"] != "synth":  # recorded data has no default folder
        words.append(_make_repeated("data.root", own["data.root"]))
    words.append(f"profile={config['profile']['sizes']}")
    options = {slot: find_option(config, slot) for slot in SLOTS if slot in config}
    for slots in (["model"], [slot for slot in options if slot != "model"]):  # a model sets other slots
        default = _compose_plain(words)
        changed = [slot for slot in slots if options[slot] != find_option(default, slot)]
        words += [f"{slot}={options[slot] or 'null'}" for slot in changed]
    for _ in range(3):  # a value may follow from another one
        usual = flatten(_compose_plain(words))
        words += [_make_repeated(key, value) for key, value in own.items() if usual.get(key) != value]
    before, after = select_training_config(config), select_training_config(_compose_plain(words))
    if differing := [key for key in before | after if before.get(key) != after.get(key)]:
        raise InputError(f"{differing[0]}: overrides cannot set this value of the run")
    return words


NOT_REPEATED = ("loggers", "force", "save_predictions", "plugins", "imported_weights")


def _make_repeated(key: str, value: Any) -> str:
    return make_override(key, value) if isinstance(value, str) else f"{key}={format_value(value)}"


def _compose_plain(words: Sequence[str]) -> dict[str, Any]:
    return cast(dict[str, Any], OmegaConf.to_container(compose_config(words), resolve=True))


def _is_shipped(slot: str, option: str) -> bool:
    found = collect_components().get((slot, option))
    return found is not None and found.package == "memmlp"


@functools.lru_cache(maxsize=64)
def _compose_default(overrides: tuple[str, ...]) -> dict[str, Any]:
    """Return the config of `memmlp train` with these overrides, without groups that names omit."""
    hydra = GlobalHydra.instance()
    before, hydra.hydra = hydra.hydra, None
    try:
        cfg = compose_unchecked(overrides)
    finally:
        GlobalHydra.instance().hydra = before
    groups = {str(key): cfg[key] for key in cfg if key not in ("data", "paths", "loggers")}
    return {
        key: OmegaConf.to_container(group, resolve=True) if OmegaConf.is_config(group) else group
        for key, group in groups.items()
    }
