"""AMASS: the names of its clips, which its releases write differently, and what its names tell.

Three namings are known. The first SMPL+H release has folders like `BioMotionLab_NTroje` and `MPI_HDM05`, and
files that end in `_poses`. Later downloads call the folders `BMLrub` and `HDM05`. The SMPL-X release has
those folders, files that end in `_stageii`, and `_` where a name had a blank. BABEL's paths, and archives
that are unpacked each into a folder of its own, have the subset's folder twice, as in
`BMLrub/BioMotionLab_NTroje/...`.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable

RENAMED = {
    "bmlrub": "biomotionlabntroje",
    "dfaust": "dfaust67",
    "hdm05": "mpihdm05",
    "mosh": "mpimosh",
    "poseprior": "mpilimits",
    "ssm": "ssmsynced",
    "tcdhands": "tcdhandmocap",
    "transitions": "transitionsmocap",
}
"""Later name of a subset -> its first one, both in lower case and without `_`."""

SUFFIX = re.compile(r"_(?:poses|stageii)$", re.IGNORECASE)


def subset(name: str) -> str:
    """Return the subset of a clip's or a subset's name: equal for all names that it ever had."""
    top = name.split("/")[0].lower().replace("_", "")
    return RENAMED.get(top, top)


def unpacked(name: str) -> str:
    """Return a clip's name without the folder of an archive around the folder of the subset itself."""
    archive, _, rest = name.partition("/")
    return rest if rest.count("/") and subset(archive) == subset(rest) else name


def clip_key(name: str) -> str:
    """Return what is equal for all names of one clip, whichever release they are from, but for case."""
    _, _, rest = unpacked(name).partition("/")
    return f"{subset(unpacked(name))}/{SUFFIX.sub('', rest.replace(' ', '_'))}"


S2_TRAIN = (
    "CMU", "MPI_Limits", "TotalCapture", "Eyes_Japan_Dataset", "KIT", "BioMotionLab_NTroje", "BMLmovi",
    "EKUT", "ACCAD", "MPI_mosh", "SFU", "MPI_HDM05",
)  # fmt: skip
S2_TEST = ("HumanEva", "Transitions_mocap")
"""Protocol S2: the subsets to train on, and to test on."""

AMASS = frozenset(map(subset, (*S2_TRAIN, *S2_TEST)))
"""The subsets of protocol S2 as `subset` names them."""


def divided_subjects(parts: Iterable[tuple[str, str]]) -> list[str]:
    """Return AMASS' subjects, SUBSET/SUBJECT, of whom clips are both in training and in test.

    Args:
        parts: clips' names and parts.
    """
    found: dict[str, set[str]] = defaultdict(set)
    for name, part in parts:
        folders = unpacked(name).split("/")[:-1]
        if len(folders) >= 2 and subset(name) in AMASS:
            found["/".join(folders[:2])].add(part)
    return sorted(subject for subject, of in found.items() if {"train", "test"} <= of)
