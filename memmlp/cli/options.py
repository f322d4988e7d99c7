"""Command-line options and parameter types that several commands share."""

import math
import os
from collections.abc import Callable
from ipaddress import IPv4Network
from pathlib import Path
from typing import Any

import click

from memmlp.common.overrides import notify_repeats
from memmlp.common.settings import DEVICE
from memmlp.config.plugins import activate, search_folder, split_names
from memmlp.runs.lookup import count_training_frames, find_run, warn_if_hardly_trained
from memmlp.runs.run import Run

Command = Callable[..., Any]
PORT = click.IntRange(1, 65535)


class HomePath(click.Path):
    """A path; ~ at its start is the home folder, also where the shell does not expand it."""

    def __init__(self, **options: Any) -> None:
        super().__init__(path_type=Path, **options)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return super().convert(os.path.expanduser(value), param, ctx)


PATH = HomePath()


class FiniteFloat(click.FloatRange):
    """A number in a range, without NaN and infinity, which click would accept."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} must be a finite number", param, ctx)
        return number


class DeviceName(click.ParamType):
    """A device name with the syntax of the key `device`. The device may not exist."""

    name = "auto|cpu|cuda|cuda:INDEX|mps"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if not DEVICE.allows(value):
            self.fail(f"{value}: must be {DEVICE.words}")
        return value


device_option = click.option(
    "--device",
    default="auto",
    type=DeviceName(),
    help="Device to compute on; auto selects a CUDA GPU if available.",
)


class TargetAddress(click.ParamType):
    """The address of a program that receives datagrams: HOST, or HOST:PORT; as host, and port or None."""

    name = "HOST[:PORT]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if isinstance(value, tuple):
            return value
        host, colon, port = value.rpartition(":")
        if not colon or value.endswith("]") or ("]" not in value and ":" in host):  # a name, or IPv6
            return value.strip("[]"), None
        return host.strip("[]"), PORT.convert(port, param, ctx)


class SenderNetwork(click.ParamType):
    """An IPv4 address, or a network of addresses such as 192.168.1.0/24."""

    name = "ADDRESS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return IPv4Network(value, strict=False)
        except ValueError as error:
            self.fail(f"{value}: {error}; expected an IPv4 address, or a network such as 192.168.1.0/24")


def _notify_repeats(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> tuple[str, ...]:
    notify_repeats(value)
    return value


overrides_argument = click.argument("overrides", nargs=-1, callback=_notify_repeats)

outputs_option = click.option(
    "--outputs",
    type=PATH,
    default=Path("outputs"),
    envvar="MEMMLP_OUTPUTS",
    help="Folder of the runs and data caches.",
)
source_option = click.option(
    "--source", help="Show only the test clips of this data source.  [default: all sources together]"
)

together_option = click.option(
    "--together",
    multiple=True,
    metavar="PATTERN",
    help="Count test clips as one group if the parentheses in PATTERN match the same text in their names; "
    "repeatable.",
)

weigh_groups_option = click.option(
    "--weigh-groups",
    is_flag=True,
    help="Give each group of test clips, such as a person, the same weight instead of each clip.",
)


def add_clip_options(command: Command) -> Command:
    """Add the options that select and group test clips."""
    return source_option(together_option(weigh_groups_option(command)))


untrained_option = click.option(
    "--untrained",
    is_flag=True,
    help="Measure the costs of networks without a run, with random weights; only for Tables 16 and 17.",
)


host_option = click.option(
    "--host",
    default="127.0.0.1",
    help="Address to serve at. At addresses other than localhost, every request needs the token.",
)
token_option = click.option(
    "--token",
    help="Access token for a --host other than localhost.  [default: a new token, which is printed]",
)


def add_page_options(port: int) -> Callable[[Command], Command]:
    """Add the options of a page's server to a command; `port` is the default port."""
    limits, help_text = click.IntRange(0, 65535), "Port of the page; 0 selects a free port."
    number = click.option("--port", default=port, type=limits, help=help_text)
    browser = click.option("--no-browser", is_flag=True, help="Print the page's address; open no browser.")
    return lambda command: number(browser(host_option(token_option(command))))


def _activate_plugins(ctx: click.Context, param: click.Parameter, value: str | None) -> None:
    if not ctx.resilient_parsing:
        activate(split_names(value or ""))


def _add_config_folder(ctx: click.Context, param: click.Parameter, value: Path | None) -> None:
    if not ctx.resilient_parsing:
        ctx.with_resource(search_folder(value))


plugins_option = click.option(
    "--plugins",
    metavar="NAMES",
    callback=_activate_plugins,
    expose_value=False,
    help="Comma-separated packages with your own components; also MEMMLP_PLUGINS. Their code is run.",
)


def add_run_options(command: Command) -> Command:
    """Add the options --plugins and --outputs."""
    return plugins_option(outputs_option(command))


config_dir_option = click.option(
    "--config-dir",
    type=HomePath(file_okay=False, exists=True),
    callback=_add_config_folder,
    expose_value=False,
    help="Folder of additional configs; they can refer to your own classes.",
)

format_option = click.option(
    "--format",
    "format_",
    type=click.Choice(["bvh", "npz", "gltf"]),
    help="Format of the files.  [default: from the suffix .bvh, .npz or .glb of --out]",
)
body_option = click.option(
    "--body", default="builtin", help="Body to use: builtin, or the path of an SMPL-H model.npz."
)
strict_option = click.option("--strict", is_flag=True, help="Stop at the first bad file; do not skip it.")


def check_runs_exist(outputs: Path, *names: str) -> None:
    """Raise InputError for an unknown run, before slow imports."""
    for name in names:
        find_run(outputs, name)


def warn_about_training(*runs: Run) -> None:
    for run in runs:
        if remark := warn_if_hardly_trained(count_training_frames(run)):
            click.echo(f"run {run.id}: {remark}", err=True)
