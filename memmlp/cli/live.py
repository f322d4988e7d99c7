"""`memmlp live`: a network fed by a clip or by live trackers, watched on a local page."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from memmlp.cli.options import Finite, outputs_option, page_options, plugins_option

if TYPE_CHECKING:
    import numpy as np

    from memmlp.live.player.sources import ClipSource, PoseSource, TrackedClip
    from memmlp.live.spaces import SpaceName

PORT = click.IntRange(1, 65535)


@click.command("live")
@click.argument("network", metavar="RUN|FILE.onnx")
@click.option(
    "--clip",
    help="Clip to play: a test clip's name, or an AMASS npz file.  [default: the run's first test clip]",
)
@click.option(
    "--udp",
    type=PORT,
    metavar="PORT",
    help="Take tracker poses as JSON packets at this UDP port of 127.0.0.1, in place of a clip.",
)
@click.option(
    "--osc",
    type=PORT,
    metavar="PORT",
    help="Take tracker poses as OSC bundles at this UDP port of 127.0.0.1, in place of a clip.",
)
@click.option(
    "--space", default="amass", show_default=True, type=click.Choice(["amass", "openxr", "unity"]),
    help="Frame of reference of the packets, also of those that --send sends.",
)  # fmt: skip
@click.option(
    "--hz",
    default=60.0,
    show_default=True,
    type=Finite(10, 1000),
    help="How many samples of a clip are played a second, Hz.",
)
@page_options(port=8765)
@click.option(
    "--send", is_flag=True, help="Send the clip once, to the port of --udp or --osc, and show no page."
)
@plugins_option
@outputs_option
def live(
    network: str,
    clip: str | None,
    udp: int | None,
    osc: int | None,
    space: SpaceName,
    hz: float,
    port: int,
    no_browser: bool,
    send: bool,
    outputs: Path,
) -> None:
    """Show a finished run (id, its beginning, or folder) or an ONNX file live, on a page of this machine.

    It is fed a clip in real time, over and over, or tracker poses that arrive as packets.
    Their format is in docs/guides/live.md. Ctrl-C ends it.
    """
    from memmlp.common.errors import InputError
    from memmlp.live.player.packets import needs_osc

    ports = [number for number in (udp, osc) if number is not None]
    if len(ports) > 1 or (ports and clip is not None and not send):
        raise InputError("--clip, --udp, --osc: more than one source; allowed is one of them")
    if send and not ports:
        raise InputError("--send: has no port; allowed is --udp PORT or --osc PORT")
    if osc is not None:
        needs_osc()
    feed = Feed(network, clip, udp, osc, space, hz, outputs)
    with contextlib.suppress(KeyboardInterrupt):
        if send:
            sent(feed)
        else:
            watched(feed, port, no_browser)


class Feed(NamedTuple):
    """What the command's options name: a network, and the poses that it is fed."""

    network: str
    clip: str | None
    udp: int | None
    osc: int | None
    space: SpaceName
    hz: float
    outputs: Path


def source_of(feed: Feed) -> PoseSource:
    """Return the source of the poses: packets at a port, or a clip that is repeated."""
    from memmlp.live.player.packets import from_json, from_osc
    from memmlp.live.player.sources import PacketSource

    if feed.udp is not None:
        return PacketSource("UDP", feed.udp, from_json, feed.space)
    if feed.osc is not None:
        return PacketSource("OSC", feed.osc, from_osc, feed.space)
    return clip_source(feed)


def clip_source(feed: Feed, rounds: float = float("inf")) -> ClipSource:
    """Return a source that plays the clip in real time, `rounds` times."""
    from memmlp.live.player.sources import ClipSource

    return ClipSource(clip_of(feed), feed.hz, rounds)


def clip_of(feed: Feed) -> TrackedClip:
    """Load the clip of --clip: an AMASS npz on the built-in body, or a test clip of the run.

    Raises:
        InputError: for a test clip where the network is an ONNX file, which has none, or an unknown name.
    """
    from memmlp.common.errors import InputError
    from memmlp.live.player.sources import TrackedClip

    if feed.clip is not None and feed.clip.endswith(".npz"):
        return TrackedClip(Path(feed.clip).stem, npz_frames(Path(feed.clip)))
    if feed.network.endswith(".onnx"):
        raise InputError(
            f"{feed.network}: has no test clips; allowed with it are --clip FILE.npz, --udp and --osc"
        )
    from memmlp.config.open_run import clip_index, open_run

    test = open_run(feed.outputs, feed.network).test
    index = 0 if feed.clip is None else clip_index(test, feed.clip)
    return TrackedClip(test.names[index], test.clip(index).numpy())


def npz_frames(path: Path) -> np.ndarray:
    """Return the frames (N, 252) of an AMASS npz, resampled to 60 Hz, on the built-in body.

    Raises:
        InputError: for a clip of fewer than 3 frames at 60 Hz.
    """
    import torch

    from memmlp.common.errors import InputError
    from memmlp.motion.body import builtin_rest_joints
    from memmlp.motion.clip import resample
    from memmlp.motion.features import motion_frames
    from memmlp.motion.formats.npz import read_clip
    from memmlp.motion.plausible import check_plausible

    recorded = read_clip(path, path.stem)
    check_plausible(path, recorded)
    clip, _ = resample(recorded)
    if len(clip) < 3:
        raise InputError(f"{path}: {len(clip)} frames at 60 Hz; allowed are 3 or more")
    tensors = (torch.tensor(part) for part in (clip.poses, clip.trans, builtin_rest_joints()))
    return motion_frames(*tensors).numpy()


def sent(feed: Feed) -> None:
    """Send the clip's packets once to the port of the options, in the frame of reference of --space."""
    from memmlp.live.player.packets import to_json, to_osc
    from memmlp.live.player.sources import send
    from memmlp.live.spaces import space_of

    source = clip_source(feed, rounds=1)
    port, pack = (feed.udp, to_json) if feed.udp is not None else (feed.osc, to_osc)
    assert port is not None
    click.echo(f"sending {source.name} to port {port}")
    click.echo(f"{send(source, port, pack, space_of(feed.space))} packets sent")


def watched(feed: Feed, port: int, no_browser: bool) -> None:
    """Play the source through the network and serve the page until Ctrl-C."""
    import threading
    import webbrowser

    from memmlp.live.player.play import greeting, play
    from memmlp.live.player.server import Hub, Server
    from memmlp.live.stream import Stream
    from memmlp.runs.lookup import find_run

    with contextlib.closing(source_of(feed)) as source:
        if feed.network.endswith(".onnx"):
            file, name = Path(feed.network), Path(feed.network).name
        else:
            run = find_run(feed.outputs, feed.network)
            file, name = run.preferred_onnx, f"run {run.id[:8]}"
        stream = Stream(file, space=source.space)
        hub = Hub(greeting(source, name))
        with Server(hub, port) as server:
            click.echo(f"{server.url}  {source.name}; Ctrl-C ends")
            if not no_browser:
                webbrowser.open(server.url)
            play(stream, source, hub.publish, threading.Event())
