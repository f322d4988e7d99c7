"""The numbers that every component makes of fixed inputs, for tests/test_golden.py. `make golden` writes that
file. It refuses where a component's numbers changed and its version did not: raise that first, in its
declaration or in memmlp/runs/identity.py, in the same commit."""

import json
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import tiny
import torch
from golden_trained import Numbers, frames, optimised, parts, refiner, summary, training, vqvae
from tiny_tasks import OPTIM, TASKS
from torch import Tensor

from memmlp.deploy import latency
from memmlp.deploy.export import export
from memmlp.deploy.lower_precision import write_lower_precision
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import stream_onnx
from memmlp.evaluation import metrics
from memmlp.evaluation import modes as evaluation
from memmlp.evaluation.ik import IK, LBFGS, Arms, NoIK
from memmlp.evaluation.modes import Evaluation
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.clip import Clip
from memmlp.motion.dataset import MirroredDataset, WindowSampler
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.network_coordinates import Heading, HeadRelative, World
from memmlp.motion.normalizer import Normalizer
from memmlp.motion.synthetic import ACTIVITIES, synthesize, synthesize_clip
from memmlp.networks import predictor
from memmlp.networks.constant_pose import ConstantPose, ConstantPoseSettings
from memmlp.networks.memory import GRUMemory, LSTMMemory, NoMemory
from memmlp.networks.motion_model import MotionModel
from memmlp.networks.own_past_memory import CodeMemory, JointCodeMemory, MemoryWithoutCodes
from memmlp.networks.recurrent_poser import CELLS
from memmlp.networks.streaming import make_streaming_graph
from memmlp.runs.identity import find_version
from memmlp.training import losses
from memmlp.training.compute import measure_step
from memmlp.training.loop import seed_step
from memmlp.training.losses import Loss, MotionLoss, NoHandTerm, TermsLoss
from memmlp.training.losses.baseline_losses import AGRoLLossSettings, AvatarPoserLossSettings
from memmlp.training.losses.terms import ERRORS, TERMS
from memmlp.training.optim import Muon, Optim, ScheduleFree
from memmlp.training.rollout import OwnPredictions, PersistentStreams, Rollout, TeacherForcing

PATH = Path(__file__).with_name("golden.json")
BOTH = frozenset({"rotation", "position"})


def pair() -> tuple[Tensor, Tensor]:
    """A prediction and the truth (B, T, 252), two windows of nine frames each."""
    return tuple(torch.stack([tiny.clip(9, seed), tiny.clip(9, seed + 1)]) for seed in (1, 5))  # type: ignore[return-value]


def synthetic() -> Numbers:
    """Each activity's motion, and the lengths of a folder's clips."""
    clips = {name: synthesize_clip(name, 3, seconds=1.0) for name in ACTIVITIES}
    with tempfile.TemporaryDirectory() as folder:
        paths = synthesize(Path(folder), minutes=0.05, seed=1)
        lengths = torch.tensor([len(read_clip(path, path.stem)) for path in paths])
    return {
        **summary("lengths", lengths),
        **{name: value for kind, clip in clips.items() for name, value in _clip(kind, clip).items()},
    }


def _clip(name: str, clip: Clip) -> Numbers:
    """The numbers of a clip's rotations and of its place."""
    rotations, place = torch.from_numpy(clip.poses), torch.from_numpy(clip.trans)
    return summary(f"{name} rotations", rotations) | summary(f"{name} place", place)


def features() -> Numbers:
    clip = tiny.clip(12)
    fitted = Normalizer.fit(World(), tiny.REST, clip)
    return summary("frames", clip) | summary("encoded", fitted.encode(clip[None]))


def coordinates(kind: type[World]) -> Numbers:
    normalizer, clip = tiny.normalizer(kind()), tiny.clip(12)[None]
    origin = normalizer.find_origin(clip[..., :SPARSE_DIM])
    encoded = normalizer.encode(clip)
    motion = encoded[..., SPARSE_DIM:] + 0.1
    return summary("encoded", encoded) | summary("decoded", normalizer.decode_motion(motion, origin))


def network(model: MotionModel, seed: int = 7) -> Numbers:
    """A training call with its gradients, then two windows and three frames as live."""
    clip = torch.stack([tiny.clip(80, seed) for seed in range(2)])
    torch.manual_seed(seed)
    model.train()
    past, new = clip[:, : model.past_frames], clip[:, model.past_frames : model.past_frames + model.frames]
    motion, _, terms = model.compute_training_outputs(new[..., :SPARSE_DIM], model.true_state(past), new)
    (motion.square().mean() + sum(terms.values(), torch.zeros(()))).backward()
    slopes = torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None])
    found = summary("learned", motion) | summary("slopes", slopes)
    found |= {name: float(term.detach()) for name, term in terms.items()}
    return found | _used(model.eval(), clip)


@torch.no_grad()
def _used(model: MotionModel, clip: Tensor) -> Numbers:
    state, size, found = model.initial_state(2), model.frames, {}
    for start, stop in ((0, size), (size, 2 * size), *((2 * size + i, 2 * size + i + 1) for i in range(3))):
        motion, state = model.advance(clip[:, start:stop, :SPARSE_DIM], state)
        found |= summary(f"at {stop}", motion)
    return found


def sampler() -> Numbers:
    found = {}
    for drawn_by in ("frames", "clips"):
        draws = WindowSampler(frames(), batch=32, window=50, seed=1, drawn_by=drawn_by)
        for step in range(2):
            for name, values in zip(("clip", "end"), draws.draw(step), strict=True):
                found |= summary(f"{drawn_by} {name} {step}", values)
    return found


def mirror() -> Numbers:
    clips, ends = torch.tensor([3, 1, 5]), torch.tensor([20, 30, 44])
    return summary("frames", MirroredDataset(frames()).read_stretches(clips, ends, 9))


def schedule(name: str) -> Numbers:
    optim = Optim(steps=20, batch=1, lr=1e-2, final_lr=1e-4, schedule=name, drop_at=0.6)
    return {str(step): optim.compute_factor(step) for step in range(20)}


def rollout(make: Callable[[], Rollout]) -> Numbers:
    """The calls of three steps, with the network's own motion."""
    model, slot, split = tiny.model(MemoryWithoutCodes), make(), frames()
    slot.begin(model)
    draws, found = WindowSampler(split, batch=2, window=7, seed=0), {}
    for step in range(3):
        seed_step(0, step)
        call = slot.draw(model, split, draws, step)
        slot.keep(model.advance(call.sparse, call.state)[1])
        found |= summary(f"sparse {step}", call.sparse) | summary(f"truth {step}", call.true_frames)
        # only what the call recalls, the newest frames of the window that ends before it
        found |= summary(f"history {step}", call.state["motion"][:, -model.frames :])
    return found


def loss(make: Callable[[], Loss]) -> Numbers:
    predicted, true = pair()
    motion = predicted[..., SPARSE_DIM:].clone().requires_grad_()
    one = make()
    total, terms = one(motion, true[..., SPARSE_DIM:], true[..., :SPARSE_DIM], tiny.normalizer(Heading()))
    total.backward()
    groups = [len(group["params"]) for group in one.weighting.parameter_groups()]
    found = {name: float(term.detach()) for name, term in terms.items()} | {"learned": float(sum(groups))}
    return found | {"total": float(total.detach())} | summary("slope", motion.grad)


def steps_compute() -> Numbers:
    """The FLOPs of a training step of several networks, and of two optimisers."""
    found = {}
    for name in ("own", "recurrent forced", "avatar_poser", "hmd_poser", "upper_codes"):
        found[name] = measure_step(TASKS[name](), OPTIM).network
    muon = Muon(steps=12, batch=4, lr=1e-3)
    return found | {"muon": measure_step(TASKS["forced"](optim=muon), muon).optimiser}


def loss_of_network() -> Numbers:
    given = (torch.ones(1, 1, size) for size in (198, 198, 54))
    return {"total": float(losses.LossOfNetwork()(*given, tiny.normalizer())[0])}


def mixed() -> Numbers:
    """A loss under autocast, which computes it in float32."""
    with torch.autocast("cpu", torch.bfloat16):
        return loss(partial(TermsLoss, "absolute", **dict.fromkeys(TERMS, 0.5)))


def weighted(make: Callable[[], Loss]) -> Numbers:
    """A loss, and its terms' weights after a step."""
    one = make()
    found = loss(lambda: one)
    for parameter in one.parameters():
        parameter.data -= 0.1 * torch.sign(parameter.grad)
    return found | {f"weight {name}": value for name, value in one.weighting.weights().items()}


def hand(term: NoHandTerm | losses.PositionHandTerm | losses.KinematicHandTerm) -> Numbers:
    predicted, true = pair()
    terms = term(
        predicted[..., SPARSE_DIM:], true[..., SPARSE_DIM:], true[..., :SPARSE_DIM], tiny.normalizer(World())
    )
    return {name: float(value) for name, value in terms.items()} | {"terms": float(len(terms))}


def measured() -> Numbers:
    predicted, true = tiny.clip(30, 1)[:, SPARSE_DIM:], tiny.clip(30, 5)
    report = evaluation.measure_clip(tiny.normalizer(World()), predicted, true)
    found = {f"{branch} {name}": value for branch, of in report.items() for name, value in of.items()}
    turned = evaluation.extract_rotations(predicted)
    return found | metrics.measure_rotations(turned, evaluation.extract_rotations(true[:, SPARSE_DIM:]))


def mode(name: str) -> Numbers:
    """The predictions of a mode for clips of unequal length, and the mean of their reports."""
    model, split = tiny.model(MemoryWithoutCodes), frames()
    found = {}
    for i, motion in enumerate(evaluation.MODE_FUNCTIONS[name](model, split.read_clips())):
        found |= summary(f"clip {i}", motion)
    mean = Evaluation([name], 2, NoIK(), 0).report(model, split, name)["mean"]["rotation"]
    return found | {key: mean[key] for key in ("MPJPE", "Jitter")}


def ik(solver: IK) -> Numbers:
    """A few frames solved for the position branch, or for the trackers of the hands."""
    predicted, true = tiny.clip(6, 1), tiny.clip(6, 5)
    motion = torch.cat([predicted[:, SPARSE_DIM:][:, :132], true[:, SPARSE_DIM:][:, 132:]], 1)
    (solved,) = solver.solutions(tiny.normalizer(World()), motion, true[:, :SPARSE_DIM]).values()
    return summary("solved", solved)


GRAPHS: dict[str, Callable] = {
    "graph.streaming": make_streaming_graph,
    "graph.naive": lambda network: network,
}


def deployed(graph: str) -> Numbers:
    """An exported stream on a clip, and its multiply-adds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step.onnx"
        path.write_bytes(exported(graph))
        motion = stream_onnx(OnnxStream(path), tiny.clip(25))
    return summary("motion", motion) | {"macs": float(latency.count_macs(GRAPHS[graph](tiny.model())))}


@cache
def exported(graph: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step.onnx"
        export(GRAPHS[graph](tiny.model()), path, "0" * 16)
        return path.read_bytes()


def lowered(precision: str) -> Numbers:
    with tempfile.TemporaryDirectory() as folder:
        exact, other = (Path(folder) / f"{name}.onnx" for name in ("exact", "other"))
        exact.write_bytes(exported("graph.streaming"))
        write_lower_precision(precision, exact, other, make_streaming_graph(tiny.model()), [tiny.clip(40)])
        return summary("motion", stream_onnx(OnnxStream(other), tiny.clip(25)))


CASES: dict[str, Callable[[], Numbers]] = {
    "generator.puppet": synthetic,
    "features": features,
    **{
        f"coordinates.{name}": partial(coordinates, kind)
        for name, kind in (("heading", Heading), ("head_relative", HeadRelative), ("world", World))
    },
    "model.mem_mlp": lambda: network(tiny.model(NoMemory, predictor.RotationOnlySettings)),
    **{
        f"model.{name}": partial(lambda name: network(tiny.baseline(name)), name)
        for name in tiny.BASELINES
    },
    # the seed draws diffusion times 0 and 5: removing the noise of later times magnifies rounding
    "model.bodiffusion": lambda: network(tiny.baseline("bodiffusion"), seed=51),
    "model.constant_pose": lambda: network(
        ConstantPose(tiny.normalizer(Heading()), ConstantPoseSettings(frames=7))
    ),
    "model.recurrent_poser": lambda: {
        f"{cell}{' ' + output if output != 'local' else ''} {name}": value
        for cell, output in [*((cell, "local") for cell in CELLS), ("gru", "global"), ("gru", "reaching")]
        for name, value in network(tiny.recurrent_poser(cell=cell, output=output)).items()
    },
    **{
        f"memory.{name}": partial(lambda kind: network(tiny.model(kind)), kind)
        for name, kind in {
            "vq": CodeMemory, "vq_joint": JointCodeMemory, "no_codes": MemoryWithoutCodes, "lstm": LSTMMemory,
            "gru": GRUMemory, "none": NoMemory,
        }.items()
    },
    **{
        f"predictor.{kind.name}": partial(lambda kind: network(tiny.model(MemoryWithoutCodes, kind)), kind)
        for kind in (
            predictor.TwoBranchSettings, predictor.TwoBranchMemorySettings, predictor.RotationOnlySettings,
            predictor.RotationOnlyMemorySettings,
        )
    },
    "refiner.sage": refiner,
    "prerequisite.sage": parts,
    "vqvae": vqvae,
    **{f"codebook.{name}": partial(vqvae, name) for name in ("ema", "gradient")},
    "sampler": sampler,
    "mirror": mirror,
    "training": training,
    **{f"schedule.{name}": partial(schedule, name) for name in ("step", "cosine", "milestones")},
    "optim.muon": partial(optimised, Muon),
    "optim.schedule_free": partial(optimised, ScheduleFree),
    "ema": partial(optimised, ema=0.5),
    "warmup": partial(optimised, warmup=3),
    "precision.bf16": mixed,
    "compute": steps_compute,
    "rollout.teacher_forcing": partial(rollout, TeacherForcing),
    "rollout.own_predictions": partial(rollout, partial(OwnPredictions, 2)),
    "rollout.streams": partial(rollout, partial(PersistentStreams, 4)),
    **{
        f"loss.{name}": partial(weighted, partial(lambda make: MotionLoss(make(), NoHandTerm(), BOTH), make))
        for name, make in {
            "uncertainty": partial(losses.UncertaintyWeights, 0.01), "manual": losses.ManualWeights,
        }.items()
    },
    "loss.agrol": lambda: {
        f"{error} {name}": value
        for error in ("norm", "square")
        for name, value in loss(partial(losses.AGRoLLoss, AGRoLLossSettings(error))).items()
    },
    "loss.avatar_poser": lambda: {
        f"{anchor} {name}": value
        for anchor in ("pelvis", "head")
        for name, value in loss(
            partial(losses.AvatarPoserLoss, AvatarPoserLossSettings(anchor=anchor))
        ).items()
    },
    "loss.rpm": lambda: loss(losses.RPMLoss),
    "loss.of_network": loss_of_network,
    "loss.terms": lambda: {
        f"{error} {name}": value
        for error in ERRORS
        for name, value in loss(partial(TermsLoss, error, **dict.fromkeys(TERMS, 0.5))).items()
    },
    "weighting.learned": partial(
        weighted, partial(TermsLoss, weighting="learned", rotation=2.0, velocity=30.0)
    ),
    "hand.position": lambda: hand(losses.PositionHandTerm()),
    "hand.fk": lambda: hand(losses.KinematicHandTerm()),
    "hand.off": lambda: hand(NoHandTerm()),
    "metrics": measured,
    "mode.stream": partial(mode, "stream"),
    "mode.window": partial(mode, "window"),
    "ik.lbfgs": partial(ik, LBFGS(4)),
    "ik.arms": partial(ik, Arms()),
    "graph.streaming": partial(deployed, "graph.streaming"),
    "graph.naive": partial(deployed, "graph.naive"),
    **{precision: partial(lowered, precision) for precision in ("int8", "fp16")},
}  # fmt: skip
UNSEEN = ("export", "latency")
"""Components without numbers: a file format, and times."""


def changed(now: Mapping[str, float], before: Mapping[str, float], tolerance: float) -> list[str]:
    """The names of the numbers that differ by more than processors do."""
    close = {
        name: np.isclose(now[name], before[name], rtol=tolerance, atol=1e-2 * tolerance)
        for name in now.keys() & before.keys()
    }
    return sorted((now.keys() ^ before.keys()) | {name for name, same in close.items() if not same})


def tolerance(case: str) -> float:
    """The relative difference between processors: larger in low precision, which rounds up or down."""
    return 2e-2 if case in ("int8", "fp16", "optim.muon") else 2e-4


def numbers(case: str) -> Numbers:
    """The current numbers of a component, on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return CASES[case]()
    finally:
        torch.set_num_threads(threads)


def stored() -> dict[str, dict[str, Any]]:
    return json.loads(PATH.read_text()) if PATH.exists() else {}


def record() -> None:
    """Write golden.json; exits with 1 if numbers changed or disappeared under an unchanged version. New
    numbers of an unchanged version are added."""
    before, now = stored(), {case: numbers(case) for case in CASES}
    same = [case for case in CASES if before.get(case, {}).get("recipe") == find_version(case)]
    known = {case: before[case]["numbers"] for case in same}
    wrong = [case for case, old in known.items() if old.keys() & changed(now[case], old, tolerance(case))]
    if wrong:
        sys.exit(f"raise the version of {', '.join(wrong)}: their numbers changed")
    kept = {one: {"recipe": find_version(one), "numbers": now[one] | known.get(one, {})} for one in CASES}
    PATH.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    record()
