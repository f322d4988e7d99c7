"""Config keys that had other names in earlier versions: `RENAMED` has them all, and what follows from it.

A run keeps what it recorded, so its config is read with the names of today (`with_present_names`). Identities
are digests of the former names (`with_former_names`), so that a new name moves no run. What a user types by a
former name is answered with its present one (`present_key`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple


class Renamed(NamedTuple):
    """A key, or a whole group, that has another name today.

    Attributes:
        now: its dotted name.
        former: its dotted name up to version 0.2; the group is that of `now`, unless the group was renamed.
        option: the option GROUP=NAME of which alone the key is; None for a key of every option.
    """

    now: str
    former: str
    option: str | None = None


GROUPS = {"frame": "normalizer", "tracking": "loggers", "tracker": "loggers"}
"""The present names of groups, by their former ones. `tracker` was a group of version 0.1."""

PARTS = ("upper_codes", "lower_codes", "upper_diffusion", "lower_diffusion", "decoder")
"""The parts of SAGE-Net that are trained before it."""

RENAMED = (
    Renamed("normalizer.z_scores", "frame.normalize"),
    Renamed("data.drawn_by", "data.weighting"),
    Renamed("loss.rotation_all", "loss.rotation", "loss=manual"),
    Renamed("loss.position_branch", "loss.position", "loss=manual"),
    Renamed("loss.velocity_lower_body", "loss.velocity", "loss=manual"),
    Renamed("loss.rotation_all", "loss.rotation", "loss=rpm"),
    Renamed("loss.world_position", "loss.position", "loss=rpm"),
    Renamed("model.noise_weight", "model.noise", "model=bodiffusion"),
    Renamed("model.bound_weight", "model.bound", "model=bodiffusion"),
    Renamed("model.divergence_weight", "model.divergence", "model=vae_hmd"),
    Renamed("model.shape_weight", "model.shape", "model=hmd_poser"),
    Renamed("model.encoder_layers", "model.layers", "model=hmd_poser"),
    Renamed("model.coarse_weight", "model.coarse", "model=avatar_jlm"),
    Renamed("model.coarse_weight", "model.coarse", "model=manikin_l"),
    Renamed("model.parts_weight", "model.parts", "model=manikin_s"),
    Renamed("model.parts_weight", "model.parts", "model=manikin_l"),
    Renamed("loss.position_from_pelvis", "loss.position", "loss=terms"),
    Renamed("optim.other_lr", "optim.rest_lr", "optim=muon"),
    *(Renamed(f"upstream.{part}.lr_drops_at", f"upstream.{part}.drops") for part in PARTS),
    *(Renamed(f"upstream.{part}.lr_drop", f"upstream.{part}.drop") for part in PARTS),
    Renamed("profile.z_scores", "profile.normalize"),
    Renamed("profile.baseline_frames", "profile.avatar_poser_frames"),
    Renamed("profile.hmd_poser_encoder_layers", "profile.hmd_poser_layers"),
)

OPTIONS = {("loss", "of_network"): "own"}
"""The former names of options, by their groups and present names."""

NETWORKS = ("avatar_jlm", "ego_poser", "hmd_poser", "manikin_l", "manikin_s", "sage", "vae_hmd")
"""The networks whose loss of the same name is the option `loss=terms` with other weights."""

KINDS = {
    **{f"loss={name}": "terms" for name in (*NETWORKS, "calm", "kinematic")},
    **{f"model={name}": "terms" for name in (*NETWORKS, "recurrent_poser")},
    "model=rpm": "rpm",
}
"""Of overrides GROUP=NAME, the loss whose keys they bring, where it is not NAME."""

SIGNS = "+~"
"""What an override may begin with, to add a key or to remove it."""


def with_present_names(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a recorded config, or some of its groups, with the names that keys and options have today."""
    tree = {GROUPS.get(group, group): content for group, content in config.items()}
    for one in RENAMED:
        group = one.now.partition(".")[0]
        content = tree.get(group)
        if isinstance(content, Mapping) and _has(content, one.option):
            tree[group] = _with_name(content, one.former.split(".")[1:], one.now.rpartition(".")[2])
    for (group, now), former in OPTIONS.items():
        content = tree.get(group)
        if isinstance(content, Mapping) and content.get("name") == former:
            tree[group] = {**content, "name": now}
    return tree


def _with_name(tree: Mapping[str, Any], path: Sequence[str], now: str) -> Mapping[str, Any]:
    """Return a tree whose key at a path has another name; the same tree if there is no such key."""
    name, *below = path
    if name not in tree:
        return tree
    if below:
        inner = tree[name]
        return {**tree, name: _with_name(inner, below, now)} if isinstance(inner, Mapping) else tree
    return {now if key == name else key: value for key, value in tree.items()}


def _has(content: Mapping[str, Any], option: str | None) -> bool:
    """Return whether a group's content is that of an option GROUP=NAME; None stands for any."""
    return option is None or option.partition("=")[2] == content.get("name")


def with_former_names(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a flat config by their former dotted keys, under which identities count them."""
    options = {(f"{group}.name", now): former for (group, now), former in OPTIONS.items()}
    return {
        _former_key(key, flat): options.get((key, value), value) if isinstance(value, str) else value
        for key, value in flat.items()
    }


def _former_key(key: str, flat: Mapping[str, Any]) -> str:
    group, dot, rest = key.partition(".")
    option = _option_of(key, flat)
    named = (one.former for one in RENAMED if key == one.now and one.option in (None, option))
    return next(named, _former_group(group) + dot + rest)


def _option_of(key: str, flat: Mapping[str, Any]) -> str:
    """Return the option GROUP=NAME of a key's group, with `flat` for the names of groups' options."""
    group = key.partition(".")[0]
    return f"{group}={flat.get(f'{group}.name')}"


def _former_group(group: str) -> str:
    return next((former for former, now in GROUPS.items() if now == group), group)


def former_option(group: str, name: str | None) -> str | None:
    """Return the name under which an option of a group counts in identities."""
    return OPTIONS.get((group, name or ""), name)


def with_present_keys(overrides: Sequence[str], beside: Sequence[str] = ()) -> tuple[str, ...]:
    """Return recorded overrides KEY=VALUE with the names of today.

    Args:
        overrides: the overrides.
        beside: others that hold for the same runs; they may choose the option that a key belongs to.
    """
    options = _options((*beside, *overrides))
    return tuple(_present_override(word, options) for word in overrides)


def _options(overrides: Sequence[str]) -> dict[str, str]:
    """Return what GROUP.name is with overrides; a loss that is chosen goes before that of the network."""
    words = (word.lstrip(SIGNS).partition("=") for word in overrides)
    chosen = {key: value for key, _, value in words if "." not in key}
    options = {f"{group}.name": name for group, name in chosen.items()}
    with_keys = (group for group in ("loss", "model") if group in chosen)
    loss = next((KINDS.get(f"{group}={chosen[group]}") for group in with_keys), None)
    return options | ({"loss.name": loss} if loss else {})


def _present_override(word: str, options: Mapping[str, str]) -> str:
    signs, key, equals, value = _parts(word)
    group, dot, rest = key.partition(".")
    of_it = (
        one.now for one in RENAMED if one.former == key and one.option in (None, _option_of(key, options))
    )
    now = next(of_it, GROUPS.get(group, group) + dot + rest)
    return f"{signs}{now}{equals}{present_option(key, value) or value}"


def with_former_keys(overrides: Sequence[str], beside: Sequence[str] = ()) -> tuple[str, ...]:
    """Return overrides KEY=VALUE with the former names, by which a sweep's folder is called.

    Args:
        overrides: the overrides.
        beside: others that hold for the same runs; they may choose the option that a key belongs to.
    """
    options = _options((*beside, *overrides))
    return tuple(_former_override(word, options) for word in overrides)


def _former_override(word: str, options: Mapping[str, str]) -> str:
    signs, key, equals, value = _parts(word)
    return f"{signs}{_former_key(key, options)}{equals}{former_option(key, value)}"


def _parts(word: str) -> tuple[str, str, str, str]:
    """Return an override's signs (+, ~), key, = and value; the last two are empty without an =."""
    bare = word.lstrip(SIGNS)
    return word[: len(word) - len(bare)], *bare.partition("=")


def present_key(key: str, allowed: Sequence[str]) -> str | None:
    """Return the present name of a dotted key that its group does not have; None if it never had it.

    Args:
        key: the key, as a user gave it.
        allowed: the keys that its group has, or the groups for a group itself.
    """
    group, dot, rest = key.partition(".")
    named = GROUPS.get(group)
    if not dot:
        return named
    found = (one.now for one in RENAMED if one.former in (key, f"{_former_group(group)}.{rest}"))
    now = next((name for name in found if name.rpartition(".")[2] in allowed), None)
    return now or (f"{named}.{rest}" if named else None)


def present_option(group: str, former: str) -> str | None:
    """Return the present name of an option of a group; None if `former` is no former name there."""
    return next((now for (slot, now), name in OPTIONS.items() if (slot, name) == (group, former)), None)
