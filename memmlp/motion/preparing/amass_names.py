"""Clip names of AMASS, which differ between its releases.

The first SMPL+H release has folders like `BioMotionLab_NTroje` and `MPI_HDM05`, and files that end in
`_poses`. Later downloads have folders like `BMLrub` and `HDM05`. The SMPL-X release also has these later
folders. Its files end in `_stageii`, with `_` instead of blanks. BABEL's paths and unpacked archives can have
an additional folder in front, as in `BMLrub/BioMotionLab_NTroje/...` or `archive-1/CMU/...`.
"""

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
"""Later name of a subset -> its first name; both in lower case and without `_`."""

SUFFIX = re.compile(r"_(?:poses|stageii)$", re.IGNORECASE)


def normalize_subset(name: str) -> str:
    """Return a release-independent subset name, given the name of a clip or a subset."""
    top = name.split("/")[0].lower().replace("_", "")
    return RENAMED.get(top, top)


# The subsets of the protocols S1, with published lists, and S2
S1 = ("CMU", "BioMotionLab_NTroje", "MPI_HDM05")
S2_TRAIN = (
    "CMU", "MPI_Limits", "TotalCapture", "Eyes_Japan_Dataset", "KIT", "BioMotionLab_NTroje", "BMLmovi",
    "EKUT", "ACCAD", "MPI_mosh", "SFU", "MPI_HDM05",
)  # fmt: skip
S2_TEST = ("HumanEva", "Transitions_mocap")

FOLDERS = frozenset((
    *S2_TRAIN, *S2_TEST, "PosePrior", "EyesJapanDataset", "BMLrub", "MoSh", "HDM05", "Transitions",
    "DFaust_67", "DFaust", "DanceDB", "SSM_synced", "SSM", "TCD_handMocap", "TCDHands", "BMLhandball", "CNRS",
    "GRAB", "HUMAN4D", "MOYO", "SOMA", "WEIZMANN",
))  # fmt: skip
"""All folder names of subsets, as the releases spell them."""

PROTOCOLS = {"amass_s1": S1, "amass_s3": (*S2_TRAIN, *S2_TEST)}
"""Option of `data` -> the subsets of a complete data folder."""


def strip_archives(name: str) -> str:
    """Remove the folders in front of the subset's folder from a clip's name."""
    archive, _, rest = name.partition("/")
    if "/" not in rest:
        return name
    twice = normalize_subset(archive) == normalize_subset(rest)
    within = archive not in FOLDERS and rest.split("/")[0] in FOLDERS and rest.count("/") > 1
    return strip_archives(rest) if twice or within else name


def make_clip_key(name: str) -> str:
    """Return a key for a clip that is the same in all releases, except for letter case."""
    _, _, rest = strip_archives(name).partition("/")
    return f"{normalize_subset(strip_archives(name))}/{SUFFIX.sub('', rest.replace(' ', '_'))}"


def find_present_subsets(names: Iterable[str]) -> set[str]:
    """Return the subsets of clips, given names of clips or folders."""
    return {normalize_subset(one) for name in names for one in (name, strip_archives(name))}


def describe_absent_subsets(data: str, names: Iterable[str]) -> str:
    """Describe the missing subsets of a protocol (option of `data`), given names of clips or folders, as in
    "1 of 3 subsets (without CMU, MPI_HDM05)". The text is empty if none is missing or the data has no
    protocol."""
    protocol, present = PROTOCOLS.get(data, ()), find_present_subsets(names)
    absent = [name for name in protocol if normalize_subset(name) not in present]
    if not absent:
        return ""
    more = f" and {len(absent) - 3} more" if len(absent) > 3 else ""
    count = f"{len(protocol) - len(absent)} of {len(protocol)} subsets"
    return f"{count} (without {', '.join(absent[:3])}{more})"
