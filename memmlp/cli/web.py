"""`memmlp web`: a static site that times networks, plays clips and shows the wearer, in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import PATH, Finite, check_runs, outputs_option, plugins_option, remark_on

if TYPE_CHECKING:
    from memmlp.config.open_run import OpenedRun
    from memmlp.live.web.site import SiteClip, SiteNetwork

BASE = ("profile=paper", "model=avatar_poser")
"""The network with which the bench compares: AvatarPoser in the paper's size, with random weights."""


@click.command("web")
@click.argument("runs", nargs=-1, required=True)
@click.option("--out", required=True, type=PATH, help="Folder to write the site into.")
@click.option(
    "--clips", default=3, show_default=True, type=click.IntRange(1, 50), help="Test clips of each run."
)
@click.option(
    "--seconds",
    default=20.0,
    show_default=True,
    type=Finite(1, 600),
    help="Longest part of a clip, from its middle, seconds.",
)
@click.option("--no-bench", is_flag=True, help="Leave out the bench, and the graphs that it times.")
@plugins_option
@outputs_option
def web(
    runs: tuple[str, ...],
    out: Path,
    clips: int,
    seconds: float,
    no_bench: bool,
    outputs: Path,
) -> None:
    """Make a site of finished RUNS (ids, their beginnings, or folders) that any static server can serve.

    In the browser, such as a headset's, it times each network, plays test clips, and shows the wearer's body
    in a mirror (docs/guides/web.md). The command downloads onnxruntime-web from the npm registry, once.
    """
    check_runs(outputs, *runs)
    from memmlp.common.errors import InputError
    from memmlp.config.build import untrained
    from memmlp.config.open_run import open_run
    from memmlp.live.web.site import RANDOM, Site, SiteNetwork, check_site_folder

    check_site_folder(out)
    opened = [open_run(outputs, run) for run in dict.fromkeys(runs)]
    if len({one.run.id for one in opened}) < len(opened):
        raise InputError(f"{' '.join(runs)}: expected each run only once")
    found = {one.run.id: pack_clips(one, clips, seconds) for one in opened}
    networks = [describe_network(one, found[one.run.id]) for one in opened]
    base = None if no_bench else SiteNetwork("avatar-poser", "AvatarPoser", RANDOM, untrained(BASE))
    site = Site(
        networks=networks,
        base=base,
        clips=list({clip.key: clip for some in found.values() for clip in some}.values()),
    )
    size = site.write(out)
    click.echo(f"{out}: {size / 1e6:.1f} MB; serve it with: python -m http.server --directory {out}")
    remark_on(*(one.run for one in opened))


def pack_clips(opened: OpenedRun, count: int, seconds: float) -> list[SiteClip]:
    """Return the middle parts of some test clips of a run, evenly spread over all of them."""
    import numpy as np

    from memmlp.live.web.site import pack_clip

    test = opened.test
    chosen = np.linspace(0, len(test.names) - 1, min(count, len(test.names))).round().astype(int)
    return [pack_clip(test.names[index], test.clip(index).numpy(), seconds) for index in chosen.tolist()]


def describe_network(opened: OpenedRun, clips: list[SiteClip]) -> SiteNetwork:
    """Return a run's network in the form that a site needs."""
    from memmlp.live.web.site import SiteNetwork
    from memmlp.networks.streaming import check_is_stream
    from memmlp.runs.identity import flatten
    from memmlp.runs.lookup import count_training_frames, get_run_name, warn_if_hardly_trained

    network = opened.network()
    check_is_stream(network)
    run, config = opened.run, flatten(opened.run.config)
    name, model = get_run_name(run.manifest, config).removeprefix("default · "), config["model.name"]
    name = name if f"model={model}" in name else f"{model} {name}"
    keys = tuple(clip.key for clip in clips)
    return SiteNetwork(
        run.id, name, run.id, network, keys, warn_if_hardly_trained(count_training_frames(run))
    )
