"""The names of AMASS' clips, which differ between its releases.

Three namings are known. The first SMPL+H release has folders like `BioMotionLab_NTroje` and `MPI_HDM05`, and
files that end in `_poses`. Later downloads name the folders `BMLrub` and `HDM05`. The SMPL-X release has
those folders, files that end in `_stageii`, and `_` in place of blanks. BABEL's paths, and archives that are
each unpacked into a folder, have another folder in front, as in `BMLrub/BioMotionLab_NTroje/...` or
`archive-1/CMU/...`.
"""

from __future__ import annotations

import re
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
    """Return the subset of a clip's or a subset's name, the same for all names that the subset ever had."""
    top = name.split("/")[0].lower().replace("_", "")
    return RENAMED.get(top, top)


S1 = ("CMU", "BioMotionLab_NTroje", "MPI_HDM05")
"""Protocol S1: the subsets that have lists."""

S2_TRAIN = (
    "CMU", "MPI_Limits", "TotalCapture", "Eyes_Japan_Dataset", "KIT", "BioMotionLab_NTroje", "BMLmovi",
    "EKUT", "ACCAD", "MPI_mosh", "SFU", "MPI_HDM05",
)  # fmt: skip
S2_TEST = ("HumanEva", "Transitions_mocap")
"""Protocol S2: the subsets to train on, and to test on."""

FOLDERS = frozenset((
    *S2_TRAIN, *S2_TEST, "PosePrior", "EyesJapanDataset", "BMLrub", "MoSh", "HDM05", "Transitions",
    "DFaust_67", "DFaust", "DanceDB", "SSM_synced", "SSM", "TCD_handMocap", "TCDHands", "BMLhandball", "CNRS",
    "GRAB", "HUMAN4D", "MOYO", "SOMA", "WEIZMANN",
))  # fmt: skip
"""The subsets' folders as the releases spell them."""

PROTOCOLS = {"amass_s1": S1, "amass_s3": (*S2_TRAIN, *S2_TEST)}
"""Option of `data` -> the subsets that it must have to be complete."""


def strip_archives(name: str) -> str:
    """Return a clip's name without the folders of archives above the subset's own folder."""
    archive, _, rest = name.partition("/")
    if "/" not in rest:
        return name
    twice = subset(archive) == subset(rest)
    within = archive not in FOLDERS and rest.split("/")[0] in FOLDERS and rest.count("/") > 1
    return strip_archives(rest) if twice or within else name


def clip_key(name: str) -> str:
    """Return a key that is the same for all names of a clip in all releases, except for letter case."""
    _, _, rest = strip_archives(name).partition("/")
    return f"{subset(strip_archives(name))}/{SUFFIX.sub('', rest.replace(' ', '_'))}"


def present_subsets(names: Iterable[str]) -> set[str]:
    """Return the subsets of clips, or of folders of subsets, by their names."""
    return {subset(one) for name in names for one in (name, strip_archives(name))}


def absent_subsets(data: str, names: Iterable[str]) -> str:
    """Describe the absent subsets of a protocol, as in "1 of 3 subsets (without CMU, MPI_HDM05)", or "".

    Args:
        data: the option of `data`; the text is empty for any that is not in `PROTOCOLS`.
        names: names of clips or of folders of subsets.
    """
    protocol, present = PROTOCOLS.get(data, ()), present_subsets(names)
    absent = [name for name in protocol if subset(name) not in present]
    if not absent:
        return ""
    more = f" and {len(absent) - 3} more" if len(absent) > 3 else ""
    count = f"{len(protocol) - len(absent)} of {len(protocol)} subsets"
    return f"{count} (without {', '.join(absent[:3])}{more})"
