"""BVH files: what is read, what is refused, and the kinematics against a naive loop."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import ORDERS, POSITIONS, Sample, person
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from memmlp.common.errors import InputError
from memmlp.motion.formats.bvh import MAX_JOINTS, Bvh, read_bvh

NUMBER = st.floats(-300, 300).map(lambda x: round(x, 4))
QUICK = settings(
    max_examples=30,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "some clip.bvh"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@st.composite
def samples(draw: st.DrawFn) -> Sample:
    """Any tree of up to 7 joints, with 0 to 6 channels of any order each, and up to 3 frames."""
    count = draw(st.integers(1, 7))
    parents = [-1]
    for joint in range(1, count):  # in the order of a walk, as a file lists them
        line = [joint - 1]
        while parents[line[-1]] >= 0:
            line.append(parents[line[-1]])
        parents.append(draw(st.sampled_from(line)))
    triple = st.lists(NUMBER, min_size=3, max_size=3)
    channels = [
        tuple(draw(st.permutations([*POSITIONS, *ORDERS[0]]))[: draw(st.integers(0, 6))])
        for _ in range(count)
    ]
    channels[0] = channels[0] or ORDERS[3]
    width, frames = sum(map(len, channels)), draw(st.integers(1, 3))
    values = np.array(draw(st.lists(NUMBER, min_size=width * frames, max_size=width * frames)))
    leaves = [joint for joint in range(count) if joint not in parents]
    return Sample(
        names=[f"joint{joint}" for joint in range(count)],
        parents=parents,
        offsets=[draw(triple) for _ in range(count)],
        ends=[(joint, draw(triple)) for joint in leaves],
        channels=channels,
        values=values.reshape(frames, width),
    )


def turn(axis: str, degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array(
        {
            "X": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "Y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "Z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


def naive_kinematics(sample: Sample) -> tuple[np.ndarray, np.ndarray]:
    """Compute the kinematics one frame and one joint at a time, by 4 x 4 matrices."""
    frames = []
    for row in sample.values:
        numbers, world = iter(row), []
        for parent, offset, channels in zip(sample.parents, sample.offsets, sample.channels, strict=True):
            shift, rotation = np.array(offset), np.eye(3)
            for channel in channels:
                if channel in POSITIONS:
                    shift[POSITIONS.index(channel)] = next(numbers)
                else:
                    rotation = rotation @ turn(channel[0], next(numbers))
            local = np.eye(4)
            local[:3, :3], local[:3, 3] = rotation, shift
            world.append(local if parent < 0 else world[parent] @ local)
        for parent, offset in sample.ends:
            local = np.eye(4)
            local[:3, 3] = offset
            world.append(world[parent] @ local)
        frames.append(world)
    return np.array(frames)[:, :, :3, :3], np.array(frames)[:, :, :3, 3]


@QUICK
@given(samples())
def test_reads_what_was_written(tmp_path: Path, sample: Sample) -> None:
    bvh = read_bvh(write(tmp_path, sample.text()))
    assert bvh.names == tuple(sample.names)
    assert bvh.parents == tuple(sample.parents)
    assert bvh.channels == tuple(sample.channels)
    np.testing.assert_array_equal(bvh.offsets, sample.offsets)
    np.testing.assert_array_equal(bvh.values, sample.values)
    read_ends = {end.parent: (end.name, end.offset.tolist()) for end in bvh.ends}
    assert read_ends == {joint: (f"joint{joint}.end", offset) for joint, offset in sample.ends}
    assert bvh.node_parents == bvh.parents + tuple(end.parent for end in bvh.ends)


@QUICK
@given(samples())
def test_kinematics_equals_a_naive_loop(tmp_path: Path, sample: Sample) -> None:
    bvh = read_bvh(write(tmp_path, sample.text()))
    order = [end.parent for end in bvh.ends]
    sample.ends.sort(key=lambda end: order.index(end[0]))
    for computed, expected in zip(bvh.kinematics(), naive_kinematics(sample), strict=True):
        np.testing.assert_allclose(computed, expected, atol=1e-9)


def test_zero_pose_is_kinematics_without_rotation(tmp_path: Path) -> None:
    bvh = read_bvh(write(tmp_path, person("cmu_daz", 2, 0).text()))
    rotations, positions = bvh.kinematics()
    np.testing.assert_array_equal(rotations[0], np.tile(np.eye(3), (len(bvh.nodes), 1, 1)))
    np.testing.assert_allclose(positions[0] - positions[0, 0], bvh.zero_pose(), atol=1e-9)
    assert np.ptp(bvh.zero_pose()[:, 1]) > 100


def test_first_channel_is_the_outermost_rotation(tmp_path: Path) -> None:
    """Z, then X: the tip on X goes to Y by Z alone; were X outermost, it would go on to Z."""
    channels = ("Zrotation", "Xrotation")
    sample = Sample(["a"], [-1], [[0.0, 0, 0]], [(0, [1.0, 0, 0])], [channels], np.array([[90.0, 90.0]]))
    positions = read_bvh(write(tmp_path, sample.text())).kinematics()[1]
    np.testing.assert_allclose(positions[0, 1], [0, 1, 0], atol=1e-12)


def equal(a: Bvh, b: Bvh) -> bool:
    return a.nodes == b.nodes and a.channels == b.channels and np.array_equal(a.values, b.values)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", " \t\r\n", "\n\n", "\r\r\n"])
def test_line_ends(tmp_path: Path, end: str) -> None:
    sample = person("cmu_daz", 3, 1)
    plain = read_bvh(write(tmp_path, sample.text()))
    assert equal(read_bvh(write(tmp_path, sample.text(end=end))), plain)


def test_mixed_line_ends_tabs_blanks_case_and_byte_order_mark(tmp_path: Path) -> None:
    sample = person("cmu_daz", 3, 1)
    plain = read_bvh(write(tmp_path, sample.text()))
    lines = sample.text().splitlines()
    mixed = "".join(f"\t {line} \t" + ["\n", "\r\n", "\r", "\n\n"][n % 4] for n, line in enumerate(lines))
    assert equal(read_bvh(write(tmp_path, "\ufeff" + mixed.replace(" ", "\t "))), plain)
    assert equal(read_bvh(write(tmp_path, sample.text().replace("\n{", " {"))), plain)
    for word in ("HIERARCHY", "OFFSET", "JOINT", "ROOT", "End Site", "MOTION", "CHANNELS", "rotation"):
        assert equal(read_bvh(write(tmp_path, sample.text().replace(word, word.swapcase()))), plain)


@pytest.mark.parametrize("frames", ["Frames: {}", "Frames:\t{}", "FRAMES:{}", "frames :  {}", "Frames: 00{}"])
@pytest.mark.parametrize("time", ["Frame Time: {}", "Frame Time:\t{}", "FRAME TIME:{}", "frametime : {}"])
def test_motion_headers(tmp_path: Path, frames: str, time: str) -> None:
    sample = person("cmu_daz", 3, 1)
    assert len(read_bvh(write(tmp_path, sample.text(frames=frames, time=time)))) == 3


@pytest.mark.parametrize(
    ("dt", "fps"),
    [
        ("0.00833333", 120),
        ("0.0083333", 120),
        ("0.0166667", 60),
        ("0.033333", 30),
        ("0.016683", 1 / 0.016683),
        ("0.0333", 30),
        ("3.33e-2", 30),
        ("0.033", 30),
        ("0.0417", 24),
        ("0.0167", 60),
        ("0.01667", 60),
        ("0.0111", 90),
        ("0.0083", 120),
        ("0.00833", 120),
        ("0.0042", 240),
        ("0.03337", 1 / 0.03337),  # 29.97, and so not 30
        ("0.0334", 1 / 0.0334),
        ("0.03330", 1 / 0.03330),  # with a digit more it is not 30
        ("0.0166", 60),  # cut off, not rounded
        ("0.01666", 60),
        ("0.0416", 24),
        ("0.0041", 240),
        ("0.0160", 62.5),
        ("0.016", 62.5),
        ("0.008", 125),
        ("0.006", 1 / 0.006),  # one digit tells no rate
    ],
)
def test_frame_rate(tmp_path: Path, dt: str, fps: float) -> None:
    assert read_bvh(write(tmp_path, person("cmu_daz", 1, 1).text(dt=dt))).fps == fps


SMALL = """HIERARCHY
ROOT hip
{
OFFSET 0 0 0
CHANNELS 3 Zrotation Xrotation Yrotation
JOINT knee
{
OFFSET 0 -40 0
CHANNELS 1 Xrotation
End Site
{
OFFSET 0 -41 0
}
}
}
MOTION
Frames: 2
Frame Time: 0.01
1 2 3 4
5 6 7 8
"""
DAMAGE = {
    "no hierarchy": ("HIERARCHY", "HIERACHY", "line 1"),
    "no brace": ("ROOT hip\n{", "ROOT hip", "line 3"),
    "no closing brace": ("}\n}\n}", "}\n}", "before its time"),
    "brace too many": ("}\n}\n}", "}\n}\n}\n}", "line 16"),
    "no motion": ("MOTION\n", "", "MOTION"),
    "twice a name": ("JOINT knee", "JOINT hip", "line 6"),
    "name of an end site": ("ROOT hip", "ROOT knee.end", "line 10: name 'knee.end'"),
    "second end site": ("-41 0\n}", "-41 0\n}\nEnd Site\n{\nOFFSET 0 1 0\n}", "line 14: name 'knee.end'"),
    "no name": ("JOINT knee\n", "JOINT\n", "line 7"),
    "second root": ("}\nMOTION", "}\nROOT b\n{\nOFFSET 0 0 0\nCHANNELS 0\n}\nMOTION", "line 16"),
    "two numbers": ("OFFSET 0 -40 0", "OFFSET 0 -40", "line 9: 'CHANNELS'"),
    "no number": ("OFFSET 0 -40 0", "OFFSET 0 forty 0", "'forty'"),
    "NaN offset": ("OFFSET 0 -40 0", "OFFSET 0 nan 0", "'nan'"),
    "huge offset": ("OFFSET 0 -40 0", "OFFSET 0 4e7 0", "'4e7'"),
    "seven channels": ("CHANNELS 1", "CHANNELS 7", "'7'"),
    "unknown channel": ("CHANNELS 1 Xrotation", "CHANNELS 1 Wrotation", "'Wrotation'"),
    "channel twice": ("3 Zrotation Xrotation", "3 Zrotation Zrotation", "'Zrotation'"),
    "too few channels": ("CHANNELS 3", "CHANNELS 2", "line 5: 'Yrotation'"),
    "no site": ("End Site", "End", "line 11"),
    "no frames line": ("Frames: 2\n", "", "line 17: 'Frame Time: 0.01'"),
    "no frames": ("Frames: 2", "Frames: 0", "line 17: Frames: '0'"),
    "negative frames": ("Frames: 2", "Frames: -2", "'-2'"),
    "frames in words": ("Frames: 2", "Frames: two", "'two'"),
    "half a frame": ("Frames: 2", "Frames: 1.5", "'1.5'"),
    "wrong count": ("Frames: 2", "Frames: 3", "Frames: 3, but 2"),
    "line too many": ("Frames: 2", "Frames: 1", "Frames: 1, but 2"),
    "absurd count": ("Frames: 2", "Frames: 999999999999", "line 17"),
    "zero frame time": ("0.01", "0", "line 18: Frame Time: '0'"),
    "long frame time": ("0.01", "10", "0.001 to 1 s"),
    "NaN frame time": ("0.01", "nan", "'nan'"),
    "no frame time": ("Frame Time: 0.01\n", "", "Frame Time:"),
    "value missing": ("5 6 7 8", "5 6 7", "line 20: 3 values; allowed: 4"),
    "value too many": ("5 6 7 8", "5 6 7 8 9", "line 20: 5 values; allowed: 4"),
    "NaN": ("5 6 7 8", "5 6 NaN 8", "line 20: 'NaN'"),
    "infinity": ("5 6 7 8", "5 6 -inf 8", "line 20: '-inf'"),
    "huge": ("5 6 7 8", "5 6 1e300 8", "line 20: '1e300'"),
    "word": ("5 6 7 8", "5 6 seven 8", "line 20: 'seven'"),
    "underscore": ("5 6 7 8", "5 6 7_0 8", "line 20: '7_0'"),
    "comma": ("5 6 7 8", "5 6 7,5 8", "line 20: '7,5'"),
    "no values": ("1 2 3 4\n5 6 7 8\n", "", "Frames: 2, but 0"),
    "no channels": ("3 Zrotation Xrotation Yrotation\n", "0\n", "line 19: 4 values"),
}


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as error:
        read_bvh(path)
    message = str(error.value)
    assert message.startswith(str(path))
    assert len(message.splitlines()) == 1
    assert "; allowed: " in message
    return message


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_named(tmp_path: Path, damage: str) -> None:
    old, new, said = DAMAGE[damage]
    assert old in SMALL
    assert len(read_bvh(write(tmp_path, SMALL))) == 2
    assert said in refusal(write(tmp_path, SMALL.replace(old, new, 1)))


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    assert "0xff" in refusal(write(tmp_path, SMALL.encode().replace(b"knee", b"kn\xffe")))
    assert "line 20" in refusal(write(tmp_path, SMALL.encode().replace(b" 8", b" \xb2")))
    refusal(write(tmp_path, np.random.default_rng(0).bytes(5000)))
    refusal(write(tmp_path, b"\0" * 5000))
    refusal(write(tmp_path, b""))


def test_files_that_are_none(tmp_path: Path) -> None:
    refusal(tmp_path)
    refusal(tmp_path / "missing.bvh")


def test_files_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("memmlp.motion.formats.bvh.MAX_BYTES", len(SMALL) - 1)
    assert "too large" in refusal(write(tmp_path, SMALL))


@pytest.mark.parametrize(
    ("limit", "value", "said"),
    [("MAX_HEAD", 50, "no MOTION line in its first"), ("MAX_LINE", 20, "line 5: too long"),
     ("MAX_VALUES", 5, "too many frames")],
)  # fmt: skip
def test_what_is_read_is_bounded(
    limit: str, value: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"memmlp.motion.formats.bvh.{limit}", value)
    assert said in refusal(write(tmp_path, SMALL))


def test_deep_and_wide_hierarchies(tmp_path: Path) -> None:
    def chain(depth: int) -> str:
        joints = "".join(f"JOINT j{n} {{ OFFSET 0 1 0 CHANNELS 0\n" for n in range(depth))
        return SMALL.replace("End Site", joints + "}" * depth + "\nEnd Site")

    assert len(read_bvh(write(tmp_path, chain(MAX_JOINTS - 2))).names) == MAX_JOINTS
    assert f"{MAX_JOINTS} joints" in refusal(write(tmp_path, chain(MAX_JOINTS - 1)))
    refusal(write(tmp_path, chain(100_000)))
