"""The live stream: the numbers of evaluation, in every space, and what happens to disturbed trackers. Bounds
are a little above what was measured. A comment beside each bound gives that, and what it would be without the
treatment that is tested."""

import sys
from pathlib import Path

import exported
import numpy as np
import onnx
import pytest
import tiny
import wearer
from processes import finished
from scipy.spatial.transform import Rotation

import memmlp
from memmlp.common.errors import InputError
from memmlp.deploy.export import export
from memmlp.evaluation.ik import LBFGS
from memmlp.evaluation.modes import extract_positions, extract_rotations, predict_stream
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Pose, Stream
from memmlp.live.tracker_input import SampleWarning
from memmlp.live.tracker_resampling import make_t_pose
from memmlp.live.wearer import Offsets
from memmlp.motion.body import HEAD, SPARSE_DIM
from memmlp.motion.network_coordinates import Heading
from memmlp.networks.streaming import make_streaming_graph
from memmlp.runs.run import Run

pytestmark = pytest.mark.slow

FRAMES = 240
TIMES = np.arange(FRAMES) / 60
PERSON = wearer.person(TIMES)


@pytest.fixture(scope="module")
def network():
    return wearer.at_ease(tiny.model(coordinates=Heading()), PERSON.frames)


@pytest.fixture(scope="module")
def file(network, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("avatar") / "step.onnx"
    export(make_streaming_graph(network), path, "0123456789abcdef")
    return path


@pytest.fixture(scope="module")
def undisturbed(file) -> np.ndarray:
    """Return the joints (240, 22, 3) of the undisturbed 60 Hz stream."""
    return wearer.joints(wearer.play(Stream(file), PERSON.positions, PERSON.rotations))


def test_inverse_kinematics_bring_the_pose_to_the_position_branch(network, file):
    solved = wearer.play(Stream(file, ik=LBFGS()), PERSON.positions[:20], PERSON.rotations[:20])
    frames = PERSON.frames[:19]
    motion = predict_stream(network, [frames])[0]
    expected = LBFGS().solutions(network.normalizer, motion, frames[:, :SPARSE_DIM])["combined"]
    there = network.normalizer.compute_positions(expected, frames[:, :SPARSE_DIM]).numpy()
    assert wearer.apart(wearer.joints(solved[1:]), there).max() < 0.1


def largest_difference(network, file: Path) -> float:
    """Return the largest difference of rotations, positions and joints between a stream and evaluation."""
    poses = wearer.play(Stream(file), PERSON.positions, PERSON.rotations)[1:]
    motion = predict_stream(network, [PERSON.frames])[0]
    pairs = [
        (wearer.joints(poses), network.normalizer.compute_positions(motion, PERSON.frames[:, :SPARSE_DIM])),
        (np.stack([pose.position_branch for pose in poses]), extract_positions(motion)),
        (np.stack([pose.rotations for pose in poses]), extract_rotations(motion)),
    ]
    return max(float(np.abs(ours - theirs.numpy()).max()) for ours, theirs in pairs)


def test_it_is_evaluations_stream(network, file, undisturbed, step_files):
    assert largest_difference(network, file) < 1e-4
    np.testing.assert_allclose(undisturbed[:, HEAD], PERSON.positions[:, 0], atol=1e-6)
    no_position_branch = exported.NETWORKS["recurrent_poser"]()
    assert largest_difference(no_position_branch, step_files("recurrent_poser")) < 1e-4


CHANGING = np.concatenate([np.arange(0, 1, 1 / 90), np.arange(1, 2, 1 / 30), np.arange(2, 4, 1 / 120)])
RATES = {  # Hz: times, bounds on mean and most, cm; beside: measured; with the newest sample as frame
    "30": (np.arange(0, 4, 1 / 30), 1.6, 7.5),  # 1.54, 7.18; 16.8, 34.2
    "72": (np.arange(0, 4, 1 / 72), 0.12, 0.85),  # 0.112, 0.827; 7.5, 32.6
    "90, 30, 120": (CHANGING, 0.4, 7.5),  # 0.375, 7.18; 5.7, 34.2
    "120": (np.arange(0, 4, 1 / 120), 1e-3, 1e-3),  # every second sample is a frame
}


def play_at(file: Path, times: np.ndarray) -> list[Pose]:
    person = wearer.person(times)
    return wearer.play(Stream(file), person.positions, person.rotations, times)


@pytest.mark.parametrize("rate", RATES)
def test_other_rates(rate, file, undisturbed):
    times, mean, most = RATES[rate]
    times = times[times <= TIMES[-1] + 1e-9]
    poses = play_at(file, times)
    assert all(-5e-4 <= time - pose.time < 1 / 60 for time, pose in zip(times, poses, strict=True))
    found = {round(60 * pose.time): pose for pose in poses if pose.fresh}
    error = wearer.apart(wearer.joints(list(found.values())), undisturbed[list(found)])
    assert error.mean() < mean
    assert error.max() < most


def test_what_is_not_newer_is_ignored(file):
    """At 72 Hz each sample that is not ignored counts for the frames on both sides of it."""
    times = np.arange(0, 1, 1 / 72)
    person, stream = wearer.person(times), Stream(file)
    for index, expected in enumerate(play_at(file, times)):
        sample = list(zip(person.positions[index], person.rotations[index], strict=True))
        np.testing.assert_array_equal(stream.step(*sample, times[index]).positions, expected.positions)
        for late in (times[index], times[index] - 0.1):
            again = stream.step(*zip(PERSON.positions[0], PERSON.rotations[0], strict=True), late)
            assert (again.fresh, again.time) == (False, expected.time)
            np.testing.assert_array_equal(again.positions, expected.positions)


def test_times_in_whole_milliseconds_make_a_frame_a_sample(file, undisturbed):
    """Without a tolerance for rounding, every third frame would come a sample late."""
    poses = play_at(file, np.round(TIMES, 3))
    assert all(pose.fresh for pose in poses)
    assert wearer.apart(wearer.joints(poses), undisturbed).max() < 0.2  # 0.15
    # At 30 Hz there are two frames a sample. With time=None the next sample is one frame later.
    stream = Stream(file)
    poses = wearer.play(stream, PERSON.positions[::2], PERSON.rotations[::2], TIMES[::2])
    assert all(pose.fresh for pose in poses)
    last = stream.step(*zip(PERSON.positions[-1], PERSON.rotations[-1], strict=True))
    assert last.time == pytest.approx(poses[-1].time + 1 / 60)


def test_after_a_gap_or_a_reset_the_stream_is_as_a_new_one(file, undisturbed):
    """A clock that is set back is a gap, too."""
    stream = Stream(file)
    for jump in (0.6, -0.6, 1e6):
        stream.reset()
        wearer.play(stream, PERSON.positions[100:160], PERSON.rotations[100:160], TIMES[:60])
        later = TIMES[59] + jump + TIMES[:60]
        poses = wearer.play(stream, PERSON.positions[:60], PERSON.rotations[:60], later)
        assert [pose.restarted for pose in poses] == [True] + [False] * 59
        assert wearer.apart(wearer.joints(poses), undisturbed[:60]).max() < 1e-3
    stream.reset()
    again = wearer.play(stream, PERSON.positions[:60], PERSON.rotations[:60])
    np.testing.assert_array_equal(wearer.joints(again), undisturbed[:60])


@pytest.mark.parametrize(
    ("trackers", "during", "speed"),  # cm and cm/s; measured 7.5, 46.5 and 2516, 3903
    [((1,), 8, 3000), ((0,), 48, 4500)],
)
def test_lost_trackers_are_held_and_come_back(trackers, during, speed, file, undisturbed):
    """They are lost for half a second. Without a smooth return the fastest joint would have 7585 and 12736
    cm/s; undisturbed it has 1340."""
    lost = {index: trackers for index in range(100, 130)}
    poses = wearer.play(Stream(file), PERSON.positions, PERSON.rotations, lost=lost)
    names = tuple(("head", "left", "right")[tracker] for tracker in trackers)
    assert [pose.held for pose in poses] == [names if i in lost else () for i in range(FRAMES)]
    joints = wearer.joints(poses)
    error = wearer.apart(joints, undisturbed)
    assert error[100:130].mean() < during
    assert error[160:190].max() < 1  # 0.91 and 0.35
    assert wearer.fastest(joints[129:160]) < speed


@pytest.mark.parametrize("name", SPACES)
def test_calibration_finds_how_the_devices_sit(name, file):
    """It does so in any heading; positions up to the devices' mean distance, which a T-pose can't tell."""
    space, stream = SPACES[name], Stream(file, space=name)
    turns = Rotation.random(3, rng=4).as_matrix()
    sits = np.array([[0, 0.08, 0.1], [0.05, 0.02, 0], [-0.05, 0.02, 0]])  # metres from the joints, body axes
    shifts = -(turns @ (sits * space.body)[:, :, None])[..., 0]

    def devices(positions, rotations):
        away = (rotations @ sits[:, :, None])[..., 0]
        turned = space.convert_rotations_from_amass(rotations) @ turns.swapaxes(1, 2)
        return [*zip(space.convert_positions_from_amass(positions + away), turned, strict=True)]

    pose = make_t_pose(stream.network.body, np.array([0.3, -0.2, 1.6]), 2.1)
    with pytest.warns(SampleWarning, match="138 degrees from upright"):
        offsets = stream.calibrate(*devices(pose.positions, pose.rotations))
    np.testing.assert_allclose(offsets.rotations, turns, atol=1e-9)
    mean = (pose.rotations @ sits[:, :, None])[..., 0].mean(0)
    rotations = np.stack([rotation for _, rotation in devices(pose.positions, pose.rotations)])
    missing = (rotations @ (offsets.positions - shifts)[:, :, None])[..., 0]
    np.testing.assert_allclose(missing, np.tile(space.convert_positions_from_amass(mean), (3, 1)), atol=1e-9)
    exact = Stream(file, space=name, offsets=Offsets(shifts, turns))
    plain = Stream(file, space=name)
    positions = space.convert_positions_from_amass(PERSON.positions)
    rotations = space.convert_rotations_from_amass(PERSON.rotations)
    for index in range(20):
        expected = plain.step(*zip(positions[index], rotations[index], strict=True)).positions
        found = exact.step(*devices(PERSON.positions[index], PERSON.rotations[index])).positions
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_devices_that_no_t_pose_has_there_are_not_calibrated(file):
    """Exchanged controllers, hanging arms and centimetres would move every later pose silently."""
    space, stream = SPACES["unity"], Stream(file, space="unity")

    def devices(positions: np.ndarray, rotations: np.ndarray) -> list:
        turned = space.convert_rotations_from_amass(rotations)
        return [*zip(space.convert_positions_from_amass(positions), turned, strict=True)]

    for heading, tilt in ((0.0, 0), (2.1, 40), (-3.0, -40)):
        pose = make_t_pose(stream.network.body, np.array([0.3, -0.2, 1.6]), heading)
        tilted = pose.rotations @ Rotation.from_euler("x", tilt, degrees=True).as_matrix()
        head, left, right = devices(pose.positions, tilted)
        before = stream.offsets
        with pytest.raises(InputError, match=r"calibrate: .*exchanged"):
            stream.calibrate(head, right, left)
        assert stream.offsets is before
        before = stream.calibrate(head, left, right)
    arms = 0.4 * pose.positions + 0.6 * pose.positions[0] - [[0, 0, 0], [0, 0, 0.7], [0, 0, 0.7]]
    centimetres = r"is \d{4} cm .* positions are in metres"
    for wrong, said in ((arms, r"calibrate: \w+ is \d\d cm"), (100 * pose.positions, centimetres)):
        with pytest.raises(InputError, match=said):
            stream.calibrate(*devices(wrong, pose.rotations))
        assert stream.offsets is before


def test_quaternions_in_another_order_are_warned_of(file):
    """A head that seems to hang or to lie is no person in T-pose, unless the device is mounted so."""
    space, stream = SPACES["openxr"], Stream(file, space="openxr")
    pose = make_t_pose(stream.network.body, np.array([0.3, -0.2, 1.6]), 0.4)
    places = space.convert_positions_from_amass(pose.positions)
    xyzw = matrix_to_quaternion(space.convert_rotations_from_amass(pose.rotations))
    stream.calibrate(*zip(places, xyzw, strict=True))
    with pytest.warns(SampleWarning, match=r"calibrate: the head's device is \d+ degrees .* xyzw") as warned:
        offsets = stream.calibrate(*zip(places, np.roll(xyzw, 1, axis=1), strict=True))
    assert warned[0].filename == __file__
    assert stream.offsets is offsets
    tilted = pose.rotations @ Rotation.from_euler("z", 70, degrees=True).as_matrix()
    with pytest.warns(SampleWarning, match="head's device is 70 degrees from upright"):
        stream.calibrate(*zip(places, space.convert_rotations_from_amass(tilted), strict=True))


def test_a_long_stream_does_not_drift(file):
    stream, rounds = Stream(file), []
    for number in range(4):
        times = number * (FRAMES - 1) / 60 + TIMES[1:]
        poses = wearer.play(stream, PERSON.positions[1:], PERSON.rotations[1:], times)
        rounds.append(wearer.joints(poses))
    assert np.isfinite(rounds).all()
    np.testing.assert_allclose(rounds[-1][60:], rounds[1][60:], atol=1e-4)


def test_it_needs_no_torch(file):
    code = (
        "import memmlp, sys, numpy as np; one = ((0, 0, 1.6), np.eye(3));"
        f"memmlp.Stream({str(file)!r}).step(one, one, one);"
        "print(sorted({'torch', 'onnx', 'scipy'} & set(sys.modules)))"
    )
    ran = finished([sys.executable, "-c", code])
    assert ran.stdout == "[]\n", ran.stderr


def test_a_run_or_its_folder_is_a_source(file, tmp_path):
    place = Run(tmp_path).deployment("fp32-0")
    place.folder.mkdir(parents=True)
    place.onnx.write_bytes(file.read_bytes())
    place.finish({})
    for source in (tmp_path, str(tmp_path), Run(tmp_path)):
        assert memmlp.Stream(source).network.frames == 7
    with pytest.raises(AttributeError, match="Streams"):
        _ = memmlp.Streams


def test_bad_arguments_are_rejected(file, step_files):
    one, two = ([0, 0, 1.6], np.eye(3)), ([0, 0, 0], [0, 0, 0, 2])
    for make, words in (
        (lambda: Stream(file, space="up"), "space="), (lambda: Stream(file, space=["amass"]), "space="),
        (lambda: Stream(None), "source="), (lambda: Stream(5), "source="), (lambda: Stream(""), "source="),
        (lambda: Stream(file, rotations="euler"), "rotations=euler"),
        (lambda: Stream(file, offsets=Offsets(np.zeros(3), np.eye(3))), "offsets: must be positions"),
        (lambda: Stream(file).calibrate(one, one, one), "calibrate: the hands are not apart"),
        (lambda: Stream(file).calibrate(one, None, one), r"calibrate: .*left"),
        (lambda: Stream(file).step(one, two, one), "left: quaternion has norm 2"),
        (lambda: Stream(file).step(one, one, one, "1.0"), "time="),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            make()


def test_bad_files_are_refused(file, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        Stream(tmp_path)
    with pytest.raises(InputError, match=r"source=recurent_poser: .* recurrent_poser$"):
        Stream("recurent_poser")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(InputError, match=r"text\.onnx"):
        Stream(tmp_path / "text.onnx")
    known = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
    old = {key: value for key, value in known.items() if key != "rest"}
    bad = [("rest", "[1]"), ("rest", "{"), ("fps", "0"), ("fps", "x"), ("T", "1.5")]
    damaged = [(known | {key: value}, "damaged") for key, value in bad]
    for props, words in ((old, "rest; export it again"), ({}, r"this\.onnx"), *damaged):
        graph = onnx.load(file)
        del graph.metadata_props[:]
        onnx.helper.set_model_props(graph, props)
        onnx.save(graph, tmp_path / "this.onnx")
        with pytest.raises(InputError, match=words):
            Stream(tmp_path / "this.onnx")
