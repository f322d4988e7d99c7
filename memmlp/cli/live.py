"""`memmlp live`: a network fed by a clip or by live trackers, watched on a local page."""

from __future__ import annotations

import contextlib
import sys
from importlib.util import find_spec
from ipaddress import IPv4Network
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from memmlp.cli.options import (
    PORT,
    Finite,
    Program,
    Sender,
    check_runs,
    host_option,
    outputs_option,
    page_options,
    plugins_option,
    token_option,
)

if TYPE_CHECKING:
    from memmlp.live.outputs import Output, Outputs
    from memmlp.live.session.sources import TrackedClip, TrackerSource
    from memmlp.live.spaces import SpaceName
    from memmlp.live.stream import Stream
    from memmlp.live.wearer import Calibration

BUILTIN = "own"  # the value of --avatar for the built-in avatar
SPACE, HZ = "amass", 60.0  # of clips, and the default of packets


class LiveOptions(NamedTuple):
    """The command's argument and options."""

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
    def is_file(self) -> bool:
        """Whether the network is an ONNX file, not a run."""
        return self.network.endswith(".onnx")

    @property
    def packets(self) -> tuple[str, int] | None:
        """The kind and the port of the packets; None for a clip."""
        if self.udp is not None:
            return "udp", self.udp
        return None if self.osc is None else ("osc", self.osc)


@click.command("live")
@click.argument("network", metavar="RUN|FILE.onnx")
@click.option(
    "--clip",
    help="Clip to play: a test clip's name, or an AMASS npz file.  [default: the run's first test clip]",
)
@click.option("--udp", type=PORT, metavar="PORT", help="Take tracker poses as JSON packets at this UDP port.")
@click.option("--osc", type=PORT, metavar="PORT", help="Take tracker poses as OSC bundles at this UDP port.")
@click.option(
    "--sender",
    "senders",
    type=Sender(),
    multiple=True,
    help="Accept packets of this other machine, too; repeatable.  [default: only this machine's]",
)
@click.option(
    "--space",
    default=SPACE,
    show_default=True,
    type=click.Choice(["amass", "openxr", "unity"]),
    help="Frame of reference of the packets.",
)
@click.option(
    "--hz", default=HZ, show_default=True, type=Finite(10, 1000), help="Samples of a clip per second, Hz."
)
@click.option(
    "--height",
    type=Finite(0.5, 2.5),
    metavar="METRES",
    help="Body height of the wearer, metres.  [default: that of the network's body]",
)
@click.option(
    "--floor", type=Finite(-100, 100), metavar="METRES", help="Height of the floor, metres.  [default: 0]"
)
@click.option(
    "--calibration",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="JSON file of the wearer's calibration, to start with and to save changes on the page to.",
)
@click.option(
    "--vmc",
    type=Program(),
    multiple=True,
    help="Send the body's bones there by the VMC protocol; port 39539 by default; repeatable.",
)
@click.option(
    "--vrchat",
    type=Program(),
    multiple=True,
    help="Send trackers to VRChat there; port 9000 by default; repeatable.",
)
@click.option(
    "--record",
    type=click.Path(path_type=Path),
    metavar="FILE",
    multiple=True,
    help="Record to a new file, .npz, .bvh or .glb, which is written at the end; repeatable.",
)
@click.option(
    "--avatar",
    is_flag=False,
    flag_value=BUILTIN,
    metavar="[FILE.vrm]",
    help="Show a VRM avatar on the page: this file, or the built-in one.",
)
@page_options(port=8765)
@host_option
@token_option
@plugins_option
@outputs_option
def live(**options: Any) -> None:
    """Show a finished run (id, its beginning, or folder) or an ONNX file live, on a page of this machine.

    Its input is a clip in real time, repeated, or tracker poses that arrive as packets. The body is shown on
    the page, and sent to other programs and files on request (docs/guides/live.md). Ctrl-C ends it.
    """
    given = LiveOptions(**options)
    check_options(given)
    if not given.is_file:
        check_runs(given.outputs, given.network)
    with contextlib.suppress(KeyboardInterrupt):
        serve(given)


def check_options(given: LiveOptions) -> None:
    """Raise InputError for options that contradict each other, or need something that is not installed."""
    from memmlp.common.errors import InputError
    from memmlp.common.page_server import check_token

    worn = {
        "--height": given.height is not None,
        "--floor": given.floor is not None,
        "--calibration": given.calibration is not None,
        "--sender": bool(given.senders),
    }
    sources = [given.udp, given.osc, given.clip]
    if sum(source is not None for source in sources) > 1:
        raise InputError("--clip, --udp, --osc: expected only one source")
    if given.packets is None and given.space != SPACE:
        raise InputError(f"--space {given.space}: must be {SPACE} with a clip; others are for packets")
    if given.packets and given.hz != HZ:
        raise InputError("--hz: needs a clip; packets arrive at any rate")
    if given.packets is None and (names := [name for name, used in worn.items() if used]):
        raise InputError(f"{names[0]}: needs --udp PORT or --osc PORT, the packets of a wearer's devices")
    osc = {"--osc": given.osc is not None, "--vmc": given.vmc, "--vrchat": given.vrchat}
    if (needing := [name for name, used in osc.items() if used]) and find_spec("pythonosc") is None:
        raise InputError(f"{needing[0]}: needs python-osc: pip install 'memmlp[osc]'")
    check_token(given.host, given.token)


def make_source(given: LiveOptions) -> TrackerSource:
    """Return the source of the poses: packets at a port, or a clip that is played repeatedly."""
    from memmlp.live.session.sources import ClipSource, PacketSource, parse_json_packet, parse_osc_packet

    if given.packets is None:
        return ClipSource(load_clip(given), given.hz)
    kind, port = given.packets
    parse = parse_json_packet if kind == "udp" else parse_osc_packet
    return PacketSource(kind.upper(), port, parse, given.space, given.senders, note)


def load_clip(given: LiveOptions) -> TrackedClip:
    """Load the clip of --clip: an AMASS npz on the network's body, or a test clip of the run.

    Raises:
        InputError: for a test clip if the network is an ONNX file, or for an unknown name.
    """
    from memmlp.common.errors import InputError
    from memmlp.deploy.onnx_stream import check_file
    from memmlp.live.session.sources import TrackedClip, read_npz_frames
    from memmlp.live.stream import ExportedNetwork

    if given.clip is not None and given.clip.endswith(".npz"):
        body = ExportedNetwork(network_file(given)[0]).body.rest
        return TrackedClip(Path(given.clip).stem, read_npz_frames(Path(given.clip), body))
    if given.is_file:
        check_file(Path(given.network))
        raise InputError(f"{given.network}: needs --clip FILE.npz, --udp or --osc; a file has no test clips")
    if sys.stderr.isatty():  # it takes seconds
        note(f"opening run {given.network} and its test clips")
    from memmlp.config.open_run import clip_index, open_run

    test = open_run(given.outputs, given.network).test
    index = 0 if given.clip is None else clip_index(test, given.clip)
    return TrackedClip(test.names[index], test.clip(index).numpy())


def serve(given: LiveOptions) -> None:
    """Play the source through the network to the outputs, and serve the page, until Ctrl-C."""
    import threading
    import webbrowser

    from memmlp.common.processes import finish_uninterrupted
    from memmlp.live.session import server as page
    from memmlp.live.session.loop import Fitting, make_greeting, run_loop
    from memmlp.live.stream import Stream
    from memmlp.runs.lookup import count_training_frames, find_run, warn_if_hardly_trained

    with contextlib.closing(make_source(given)) as source:
        file, name = network_file(given)
        stream = Stream(file, space=source.space)
        calibration = combine_calibration(given, source.space, stream)
        stream.fit(calibration.height, calibration.floor)
        stream.offsets = calibration.offsets
        avatar, vrm = given.avatar, None
        if avatar is not None:
            vrm = page.make_mannequin_vrm(stream.rest) if avatar == BUILTIN else page.read_vrm(Path(avatar))
        files = page.load_page_files(vrm)
        outputs = make_outputs(given, stream)
        run = None if given.is_file else find_run(given.outputs, given.network)
        remark = warn_if_hardly_trained(count_training_frames(run)) if run else ""
        hub = page.Hub(make_greeting(source, name, outputs, remark, avatar is not None))
        fitting = (
            Fitting(stream, source.space, given.calibration, hub.publish_state) if source.has_wearer else None
        )
        ask = fitting.submit_order if fitting else None
        with (
            finish_uninterrupted(outputs.close),
            page.LiveServer(hub, given.port, given.host, given.token, files, ask) as server,
        ):
            if remark:
                note(f"{name}: {remark}")
            click.echo(f"{server.url}  {source.name}; Ctrl-C ends")
            for output in outputs.outputs:
                click.echo(f"  to {output.name}")
            if not given.no_browser:
                webbrowser.open(server.url)
            stopped = threading.Event()
            run_loop(stream, source, hub.publish, stopped, outputs, fitting, avatar is not None, note)


def network_file(given: LiveOptions) -> tuple[Path, str]:
    """Return the ONNX file of the network, and its name."""
    from memmlp.runs.lookup import find_run

    if given.is_file:
        return Path(given.network), Path(given.network).name
    run = find_run(given.outputs, given.network)
    return run.preferred_onnx, f"run {run.id[:8]}"


def combine_calibration(given: LiveOptions, space: SpaceName, stream: Stream) -> Calibration:
    """Return the wearer's calibration, from --calibration's file and the options, which take precedence.

    Offsets are left out if they are for another height than that of the options.
    """
    from memmlp.live.wearer import SAME, Calibration, compute_body_height, read_calibration

    body = compute_body_height(stream.network.body)
    saved = Calibration(space)
    if given.calibration is not None and given.calibration.exists():
        saved = read_calibration(given.calibration, space, stream.network.body)
    height = saved.height if given.height is None else given.height
    floor = saved.floor if given.floor is None else given.floor
    offsets = saved.offsets
    if offsets is not None and abs((height or body) - (saved.height or body)) > SAME:
        was = saved.height or body
        note(f"{given.calibration}: its calibration is for a height of {was:.2f} m; calibrate again")
        offsets = None
    return Calibration(space, offsets, height, floor)


def make_outputs(given: LiveOptions, stream: Stream) -> Outputs:
    """Return the outputs that the options name."""
    from memmlp.live.outputs import VMC, VMC_PORT, VRCHAT_PORT, Outputs, Receiver, Recorder, VRChat

    found: list[Output] = [VMC(Receiver(host, port or VMC_PORT, "--vmc")) for host, port in given.vmc]
    found += [VRChat(Receiver(host, port or VRCHAT_PORT, "--vrchat")) for host, port in given.vrchat]
    if given.record:
        network = stream.network
        found.append(Recorder(given.record, network.body.rest, network.fps, note))
    return Outputs(found, note)


def note(line: str) -> None:
    """Print a remark to stderr."""
    click.echo(line, err=True)
