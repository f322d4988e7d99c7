"""Config keys under whose former names ids are computed, so that a new name changes no id."""

from __future__ import annotations

from collections.abc import Mapping
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
