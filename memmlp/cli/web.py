"""`memmlp web`: a static site that plays clips and shows the user's body in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import PATH, FiniteFloat, add_run_options, check_runs_exist, warn_about_training
from memmlp.common.errors import InputError
from memmlp.common.overrides import flatten
from memmlp.runs.lookup import count_training_frames, get_run_name, warn_if_hardly_trained

if TYPE_CHECKING:
    from memmlp.config.open_run import OpenedRun
    from memmlp.live.web.site import SiteClip, SiteNetwork


@click.command("web")
@click.argument("runs", nargs=-1, required=True)
@click.option("--out", required=True, type=PATH, help="Folder to write the site into.")
@click.option("--clips", default=3, type=click.IntRange(1, 50), help="Number of test clips of each run.")
@click.option(
    "--seconds",
    default=20.0,
    type=FiniteFloat(1, 600),
    help="Maximum length of a clip in seconds; longer clips are cut to their middle.",
)
@add_run_options
def web(runs: tuple[str, ...], out: Path, clips: int, seconds: float, outputs: Path) -> None:
    """Make a static web site of finished RUNS (ids, beginnings of ids, folders, or shipped networks).

    In a browser, including a headset's, the site plays test clips and shows the user's body in a mirror, with
    the time of each pose (docs/guides/web.md). The first call downloads onnxruntime-web from npm's registry.
    """
    check_runs_exist(outputs, *runs)
    from memmlp.config.open_run import open_run
    from memmlp.live.web.site import Site, check_site_folder

    check_site_folder(out)
    opened = [open_run(outputs, run) for run in dict.fromkeys(runs)]
    if len({one.run.id for one in opened}) < len(opened):
        raise InputError(f"{' '.join(runs)}: expected each run only once")
    clips_by_run = {one.run.id: pack_clips(one, clips, seconds) for one in opened}
    networks = [describe_network(one, clips_by_run[one.run.id]) for one in opened]
    site = Site(
        networks=networks,
        clips=list({clip.key: clip for some in clips_by_run.values() for clip in some}.values()),
    )
    size = site.write(out)
    click.echo(f"{out}: {size / 1e6:.1f} MB; serve it with: python -m http.server --directory {out}")
    warn_about_training(*(one.run for one in opened))


def pack_clips(opened: OpenedRun, count: int, seconds: float) -> list[SiteClip]:
    """Return the middle parts of up to `count` test clips, evenly spaced in the list of clips."""
    import numpy as np

    from memmlp.live.web.site import pack_clip

    test = opened.test
    chosen = np.linspace(0, len(test.names) - 1, min(count, len(test.names))).round().astype(int)
    return [pack_clip(test.names[index], test.read_clip(index).numpy(), seconds) for index in chosen.tolist()]


def describe_network(opened: OpenedRun, clips: list[SiteClip]) -> SiteNetwork:
    from memmlp.live.web.site import SiteNetwork
    from memmlp.networks.streaming import check_is_stream

    network = opened.network()
    check_is_stream(network)
    run, config = opened.run, flatten(opened.run.config)
    name, model = get_run_name(run.manifest, config).removeprefix("default · "), config["model.name"]
    name = name if f"model={model}" in name else f"{model} {name}"
    keys = tuple(clip.key for clip in clips)
    return SiteNetwork(
        run.id, name, run.id, network, keys, warn_if_hardly_trained(count_training_frames(run))
    )
