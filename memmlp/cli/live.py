"""`memmlp live`: run a network on a clip or live trackers, with a local web page."""

from __future__ import annotations

import contextlib
import sys
from importlib.util import find_spec
from ipaddress import IPv4Network
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from memmlp.cli.options import (
    PATH,
    PORT,
    FiniteFloat,
    HomePath,
    SenderNetwork,
    TargetAddress,
    add_page_options,
    add_run_options,
    check_runs_exist,
)
from memmlp.common.errors import InputError
from memmlp.common.page_server import check_token
from memmlp.common.processes import finish_uninterrupted
from memmlp.runs.lookup import (
    DEFAULT,
    count_training_frames,
    find_run,
    find_shipped,
    find_shipped_clip,
    get_shipped_name,
    warn_if_hardly_trained,
)

if TYPE_CHECKING:
    from memmlp.live.outputs import Output, Outputs
    from memmlp.live.session.sources import TrackedClip, TrackerSource
    from memmlp.live.spaces import SpaceName
    from memmlp.live.stream import Stream
    from memmlp.live.wearer import Calibration

BUILTIN = "own"  # value of --avatar for the built-in avatar
SPACE, HZ = "amass", 60.0  # for clips, and by default for packets


class LiveOptions(NamedTuple):
    """The argument and options of `memmlp live`."""

    network: str
    outputs: Path
    clip: str | None = None
    udp: int | None = None
    osc: int | None = None
    senders: tuple[IPv4Network, ...] = ()
    space: SpaceName = "amass"
    hz: float = HZ
    height: float | None = None
    floor: float | None = None
    calibration: Path | None = None
    vmc: tuple[tuple[str, int | None], ...] = ()
    vrchat: tuple[tuple[str, int | None], ...] = ()
    record: tuple[Path, ...] = ()
    avatar: str | None = None
    port: int = 0
    host: str = "127.0.0.1"
    token: str | None = None
    no_browser: bool = True

    @property
    def is_onnx_file(self) -> bool:
        """Whether the network is an ONNX file instead of a run."""
        return self.network.endswith(".onnx")

    @property
    def packets(self) -> tuple[str, int] | None:
        """The kind of packets ("udp" or "osc") and their port; None for a clip."""
        if self.udp is not None:
            return "udp", self.udp
        return None if self.osc is None else ("osc", self.osc)


@click.command("live")
@click.argument("network", metavar="[RUN|FILE.onnx]", default=DEFAULT)
@click.option(
    "--clip",
    help="Clip to play: a test clip's name, or an AMASS npz file.  [default: the run's first test clip; the "
    "shipped clip for shipped networks and ONNX files]",
)
@click.option("--udp", type=PORT, metavar="PORT", help="UDP port of tracker poses as JSON packets.")
@click.option("--osc", type=PORT, metavar="PORT", help="UDP port of tracker poses as OSC bundles.")
@click.option(
    "--sender",
    "senders",
    type=SenderNetwork(),
    multiple=True,
    help="Other machine to accept packets from; repeatable.  [default: only this machine]",
)
@click.option(
    "--space",
    default=SPACE,
    type=click.Choice(["amass", "openxr", "unity"]),
    help="Frame of reference of the packets' poses.",
)
@click.option("--hz", default=HZ, type=FiniteFloat(10, 1000), help="Sampling rate of a clip, Hz.")
@click.option(
    "--height",
    type=FiniteFloat(0.5, 2.5),
    metavar="METRES",
    help="Body height of the user, metres.  [default: the height of the network's body]",
)
@click.option(
    "--floor",
    type=FiniteFloat(-100, 100),
    metavar="METRES",
    help="Height of the floor, metres.  [default: 0]",
)
@click.option(
    "--calibration",
    type=HomePath(dir_okay=False),
    metavar="FILE",
    help="JSON file of the user's calibration. It is read at the start and updated by changes on the page.",
)
@click.option(
    "--vmc",
    type=TargetAddress(),
    multiple=True,
    help="Program to send the body's bones to, by the VMC protocol; the default port is 39539; repeatable.",
)
@click.option(
    "--vrchat",
    type=TargetAddress(),
    multiple=True,
    help="Address of VRChat, to send trackers to; the default port is 9000; repeatable.",
)
@click.option(
    "--record",
    type=PATH,
    metavar="FILE",
    multiple=True,
    help="New file for a recording (.npz, .bvh or .glb), written at the end; repeatable.",
)
@click.option(
    "--avatar",
    is_flag=False,
    flag_value=BUILTIN,
    metavar="[FILE.vrm]",
    help="Show a VRM avatar on the page: FILE.vrm, or the built-in avatar.",
)
@add_page_options(port=8765)
@add_run_options
def live(**options: Any) -> None:
    """Show a network live, on a local web page; by default a shipped network on a shipped clip.

    RUN is an id, the beginning of an id, a folder, or a shipped network (memmlp models). The input is a
    repeated clip in real time, or tracker poses from network packets. The page shows the body; options also
    send it to other programs and files (docs/guides/live.md). Ctrl-C stops the command.
    """
    live_options = LiveOptions(**options)
    check_options(live_options)
    if not live_options.is_onnx_file:
        check_runs_exist(live_options.outputs, live_options.network)
    with contextlib.suppress(KeyboardInterrupt):
        serve(live_options)


def check_options(options: LiveOptions) -> None:
    tracker_options = {
        "--height": options.height is not None,
        "--floor": options.floor is not None,
        "--calibration": options.calibration is not None,
        "--sender": bool(options.senders),
    }
    sources = [options.udp, options.osc, options.clip]
    if sum(source is not None for source in sources) > 1:
        raise InputError("--clip, --udp, --osc: expected only one source")
    if options.packets is None and options.space != SPACE:
        raise InputError(f"--space {options.space}: must be {SPACE} with a clip; others are for tracker data")
    if options.packets and options.hz != HZ:
        raise InputError("--hz: needs a clip; packets arrive at any rate")
    if options.packets is None and (names := [name for name, used in tracker_options.items() if used]):
        raise InputError(f"{names[0]}: needs --udp PORT or --osc PORT")
    osc = {"--osc": options.osc is not None, "--vmc": options.vmc, "--vrchat": options.vrchat}
    if (needing := [name for name, used in osc.items() if used]) and find_spec("pythonosc") is None:
        raise InputError(f"{needing[0]}: needs python-osc: pip install 'memmlp[osc]'")
    check_token(options.host, options.token)


def make_source(options: LiveOptions) -> TrackerSource:
    from memmlp.live.session.sources import ClipSource, PacketSource, parse_json_packet, parse_osc_packet

    if options.packets is None:
        return ClipSource(load_tracked_clip(options), options.hz)
    kind, port = options.packets
    parse = parse_json_packet if kind == "udp" else parse_osc_packet
    return PacketSource(kind.upper(), port, parse, options.space, options.senders, print_note)


def load_tracked_clip(options: LiveOptions) -> TrackedClip:
    """Load the clip of --clip: an AMASS npz file on the network's body, or a test clip of the run."""
    from memmlp.live.session.sources import TrackedClip, read_npz_frames
    from memmlp.live.stream import ExportedNetwork

    clip = options.clip
    if options.is_onnx_file or find_shipped(options.network):
        clip = clip or str(find_shipped_clip())
        if not clip.endswith(".npz"):
            raise InputError(
                f"--clip {clip}: must be an npz file, because {options.network} has no test clips"
            )
    if clip is not None and clip.endswith(".npz"):
        body = ExportedNetwork(find_network_file(options)[0]).body.rest
        return TrackedClip(Path(clip).stem, read_npz_frames(Path(clip), body))
    if sys.stderr.isatty():  # it takes seconds
        print_note(f"opening run {options.network} and its test clips")
    from memmlp.config.open_run import find_clip, open_run

    test = open_run(options.outputs, options.network).test
    name = test.names[0] if clip is None else clip
    return TrackedClip(name, find_clip(test, name).numpy())


def serve(options: LiveOptions) -> None:
    """Send the source's poses through the network to the outputs and the page, until Ctrl-C."""
    import threading
    import webbrowser

    from memmlp.live.session import server as page
    from memmlp.live.session.loop import Fitting, make_greeting, run_loop
    from memmlp.live.stream import Stream
    from memmlp.motion.formats.gltf import encode_vrm

    with contextlib.closing(make_source(options)) as source:
        file, name = find_network_file(options)
        stream = Stream(file, space=source.space)
        calibration = combine_calibration(options, source.space, stream)
        stream.fit(calibration.height, calibration.floor)
        stream.offsets = calibration.offsets
        avatar, vrm = options.avatar, None
        if avatar is not None:
            vrm = encode_vrm(stream.rest) if avatar == BUILTIN else page.read_vrm(Path(avatar))
        files = page.load_page_files(vrm)
        outputs = make_outputs(options, stream)
        run = None if options.is_onnx_file else find_run(options.outputs, options.network)
        remark = warn_if_hardly_trained(count_training_frames(run)) if run else ""
        hub = page.Hub(make_greeting(source, name, outputs, remark, avatar is not None))
        fitting, ask = None, None
        if source.has_wearer:
            fitting = Fitting(stream, source.space, options.calibration, hub.publish_state)
            ask = fitting.submit_command
        with (
            finish_uninterrupted(outputs.close),
            page.LiveServer(hub, options.port, options.host, options.token, files, ask) as server,
        ):
            if remark:
                print_note(f"{name}: {remark}")
            click.echo(f"{server.url}  {source.name}; Ctrl-C ends")
            for output in outputs.outputs:
                click.echo(f"  to {output.name}")
            if not options.no_browser:
                webbrowser.open(server.url)
            stopped = threading.Event()
            run_loop(stream, source, hub.publish, stopped, outputs, fitting, avatar is not None, print_note)


def find_network_file(options: LiveOptions) -> tuple[Path, str]:
    """Return the path of the network's ONNX file, and the network's name."""
    if options.is_onnx_file:
        return Path(options.network), Path(options.network).name
    run = find_run(options.outputs, options.network)
    return run.preferred_onnx, get_shipped_name(run) or f"run {run.id[:8]}"


def combine_calibration(options: LiveOptions, space: SpaceName, stream: Stream) -> Calibration:
    """Return the user's calibration from the options, which take precedence, and the file of --calibration.
    Offsets in the file are ignored if the options set another height."""
    from memmlp.live.wearer import SAME, Calibration, compute_body_height, read_calibration

    body = compute_body_height(stream.network.body)
    saved = Calibration(space)
    if options.calibration is not None and options.calibration.exists():
        saved = read_calibration(options.calibration, space, stream.network.body)
    height = saved.height if options.height is None else options.height
    floor = saved.floor if options.floor is None else options.floor
    offsets = saved.offsets
    if offsets is not None and abs((height or body) - (saved.height or body)) > SAME:
        was = saved.height or body
        print_note(f"{options.calibration}: its calibration is for a height of {was:.2f} m; calibrate again")
        offsets = None
    return Calibration(space, offsets, height, floor)


def make_outputs(options: LiveOptions, stream: Stream) -> Outputs:
    from memmlp.live.outputs import VMC, VMC_PORT, VRCHAT_PORT, Outputs, Receiver, Recorder, VRChat

    outputs: list[Output] = [VMC(Receiver(host, port or VMC_PORT, "--vmc")) for host, port in options.vmc]
    outputs += [VRChat(Receiver(host, port or VRCHAT_PORT, "--vrchat")) for host, port in options.vrchat]
    if options.record:
        network = stream.network
        outputs.append(Recorder(options.record, network.body.rest, network.fps, print_note))
    return Outputs(outputs, print_note)


def print_note(line: str) -> None:
    click.echo(line, err=True)
