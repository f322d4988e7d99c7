"""Checkpoints in the formats that authors publish: made here of torch's own layers, imported and run."""

import os
import pickle
import struct
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import onnx
import pytest
import tiny
import torch
import torch.nn.functional as F
from command_line import BRIEF, run
from torch import Tensor, nn

from memmlp.common.components import find_component
from memmlp.config.open_run import open_run
from memmlp.deploy.export import make_metadata
from memmlp.deploy.opsets import OPSETS
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.geometry import (
    complete_columns,
    convert_almost_rotations,
    forward_kinematics,
    matrix_to_sixd,
    sixd_to_matrix,
)
from memmlp.motion.network_coordinates import World
from memmlp.motion.normalizer import Normalizer
from memmlp.networks import checkpoint
from memmlp.networks.hmd_poser import locate_hands
from memmlp.networks.motion_model import MotionModel
from memmlp.report.tables.build_table import find_imported_runs, list_official_values
from memmlp.runs import records
from memmlp.runs.lookup import list_runs
from memmlp.sweep.definition import Sweep, Variant

D, T, DEPTH, HEADS, WIDE = 16, 8, 2, 4, 24
X = tiny.clip(40)[None, :, :SPARSE_DIM].double()
pytestmark = pytest.mark.filterwarnings("ignore:enable_nested_tensor")


def make_mlp_head(inputs: int, size: int, activation: type[nn.Module] = nn.ReLU, width: int = D) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, width), activation(), nn.Linear(width, size))


def make_encoder(depth: int) -> nn.Module:
    return nn.TransformerEncoder(nn.TransformerEncoderLayer(D, HEADS, WIDE, batch_first=True), depth)


class Poser(nn.ModuleDict):
    """AvatarPoser, EgoPoser with `views`, or MANIKIN-S with other heads."""

    def __init__(self, root: str, inputs: int, views: bool, **more: int):
        self.heads = {root: 6, "joint_rotation_decoder": 126} | more
        super().__init__({
            "linear_embedding": nn.Linear(inputs, D), "transformer_encoder": make_encoder(DEPTH),
            **{name: make_mlp_head(D, size) for name, size in self.heads.items()},
        })  # fmt: skip
        self.views = views
        if views:
            self["linear_embedding_fast"] = nn.Linear(inputs, D // 2)
        else:
            self["body_model"] = nn.BatchNorm1d(3)  # another module's tensors are in the file, too

    def forward(self, x: Tensor) -> Tensor:
        x = x[:, -T:].clone()
        if self.views:
            x[..., [36, 37, 39, 40, 42, 43]] -= x[..., [36, 37] * 3]
            moved = x[..., [36, 37, 39, 40, 42, 43]]
            x = torch.cat([x, moved - moved[:, :1]], -1)
            x = self["linear_embedding"](x[:, ::2]) + self["linear_embedding"](x[:, T // 2 :])
        else:
            x = self["linear_embedding"](x)
        h = self["transformer_encoder"](x)[:, -1]
        return torch.cat([self[name](h) for name in self.heads], -1)[:, None]


class Mixer(nn.Module):
    """A block of AGRoL; with `embed`, for the diffusion model, of which the first merges its inputs."""

    def __init__(self, embed: bool, first: bool):
        super().__init__()
        self.fc0, self.fc1 = nn.Conv1d(T, T, 1), nn.Linear(D, D)
        self.norm0, self.norm1 = nn.LayerNorm(D), nn.LayerNorm(D)
        if embed:
            self.emb_fc = nn.Linear(D, D)
        if embed and first:
            self.conct = nn.Linear(2 * D, D)

    def forward(self, h: Tensor, time: Tensor | None = None) -> Tensor:
        if time is not None:
            h = (self.conct(h) if hasattr(self, "conct") else h) + self.emb_fc(F.silu(time))
        h = h + F.silu(self.fc0(self.norm0(h)))
        return h + F.silu(self.fc1(self.norm1(h)))


class Mixers(nn.ModuleDict):
    def __init__(self, embed: bool):
        super().__init__({"mlps": nn.ModuleList(Mixer(embed, i == 0) for i in range(DEPTH))})


class AGRoL(nn.ModuleDict):
    def __init__(self) -> None:
        parts = {"input_fc": nn.Linear(54, D), "motion_mlp": Mixers(False), "output_fc": nn.Linear(D, 132)}
        super().__init__(parts)

    def forward(self, x: Tensor) -> Tensor:
        h = self["input_fc"](x[:, -T:])
        for block in self["motion_mlp"]["mlps"]:
            h = block(h)
        return self["output_fc"](h)


class Denoiser(nn.ModuleDict):
    """AGRoL's diffusion model, called once, at time 0, with noise that the test sets."""

    noise: Tensor

    def __init__(self) -> None:
        super().__init__({
            "input_process": nn.Linear(132, D), "sparse_process": nn.Linear(54, D),
            "mlp": nn.ModuleDict({"motion_mlp": Mixers(True)}), "output_process": nn.Linear(D, 132),
        })  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        noisy = self["input_process"](self.noise).expand(len(x), -1, -1)
        h = torch.cat([self["sparse_process"](x[:, -T:]), noisy], -1)
        for block in self["mlp"]["motion_mlp"]["mlps"]:
            h = block(h, torch.tensor([0.0, 1.0] * (D // 2)).to(h))
        return self["output_process"](h)


SENSORS = ("head", "lhand", "rhand", "lfoot", "rfoot", "pelvis", "lhand_inhead", "rhand_inhead")


class HMD(nn.ModuleDict):
    """HMD-Poser, whose tokens of absent sensors are in the middle."""

    def __init__(self) -> None:
        def embed(name: str) -> nn.Module:
            unseen = name in ("lfoot", "rfoot", "pelvis")
            sizes = zip((6, 6, 3), (7, 7, 2), strict=True) if unseen else ((6, 4), (6, 4), (3, 4), (3, 4))
            return nn.ModuleList(nn.Sequential(nn.Linear(*size), nn.LeakyReLU()) for size in sizes)

        backbone = nn.ModuleDict({f"{name}_linear_embeddings": embed(name) for name in SENSORS})
        lstm = nn.ModuleList(nn.LSTM(D, D, batch_first=True) for _ in SENSORS)
        backbone.update({"norm": nn.LayerNorm(D, eps=1e-6), "time_encoder": nn.ModuleList([lstm])})
        backbone.update({"spatial_encoder": nn.ModuleList([make_encoder(1)])})
        heads = {"pose_est": 132, "shape_est": 16}
        super().__init__(
            {"backbone": backbone} | {k: make_mlp_head(8 * D, n, nn.LeakyReLU) for k, n in heads.items()}
        )

    def state_dict(self, *args, **options) -> dict[str, Tensor]:
        """As weight norm stores LSTMs: a gain and a direction of any length for each row."""
        state = {}
        for name, tensor in super().state_dict(*args, **options).items():
            if ".time_encoder." in name and ".weight_" in name:
                state[f"{name}_g"], state[f"{name}_v"] = tensor.norm(dim=1, keepdim=True), 3 * tensor
            else:
                state[name] = tensor
        return state

    def forward(self, x: Tensor) -> Tensor:
        backbone, tokens = self["backbone"], []
        rotation, turn = x[..., :18].split(6, -1), x[..., 18:36].split(6, -1)
        position, velocity = x[..., 36:45].split(3, -1), x[..., 45:54].split(3, -1)
        parts = dict(zip(SENSORS, zip(rotation, turn, position, velocity, strict=True), strict=False))
        locate = locate_hands(x)
        parts |= {f"{hand}_inhead": [one[..., i, :] for one in locate] for i, hand in enumerate(SENSORS[1:3])}
        for name in SENSORS:
            zeros = [x.new_zeros(*x.shape[:2], size) for size in (6, 6, 3)]
            pairs = zip(backbone[f"{name}_linear_embeddings"], parts.get(name, zeros), strict=True)
            tokens.append(backbone["norm"](torch.cat([layer(part) for layer, part in pairs], -1)))
        h = torch.stack([of(t)[0] for of, t in zip(backbone["time_encoder"][0], tokens, strict=True)], -2)
        h = backbone["spatial_encoder"][0](h.flatten(0, 1)).view(h.shape)
        return self["pose_est"](h.flatten(-2))


class Rolling(nn.ModuleDict):
    """RPM at a stream's first frame, after which it has no past."""

    def __init__(self) -> None:
        layer = nn.TransformerEncoderLayer(D, HEADS, WIDE, activation="gelu", batch_first=True)
        super().__init__({
            "input_process": nn.ModuleDict({"poseEmbedding": nn.Linear(132, D)}),
            "sparse_process": nn.ModuleDict({"poseEmbedding": nn.Linear(54, D)}),
            "xatt": nn.MultiheadAttention(D, HEADS, batch_first=True), "xatt_norm": nn.LayerNorm(D),
            "xatt_ff": nn.Linear(D, D), "seqTransEncoder": nn.TransformerEncoder(layer, DEPTH),
            "output_process": nn.ModuleDict({"poseFinal": nn.Linear(D, 132)}),
        })  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        angles = torch.arange(20)[:, None] / 10_000 ** (torch.arange(0, D, 2) / D)
        places = torch.stack([angles.sin(), angles.cos()], -1).flatten(1).to(x)
        past = self["input_process"]["poseEmbedding"](x.new_zeros(1, 20, 132)) + places
        seen = self["sparse_process"]["poseEmbedding"](x).expand(-1, 11, -1) + places[:11]
        h = self["xatt_norm"](past + self["xatt"](past, seen, seen)[0])
        return self["output_process"]["poseFinal"](self["seqTransEncoder"](h))[:, 10:11]


class ModulatedBlock(nn.ModuleDict):
    """A block of BoDiffusion, or of SAGE-Net with a ratio of 4."""

    def __init__(self, ratio: int = 1) -> None:
        parts = {"attn": {"qkv": nn.Linear(D, 3 * D), "proj": nn.Linear(D, D)}}
        parts |= {"mlp": {"fc1": nn.Linear(D, ratio * D), "fc2": nn.Linear(ratio * D, D)}}
        super().__init__({name: nn.ModuleDict(layers) for name, layers in parts.items()})
        self["adaLN_modulation"] = nn.Sequential(nn.SiLU(), nn.Linear(D, 6 * D))

    def forward(self, h: Tensor, time: Tensor) -> Tensor:
        changes = self["adaLN_modulation"](time)[:, None].chunk(6, -1)
        seen = F.layer_norm(h, [D], eps=1e-6) * (1 + changes[1]) + changes[0]
        parts = self["attn"]["qkv"](seen).unflatten(-1, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(*parts).transpose(1, 2).flatten(2)
        h = h + changes[2] * self["attn"]["proj"](attended)
        seen = F.layer_norm(h, [D], eps=1e-6) * (1 + changes[4]) + changes[3]
        return h + changes[5] * self["mlp"]["fc2"](F.gelu(self["mlp"]["fc1"](seen), approximate="tanh"))


def make_sines(time: int) -> Tensor:
    angles = time * torch.exp(-torch.log(torch.tensor(1e4)) * torch.arange(128) / 128)
    return torch.cat([angles.cos(), angles.sin()])[None]


class JointDenoiser(nn.ModuleDict):
    """BoDiffusion, called once for still motion at time 7."""

    def __init__(self) -> None:
        super().__init__({
            "embed_timestep": nn.ModuleDict({"mlp": make_mlp_head(256, D, nn.SiLU)}),
            "cond_emb": nn.ModuleDict({"projections": nn.Linear(3, 22, bias=False)}),
            "input_process": nn.ModuleDict({"poseEmbedding": nn.Linear(22 * 24, D)}),
            "blocks": nn.ModuleList(ModulatedBlock() for _ in range(DEPTH)),
            "out": nn.ModuleDict({"poseFinal": nn.Linear(D, 22 * 24), "featsFinal": nn.Linear(24, 12)}),
        })  # fmt: skip
        self.pos_embed = nn.Parameter(torch.randn(1, T, D))

    def forward(self, x: Tensor) -> Tensor:
        time = self["embed_timestep"]["mlp"](make_sines(7).to(x))
        mixed = self["cond_emb"]["projections"](x.unflatten(-1, (3, 18)).transpose(-1, -2)).transpose(-1, -2)
        joints = torch.cat([torch.ones_like(mixed[..., :6]), mixed], -1).flatten(-2)
        h = self["input_process"]["poseEmbedding"](joints) + self.pos_embed
        for block in self["blocks"]:
            h = block(h, time)
        return self["out"]["featsFinal"](self["out"]["poseFinal"](h).unflatten(-1, (22, 24)))


def denoise_still_motion(model: MotionModel, x: Tensor) -> Tensor:
    noise, variance = model.denoise(torch.ones(1, T, 132).to(x), torch.tensor([7]), x)
    return torch.cat([part.unflatten(-1, (22, 6)) for part in (noise, variance)], -1)


def group_by_tracker(x: Tensor) -> Tensor:
    parts = x.split([18, 18, 9, 9], -1)
    return torch.cat([part.unflatten(-1, (3, -1)) for part in parts], -1)


class JointLevel(nn.ModuleDict):
    """AvatarJLM; rotations of its coarse pose are those of tests/motion/test_geometry.py. Or MANIKIN-L."""

    def __init__(self, blocks: str = "B", size: int = 132) -> None:
        self.sound, names = blocks != "B", (f"ST{blocks}", f"TT{blocks}")
        lists = {name: nn.ModuleList(make_encoder(1) for _ in range(DEPTH)) for name in names}
        leaky = nn.LeakyReLU(0.1)
        head = nn.Sequential(nn.Linear(45 * D, 2 * D), nn.GroupNorm(8, 2 * D), leaky, nn.Linear(2 * D, size))
        coarse = nn.Sequential(nn.Linear(2 * D, 2 * D), leaky, nn.Linear(2 * D, 132))
        motion = nn.ModuleDict({"transformer": nn.ModuleDict(lists), "param_regressor": head})
        motion.temp_embed = nn.Parameter(torch.randn(1, 200, 1, D))
        motion.joint_position_embed = nn.Parameter(torch.randn(1, 1, 45, D))
        super().__init__({
            "linear_embedding_static": nn.Linear(396, 2 * D), "motion_net": motion,
            "joint_regressor": nn.ModuleDict({"regressor": coarse, "body_model": nn.BatchNorm1d(3)}),
            "position_embedding": nn.Linear(3, D), "rotation_embedding": nn.Linear(6, D),
            "input_token_embedding": nn.Linear(2 * D, D),
        })  # fmt: skip

    def place_joints(self, embedded: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        sixd = self["joint_regressor"]["regressor"](embedded).unflatten(-1, (22, 6))
        columns = sixd_to_matrix(sixd) if self.sound else complete_columns(sixd)
        pelvis = torch.zeros_like(columns[..., 0, :, 0])
        turned, _ = forward_kinematics(columns, pelvis, tiny.REST.to(columns))
        _, places = forward_kinematics(convert_almost_rotations(columns), pelvis, tiny.REST.to(columns))
        places, turned = places - places[..., 15:16, :], matrix_to_sixd(turned)
        places[..., [15, 20, 21], :] = seen[..., 12:15] - seen[..., :1, 12:15]
        turned[..., [15, 20, 21], :] = seen[..., :6]
        return places, turned

    def forward(self, x: Tensor) -> Tensor:
        seen, motion = group_by_tracker(x), self["motion_net"]
        joints = torch.full((*x.shape[:2], 22, 18), 0.01).to(x)
        joints[..., [15, 20, 21], :] = seen
        embedded = self["linear_embedding_static"](joints.flatten(-2))
        places, turned = self.place_joints(embedded, seen)
        tokens = self["position_embedding"](places), self["rotation_embedding"](turned)
        h = torch.cat([*tokens, self["input_token_embedding"](embedded)[..., None, :]], -2)
        h = h + motion.joint_position_embed + motion.temp_embed[:, :T]
        first = h[..., -1:, :]
        for over_joints, over_frames in zip(*motion["transformer"].values(), strict=True):
            h = torch.cat([over_joints(h[0])[None, :, :-1], first], -2)
            h = torch.cat([over_frames(h[0].transpose(0, 1)).transpose(0, 1)[None, :, :-1], first], -2)
        return motion["param_regressor"](h.flatten(-2)[0])[None]


class Condition(nn.ModuleDict):
    """The inputs of SAGE-Net's parts at half of the frames."""

    def __init__(self, width: int, **more: nn.Module) -> None:
        super().__init__({"cond_encoder": nn.Conv1d(3, 22, 1), "cond_encoder2": nn.Linear(396, width)} | more)

    def condition(self, x: Tensor, shorten: nn.Module) -> Tensor:
        mixed = self["cond_encoder"](group_by_tracker(x)[0]).flatten(1)
        return shorten(self["cond_encoder2"](mixed)[None])


class HalfDenoiser(Condition):
    def __init__(self, lower: bool) -> None:
        parts = {
            "embed_timestep": nn.ModuleDict({"mlp": make_mlp_head(256, D, nn.SiLU)}),
            "sparse_up_conv": nn.Conv1d(T, T // 2, 1), "down_dim": nn.Linear(D + 384, D),
            "blocks": nn.ModuleList(ModulatedBlock(4) for _ in range(DEPTH)), "last": nn.Linear(D, 384),
            "upper_align_net" if lower else "align_net": nn.Conv1d(T // 2, T // 2, 1),
        }  # fmt: skip
        parts |= {"down_dim_init": nn.Linear(768, 384)} if lower else {}
        super().__init__(D, denoiser_upper=nn.ModuleDict(parts))
        self.lower = lower

    def sample(self, x: Tensor, noise: Tensor, upper: Tensor | None) -> Tensor:
        """One step of deterministic DDIM, from time 25 of 50 to time 0."""
        part = self["denoiser_upper"]
        latent = noise if upper is None else part["down_dim_init"](torch.cat([upper, noise], -1))
        latent = part["upper_align_net" if self.lower else "align_net"](latent)
        h = part["down_dim"](torch.cat([self.condition(x, part["sparse_up_conv"]), latent], -1))
        for block in part["blocks"]:
            h = block(h, part["embed_timestep"]["mlp"](make_sines(25).to(x)))
        clean = part["last"](h)
        steps = torch.tensor([0.0, 26.0, 1.0], dtype=torch.float64) / 50
        start, here, there = ((steps + 0.008) / 1.008 * torch.pi / 2).cos().square()
        here, there = (here / start).float(), (there / start).float()  # the schedule is float32
        return there.sqrt() * clean + (1 - there).sqrt() * (noise - here.sqrt() * clean) / (1 - here).sqrt()


class StackBlock(nn.ModuleDict):
    """A block of SAGE-Net's decoder."""

    def __init__(self) -> None:
        attention = {name: nn.Linear(D, D) for name in ("key", "query", "value", "proj")}
        mlp = nn.Sequential(nn.Linear(D, 4 * D), nn.GELU(), nn.Linear(4 * D, D), nn.Dropout())
        norms = {name: nn.LayerNorm(D) for name in ("ln1", "ln2")}
        super().__init__({"attn": nn.ModuleDict(attention), "mlp": mlp} | norms)

    def forward(self, h: Tensor) -> Tensor:
        layers, seen = self["attn"], self["ln1"](h)
        parts = (layers[name](seen).unflatten(-1, (HEADS, -1)) for name in ("query", "key", "value"))
        attended = F.scaled_dot_product_attention(*(part.transpose(1, 2) for part in parts))
        h = h + layers["proj"](attended.transpose(1, 2).flatten(2))
        return h + self["mlp"](self["ln2"](h))


class PoseDecoder(Condition):
    """SAGE-Net's decoder."""

    def __init__(self) -> None:
        stack = nn.ModuleDict({
            "pos": nn.ModuleList([nn.Identity()]), "up_conv": nn.ModuleDict(
                {"conv": nn.ConvTranspose1d(D, D, 3, 2)}
            ),
            "blocks": nn.ModuleList(StackBlock() for _ in range(DEPTH)), "ln_f": nn.LayerNorm(D),
            "head": nn.Linear(D, D, bias=False),
        })  # fmt: skip
        angles = torch.arange(T)[:, None] / 10_000 ** (torch.arange(0, D, 2) / D)
        pe = torch.stack([angles.sin(), angles.cos()], -1).flatten(1)[None]
        stack["pos"][0].register_buffer("pe", pe)
        heads = {"reg_body": make_mlp_head(D, 126), "reg_root": make_mlp_head(D, 6)}
        shorten, stem = nn.Conv1d(T, T // 2, 1), nn.Linear(3 * 384, D)
        stacks = nn.ModuleList([stack])
        super().__init__(384, sparse_up_conv=shorten, post_quant_emb=stem, decoder_stacks=stacks, **heads)

    def forward(self, upper: Tensor, lower: Tensor, x: Tensor) -> Tensor:
        (stack,), seen = self["decoder_stacks"], self.condition(x, self["sparse_up_conv"])
        h = self["post_quant_emb"](torch.cat([seen, upper, lower], -1))
        h = h + stack["pos"][0].pe[:, : T // 2]
        for block in stack["blocks"]:
            h = block(h)
        h = stack["up_conv"]["conv"](h.transpose(1, 2))[..., 1:].transpose(1, 2)
        h = stack["head"](stack["ln_f"](h))[:, -1:]
        return torch.cat([self["reg_root"](h), self["reg_body"](h)], -1)


class Stratified(nn.ModuleDict):
    """SAGE-Net, sampled with noise that the test sets."""

    noise: Tensor

    def __init__(self) -> None:
        parts = {"upper": HalfDenoiser(False), "lower": HalfDenoiser(True), "decoder": PoseDecoder()}
        super().__init__({f"{name}_state_dict": part for name, part in parts.items()})

    def make_file(self) -> dict[str, object]:
        return {"epoch": 3} | {name: part.state_dict() for name, part in self.items()}

    def forward(self, x: Tensor) -> Tensor:
        upper_part, lower_part, decoder = self.values()
        upper = upper_part.sample(x, self.noise[:1].to(x), None)
        return decoder(upper, lower_part.sample(x, self.noise[1:].to(x), upper), x)


TRANSFORMER = {"depth": DEPTH, "heads": HEADS, "width": D, "feedforward": WIDE, "dropout": 0.1}
RELEASED = {
    "avatar_poser": (lambda: Poser("stabilizer", 54, False), {"frames": T, **TRANSFORMER}),
    "ego_poser": (lambda: Poser("global_orientation_decoder", 60, True), {"frames": T, **TRANSFORMER}),
    "manikin_s": (
        lambda: Poser(
            "stabilizer", 54, False, joint_rotation_decoder=60, swivel_decoder=8, ankle_position_decoder=12
        ),
        {"frames": T, **TRANSFORMER},
    ),
    "manikin_l": (partial(JointLevel, "Eblocks", 212), {"frames": T, "heads": HEADS, "dropout": 0.1}),
    "agrol_mlp": (AGRoL, {}),
    "agrol_diffusion": (Denoiser, {"diffusion_steps": 50, "sampling_steps": 1, "sampler": "posterior"}),
    "hmd_poser": (HMD, {"frames": T, "heads": HEADS, "dropout": 0.1, "shape_weight": 0.1}),
    "rpm": (Rolling, {"frames": 20, "bounded_first": True, "own_dropout": False, **TRANSFORMER}),
    "avatar_jlm": (JointLevel, {"frames": T, "heads": HEADS, "dropout": 0.1, "coarse_weight": 1.0}),
    "sage": (Stratified, {
        "heads": HEADS, "code_heads": HEADS, "dropout": 0.1, "diffusion_steps": 50, "sampling_steps": 2,
        "sampler": "strided", "noise": 0.01, "noise_seed": 0,
    }),
    "bodiffusion": (JointDenoiser, {"heads": HEADS, "sampling_steps": 2, "noise_weight": 1.0}),
}  # fmt: skip


def make_released(name: str) -> nn.Module:
    torch.manual_seed(1)
    return RELEASED[name][0]().eval()


def make_file(released: nn.Module) -> dict[str, object]:
    if isinstance(released, Stratified):
        return released.make_file()
    return {"state_dict": released.state_dict(), "epoch": 3}


def import_tensors(name: str, path: Path) -> MotionModel:
    network, (_, sizes) = find_component("model", name), RELEASED[name]
    tensors, release = checkpoint.read_published(path), network.settings.release
    found = {key.split(".")[1]: n for key, n in checkpoint.find_published_sizes(tensors, release).items()}
    settings = network.make_settings({**sizes, **found})
    model = network.kind(Normalizer.from_coordinates(World(), tiny.REST), settings)
    tensors = network.kind.adapt_published(tensors)
    renamed = checkpoint.rename_published(tensors, release, dict(model.named_parameters()))
    model.load_state_dict(renamed, strict=False)
    return model.eval().double()


@pytest.mark.parametrize("name", RELEASED)
@torch.no_grad()
def test_an_imported_network_computes_what_the_released_layers_compute(name: str, tmp_path: Path) -> None:
    released = make_released(name)
    torch.save(make_file(released), tmp_path / "net.pth")
    model = import_tensors(name, tmp_path / "net.pth")
    noise = getattr(model, "noise", torch.zeros(1))[0]
    released.double().noise = getattr(model, "noises", noise)
    inputs = {"avatar_poser": X, "ego_poser": X, "manikin_s": X, "rpm": X[:, :1]}.get(name, X[:, -T:])
    expected = released(inputs)
    if name == "bodiffusion":
        computed = denoise_still_motion(model, inputs)
    elif name.startswith("manikin"):  # what its limb solver gets
        computed = model.predict_parts(inputs[:, -T:])
    else:
        motion, _ = model.advance(inputs, model.initial_state(1), expected.shape[1])
        computed = motion[..., :132]
    torch.testing.assert_close(computed, expected, atol=1e-7, rtol=1e-6)


@pytest.fixture
def sound(tmp_path: Path) -> dict[str, Tensor]:
    return make_released("agrol_mlp").state_dict()


class Code:
    def __reduce__(self):
        return os.mkdir, ("executed",)


def write_zip(path: Path, compression: int) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("net/data.pkl", pickle.dumps({"a": 1}))


HOSTILE = {
    "code": lambda path, sound: torch.save(Code(), path),
    "truncated": lambda path, sound: (torch.save(sound, path), os.truncate(path, path.stat().st_size // 2)),
    "text": lambda path, sound: path.write_text("version https://git-lfs.github.com/spec/v1"),
    "header of 2 GB": lambda path, sound: path.write_bytes(struct.pack("<Q", 2**31) + b"{" * 64),
    "long pickle": lambda path, sound: path.write_bytes(b"\x80\x04\x8e" + struct.pack("<Q", 2**31) + b"x"),
    "compressed": lambda path, sound: write_zip(path, zipfile.ZIP_DEFLATED),
    "missing key": lambda path, sound: (sound.pop("motion_mlp.mlps.1.fc1.weight"), torch.save(sound, path)),
    "foreign key": lambda path, sound: torch.save(sound | {"decoder.weight": torch.ones(3)}, path),
    "other shape": lambda path, sound: torch.save(sound | {"output_fc.bias": torch.ones(131)}, path),
    "other network": lambda path, sound: torch.save(make_released("avatar_poser").state_dict(), path),
    "NaN": lambda path, sound: (sound["input_fc.bias"].fill_(torch.nan), torch.save(sound, path)),
    "wide in little": lambda path, sound: torch.save(
        sound | {"input_fc.weight": torch.ones(1).expand(2**40, 54)}, path
    ),
    "deep in little": lambda path, sound: torch.save(
        sound | {f"motion_mlp.mlps.{i}.fc0.weight": torch.ones(1) for i in range(9999)}, path
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_bad_checkpoint_is_one_line_and_leaves_nothing(kind: str, sound: dict[str, Tensor], tmp_path: Path):
    path = tmp_path / "net.pth"
    HOSTILE[kind](path, sound)
    text = run(tmp_path, "import-weights", "agrol_mlp", "net.pth", *BRIEF, code=2)
    assert text.startswith("memmlp: net.pth: ")
    assert text.count("\n") == 1
    assert len(text) < 300
    assert os.listdir(tmp_path) == ["net.pth"]


def test_only_networks_with_a_release_are_imported(tmp_path: Path) -> None:
    assert "agrol_mlp" in run(tmp_path, "import-weights", "vae_hmd", "net.pth", code=2)
    assert "net.pth" in run(tmp_path, "import-weights", "agrol_mlp", "net.pth", code=2)
    alone = ["imported_weights=0123456789abcdef", "model=agrol_mlp", "model.depth=1", *BRIEF[2:]]
    assert "imported_weights" in run(tmp_path, "train", "profile=tiny", *alone, code=2)


def check_official_rows(outputs: Path) -> None:
    """The imported run stands between the published value and the missing training."""
    variant = Variant("AGRoL-Diffusion", ("model=agrol_diffusion",), paper={"MPJPE": 3.71})
    sweep = Sweep("t", "T", 1, (), ("data=synth",), (0,), (variant,), variant.label, ("MPJPE",))
    (imported,) = find_imported_runs(outputs)
    (row,) = list_official_values(sweep, {}, [imported], ["window"])
    both = (f"{imported.get_value('window', one, 'MPJPE'):.2f}" for one in ("authors", "rotation"))
    assert row == (variant.label, "window", "MPJPE", "3.71", *both, "not measured")
    elsewhere = replace(sweep, base=("data=amass_s1",))
    (row,) = list_official_values(elsewhere, {}, [imported], ["window"])
    assert row == (variant.label, "", "MPJPE", "3.71", *["not measured"] * 3)


def test_the_command_makes_a_finished_run_that_names_its_origin(tmp_path: Path) -> None:
    released = make_released("agrol_diffusion")
    torch.save(released.state_dict(), tmp_path / "net.pt")
    torch.save(torch.full((132,), 0.5), tmp_path / "mean.pt")
    torch.save(torch.full((132,), 0.1), tmp_path / "std.pt")
    options = ["--mean", "mean.pt", "--std", "std.pt", "evaluation.modes=[window]", "export.graph=off"]
    text = run(tmp_path, "import-weights", "agrol_diffusion", "net.pt", *BRIEF[2:], *options, "profile=tiny")
    (found,) = list_runs(tmp_path / "outputs")
    assert found.complete
    assert found.id in text
    origin = records.read(found.manifest_path, records.Manifest)["imported"]
    assert (origin["model"], origin["file"]) == ("agrol_diffusion", "net.pt")
    tensors, _ = checkpoint.read(found.model)
    torch.testing.assert_close(tensors["model.normalizer.mean"][54:186], torch.full((132,), 0.5))
    assert not tensors["model.normalizer.mean"][:54].any()
    opened = open_run(tmp_path / "outputs", found.id)
    assert "net.pt" in make_metadata(opened.network(), found.id)["weights"]
    check_official_rows(tmp_path / "outputs")
    repeated = run(
        tmp_path, "import-weights", "agrol_diffusion", "net.pt", *BRIEF[2:], *options, "profile=tiny"
    )
    assert found.id in repeated
    assert len(list_runs(tmp_path / "outputs")) == 1


REFINED = "sage with its refiner"
SAGE = ["model.heads=4", "model.code_heads=4", "model.diffusion_steps=50", "model.sampling_steps=2"]
FEW_HEADS, FEW_FRAMES = f"model.heads={HEADS}", f"model.frames={T}"
OPTIONS = {
    "agrol_mlp": [], "agrol_diffusion": [], "hmd_poser": [FEW_HEADS], "rpm": [FEW_HEADS],
    "avatar_poser": [FEW_HEADS, FEW_FRAMES], "ego_poser": [FEW_HEADS, FEW_FRAMES],
    "manikin_s": [FEW_HEADS, FEW_FRAMES], "manikin_l": [FEW_HEADS, FEW_FRAMES],
    "avatar_jlm": [FEW_HEADS, FEW_FRAMES], "sage": SAGE, REFINED: [*SAGE, "--refiner", "refiner.pth.tar"],
    "bodiffusion": [FEW_HEADS, "model.sampling_steps=2", "model.offline=false", "export.graph=auto"],
}  # fmt: skip


def make_refiner_file() -> dict[str, object]:
    parts = nn.ModuleDict({"refine_net": nn.GRU(132, 8, 2, batch_first=True), "linear": nn.Linear(8, 132)})
    return {"epoch": 3, "state_dict": parts.state_dict()}


@pytest.mark.long
@pytest.mark.parametrize("kind", OPTIONS)
def test_an_imported_network_streams_is_exported_and_timed(kind: str, tmp_path: Path) -> None:
    """In the oldest and the newest opset; its costs and errors stand in official tables."""
    name = "sage" if kind == REFINED else kind
    torch.save(make_file(make_released(name)), tmp_path / "net.pth")
    torch.save(make_refiner_file(), tmp_path / "refiner.pth.tar")
    words = ["import-weights", name, "net.pth", *BRIEF[2:], *OPTIONS[kind], "profile=tiny"]
    words = [word for word in words if not word.startswith("model.depth")]
    opsets = (15, min(OPSETS[-1], onnx.defs.onnx_opset_version()))
    words += ["evaluation.modes=[stream,window]", "export.latency_steps=2"]
    for opset in opsets:
        run(tmp_path, *words, f"export.opset={opset}")
    (imported,) = find_imported_runs(tmp_path / "outputs")
    graphs = [onnx.load(path) for path in imported.run.folder.rglob("step.onnx")]
    assert {one.version for graph in graphs for one in graph.opset_import if not one.domain} == set(opsets)
    source = find_component("model", name).settings.release.source
    assert all(source in str(graph.metadata_props) for graph in graphs)
    variant = Variant("V", (f"model={name}", *(["refiner=sage"] if kind == REFINED else [])))
    sweep = Sweep("t", "T", 1, (), ("data=synth",), (0,), (variant,), variant.label, ("MPJPE", "ms"))
    for mode in ("stream", "window"):
        error, time = list_official_values(sweep, {}, [imported], [mode])
        assert float(error.imported) > 0
        assert (error.authors == "-") == (name in ("ego_poser", "rpm"))  # they leave out these short clips
        assert time.imported == f"{imported.get_value('', '', 'ms'):.2f}"
    words = f"model={name}", "refiner=sage" if kind != REFINED else "refiner=null"
    changed = replace(sweep, variants=(replace(variant, overrides=words),))
    assert list_official_values(changed, {}, [imported], ["window"])[0].imported == "not measured"
