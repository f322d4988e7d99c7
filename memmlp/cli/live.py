"""`memmlp live`: a network fed by a clip or by live trackers, watched on a local page."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Mapping
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
    from memmlp.live.calibration_file import Calibration
    from memmlp.live.outputs.output import Output, Outputs
    from memmlp.live.session.page_server import File
    from memmlp.live.session.sources import ClipSource, TrackedClip, TrackerSource
    from memmlp.live.spaces import SpaceName
    from memmlp.live.stream import Stream

OWN = "own"  # the avatar that is the project's own
SPACE, HZ = "amass", 60.0  # of clips, and of packets where nothing else is told


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
    help="Take tracker poses as JSON packets at this UDP port, in place of a clip.",
)
@click.option(
    "--osc",
    type=PORT,
    metavar="PORT",
    help="Take tracker poses as OSC bundles at this UDP port, in place of a clip.",
)
@click.option(
    "--sender",
    "senders",
    type=Sender(),
    multiple=True,
    help="Take packets of this other machine, too. May be given several times.  [default: this machine's]",
)
@click.option(
    "--space", default=SPACE, show_default=True, type=click.Choice(["amass", "openxr", "unity"]),
    help="Frame of reference of the packets, also of those that --send sends.",
)  # fmt: skip
@click.option(
    "--hz",
    default=HZ,
    show_default=True,
    type=Finite(10, 1000),
    help="How many samples of a clip are played a second, Hz.",
)
@click.option(
    "--height",
    type=Finite(0.5, 2.5),
    metavar="METRES",
    help="Body height of who wears the trackers, metres.  [default: that of the network's body]",
)
@click.option(
    "--floor", type=Finite(-100, 100), metavar="METRES", help="Height of the floor, metres.  [default: 0]"
)
@click.option(
    "--calibration",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Begin with what this JSON file knows of the wearer, and save to it what the page changes.",
)
@click.option(
    "--vmc",
    type=Program(),
    multiple=True,
    help="Send the body's bones there by the VMC protocol; port 39539 by default. Several are allowed.",
)
@click.option(
    "--vrchat",
    type=Program(),
    multiple=True,
    help="Send trackers to VRChat there; port 9000 by default. Several are allowed.",
)
@click.option(
    "--record",
    type=click.Path(path_type=Path),
    metavar="FILE",
    multiple=True,
    help="Record to a new file, .npz, .bvh or .glb, which is written at the end. Several are allowed.",
)
@click.option(
    "--avatar",
    is_flag=False,
    flag_value=OWN,
    metavar="[FILE.vrm]",
    help="Show a VRM avatar on the page: this one, or one of this project's own.",
)
@click.option(
    "--save-avatar",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.vrm",
    help="Write this project's own avatar with the network's body, and end.",
)
@page_options(port=8765)
@host_option
@token_option
@click.option(
    "--send", is_flag=True, help="Send the clip once, to the port of --udp or --osc, and show no page."
)
@plugins_option
@outputs_option
def live(network: str, send: bool, save_avatar: Path | None, **options: Any) -> None:
    """Show a finished run (id, its beginning, or folder) or an ONNX file live, on a page of this machine.

    It is fed a clip in real time, over and over, or tracker poses that arrive as packets. The body goes to
    the page, and to other programs and files where they are asked for (docs/guides/live.md). Ctrl-C ends it.
    """
    given = InputOptions(network=network, **{key: options.pop(key) for key in FED})
    shown = ShowOptions(**options)
    check_options(given, shown, send)
    if not network.endswith(".onnx"):
        check_runs(given.outputs, network)
    with contextlib.suppress(KeyboardInterrupt):
        if save_avatar is not None:
            write_avatar(given, save_avatar)
        elif send:
            send_clip(given)
        else:
            serve(given, shown)


class InputOptions(NamedTuple):
    """The options that choose the input: a network, and the poses that it gets."""

    network: str
    clip: str | None
    udp: int | None
    osc: int | None
    senders: tuple[IPv4Network, ...]
    space: SpaceName
    hz: float
    outputs: Path


FED = InputOptions._fields[1:]
"""Names of the fields that are options of the command; `network` is its argument."""


class ShowOptions(NamedTuple):
    """The options about the wearer, and about where the body goes."""

    height: float | None
    floor: float | None
    calibration: Path | None
    vmc: tuple[tuple[str, int | None], ...]
    vrchat: tuple[tuple[str, int | None], ...]
    record: tuple[Path, ...]
    avatar: str | None
    port: int
    host: str
    token: str | None
    no_browser: bool


def check_options(given: InputOptions, shown: ShowOptions, send: bool) -> None:
    """Raise InputError for options that contradict each other, or need something that is not installed."""
    from memmlp.common.errors import InputError
    from memmlp.common.request_access import check_token
    from memmlp.live.session.packets import needs_osc

    ports = [number for number in (given.udp, given.osc) if number is not None]
    if len(ports) > 1 or (ports and given.clip is not None and not send):
        raise InputError("--clip, --udp, --osc: more than one source; allowed is one of them")
    if send and not ports:
        raise InputError("--send: has no port; allowed is --udp PORT or --osc PORT")
    worn = {
        "--height": shown.height is not None, "--floor": shown.floor is not None,
        "--calibration": shown.calibration is not None, "--sender": bool(given.senders),
    }  # fmt: skip
    if (alone := [name for name, said in worn.items() if said]) and (send or not ports):
        raise InputError(
            f"{alone[0]}: goes with --udp PORT or --osc PORT, whose packets somebody's devices send"
        )
    if given.space != SPACE and not ports:
        raise InputError(f"--space {given.space}: is of packets; allowed with a clip is --space {SPACE}")
    if given.hz != HZ and ports and not send:
        raise InputError("--hz: is of a clip; packets come at whatever rate; allowed is a clip, or --send")
    if send and (shown.vmc or shown.vrchat or shown.record or shown.avatar):
        raise InputError(
            "--send: sends trackers alone; allowed with it is no --vmc, --vrchat, --record or --avatar"
        )
    if given.osc is not None:
        needs_osc()
    for option, programs in (("--vmc", shown.vmc), ("--vrchat", shown.vrchat)):
        if programs:
            needs_osc(option, "the page, and --record")
    check_token(shown.host, shown.token)


def source_of(given: InputOptions) -> TrackerSource:
    """Return the source of the poses: packets at a port, or a clip that is played repeatedly."""
    from memmlp.live.session.packets import from_json, from_osc
    from memmlp.live.session.sources import PacketSource

    if given.udp is not None:
        return PacketSource("UDP", given.udp, from_json, given.space, given.senders, note)
    if given.osc is not None:
        return PacketSource("OSC", given.osc, from_osc, given.space, given.senders, note)
    return clip_source(given)


def clip_source(given: InputOptions, rounds: float = float("inf")) -> ClipSource:
    """Return a source that plays the clip in real time, `rounds` times."""
    from memmlp.live.session.sources import ClipSource

    return ClipSource(load_clip(given), given.hz, rounds)


def load_clip(given: InputOptions) -> TrackedClip:
    """Load the clip of --clip: an AMASS npz on the network's body, or a test clip of the run.

    Raises:
        InputError: for a test clip if the network is an ONNX file, which has none or is not there, or for an
            unknown name.
    """
    from memmlp.common.errors import InputError
    from memmlp.deploy.onnx_stream import check_file
    from memmlp.live.exported import ExportedNetwork
    from memmlp.live.session.sources import TrackedClip, npz_frames

    if given.clip is not None and given.clip.endswith(".npz"):
        body = ExportedNetwork(network_file(given)[0]).body.rest
        return TrackedClip(Path(given.clip).stem, npz_frames(Path(given.clip), body))
    if given.network.endswith(".onnx"):
        check_file(Path(given.network))
        raise InputError(
            f"{given.network}: has no test clips; allowed with it are --clip FILE.npz, --udp and --osc"
        )
    if sys.stderr.isatty():  # somebody waits, for seconds
        note(f"opening run {given.network} and its test clips")
    from memmlp.config.open_run import clip_index, open_run

    test = open_run(given.outputs, given.network).test
    index = 0 if given.clip is None else clip_index(test, given.clip)
    return TrackedClip(test.names[index], test.clip(index).numpy())


def send_clip(given: InputOptions) -> None:
    """Send the clip's packets once to the port of the options, in the frame of reference of --space."""
    from memmlp.live.session.packets import to_json, to_osc
    from memmlp.live.session.sources import send
    from memmlp.live.spaces import space_of

    source = clip_source(given, rounds=1)
    port, pack = (given.udp, to_json) if given.udp is not None else (given.osc, to_osc)
    assert port is not None
    click.echo(f"sending {source.name} to port {port}")
    (sent, refused), samples = send(source, port, pack, space_of(given.space)), source.count
    late = f" of {samples}: the others were due while this machine was busy" if sent < samples else ""
    click.echo(f"{sent} packets sent{late}")
    if refused:
        kind = "--udp" if given.udp is not None else "--osc"
        note(f"nothing listened at port {port} for some or all of them; memmlp live RUN {kind} {port} does")


def serve(given: InputOptions, shown: ShowOptions) -> None:
    """Play the source through the network to the outputs, and serve the page, until Ctrl-C."""
    import threading
    import webbrowser

    from memmlp.common.processes import finish_uninterrupted
    from memmlp.live.session.loop import greeting, run_loop, with_avatar
    from memmlp.live.session.page_server import Hub, LiveServer
    from memmlp.live.session.wearer_fitting import Fitting

    with contextlib.closing(source_of(given)) as source:
        stream, name = open_stream(given, source.space, shown)
        files = page_files(shown.avatar, stream)
        outputs = outputs_of(shown, stream)
        words = greeting(source, name, outputs, remark_of(given))
        hub = Hub(with_avatar(words) if shown.avatar else words)
        fitting = Fitting(stream, source.space, shown.calibration, hub.tell) if source.worn else None
        ask = fitting.ask if fitting else None
        with (
            finish_uninterrupted(outputs.close),
            LiveServer(hub, shown.port, shown.host, shown.token, files, ask) as server,
        ):
            if words["remark"]:
                note(f"{name}: {words['remark']}")
            click.echo(f"{server.url}  {source.name}; Ctrl-C ends")
            for output in outputs.outputs:
                click.echo(f"  to {output.name}")
            if not shown.no_browser:
                webbrowser.open(server.url)
            stopped = threading.Event()
            avatar = shown.avatar is not None
            run_loop(stream, source, hub.publish, stopped, outputs, fitting, avatar, tell=note)


def open_stream(given: InputOptions, space: SpaceName, shown: ShowOptions) -> tuple[Stream, str]:
    """Return the stream of the network, fitted to its wearer, and the network's name."""
    from memmlp.live.stream import Stream

    file, name = network_file(given)
    stream = Stream(file, space=space)
    known = known_of(shown, space, stream)
    stream.fit(known.height, known.floor)
    stream.offsets = known.offsets
    return stream, name


def remark_of(given: InputOptions) -> str:
    """Return what people should know who see a run's network move; empty for nothing, and for a file."""
    from memmlp.runs.lookup import find_run
    from memmlp.runs.motion_seen import frames_seen, hardly_trained

    if given.network.endswith(".onnx"):
        return ""
    return hardly_trained(frames_seen(find_run(given.outputs, given.network)))


def network_file(given: InputOptions) -> tuple[Path, str]:
    """Return the ONNX file of the network, and its name."""
    from memmlp.runs.lookup import find_run

    if given.network.endswith(".onnx"):
        return Path(given.network), Path(given.network).name
    run = find_run(given.outputs, given.network)
    return run.preferred_onnx, f"run {run.id[:8]}"


def known_of(shown: ShowOptions, space: SpaceName, stream: Stream) -> Calibration:
    """Return the facts about the wearer, from --calibration's file and the options, which take precedence.

    Offsets are left out if they are of another height than that of the options.
    """
    from memmlp.live.calibration_file import SAME, Calibration, read_calibration
    from memmlp.live.wearer import stature

    body = stature(stream.network.body)
    known = Calibration(space)
    if shown.calibration is not None and shown.calibration.exists():
        known = read_calibration(shown.calibration, space, stream.network.body)
    height = known.height if shown.height is None else shown.height
    floor = known.floor if shown.floor is None else shown.floor
    offsets = known.offsets
    if offsets is not None and abs((height or body) - (known.height or body)) > SAME:
        was = known.height or body
        note(f"{shown.calibration}: its calibration is of a height of {was:.2f} m; calibrate again")
        offsets = None
    return Calibration(space, offsets, height, floor)


def outputs_of(shown: ShowOptions, stream: Stream) -> Outputs:
    """Return the outputs that the options name."""
    from memmlp.live.outputs import vmc, vrchat
    from memmlp.live.outputs.osc import Receiver
    from memmlp.live.outputs.output import Outputs
    from memmlp.live.outputs.recorder import Recorder

    found: list[Output] = [vmc.VMC(Receiver(host, port or vmc.PORT, "--vmc")) for host, port in shown.vmc]
    found += [vrchat.VRChat(Receiver(host, port or vrchat.PORT, "--vrchat")) for host, port in shown.vrchat]
    if shown.record:
        network = stream.network
        found.append(Recorder(shown.record, network.body.rest, network.fps, note))
    return Outputs(found, note)


def page_files(avatar: str | None, stream: Stream) -> Mapping[str, File]:
    """Return the page's files, with those of an avatar if one is asked for."""
    from memmlp.live.session.page_server import FILES

    if avatar is None:
        return FILES
    from memmlp.live.session.avatar_files import avatar_files, mannequin_vrm, read_vrm

    return avatar_files(mannequin_vrm(stream.rest) if avatar == OWN else read_vrm(Path(avatar)))


def write_avatar(given: InputOptions, path: Path) -> None:
    """Write this project's own avatar with the network's body."""
    from memmlp.common.errors import InputError
    from memmlp.live.exported import ExportedNetwork
    from memmlp.motion.formats.vrm import write_vrm

    if path.suffix.lower() != ".vrm":
        raise InputError(f"--save-avatar {path}: no such kind of file; allowed: .vrm")
    if path.exists():
        raise InputError(f"--save-avatar {path}: is there already; allowed is a new file")
    file, _ = network_file(given)
    try:
        write_vrm(path, ExportedNetwork(file).body.rest)
    except OSError as error:
        raise InputError(f"--save-avatar {path}: cannot be written ({error.strerror})") from error
    click.echo(f"{path}: an avatar of VRM 1.0, which anybody may use (CC0)")


def note(line: str) -> None:
    """Print a remark to stderr."""
    click.echo(line, err=True)
