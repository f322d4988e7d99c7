"""People of AMASS with several folders: on one side of a split, or reported."""

import pytest

from memmlp.config.compose import composed
from memmlp.motion.preparing.amass_names import PEOPLE, divided_subjects
from memmlp.motion.preparing.groups import Grouping

ONE = [
    ("ACCAD/Female1General_c3d/A1 - Stand_poses", "ACCAD/Female1Running_c3d/C3 - Run_poses"),
    ("ACCAD/Male2Walking_c3d/a_stageii", "archive-1/ACCAD/Male2MartialArtsKicks_c3d/b_stageii"),
    ("DFaust_67/50002/50002_hips_poses", "MPI_mosh/50002/misc_poses"),
    ("MoSh/50004/a_stageii", "SSM/20161014_50004/b_stageii"),
]
TWO = [
    ("ACCAD/Female1General_c3d/a", "ACCAD/Male1General_c3d/b"),
    ("ACCAD/s007/a", "ACCAD/s008/b"),
    ("DFaust_67/50002/a", "MPI_mosh/50004/b"),
    ("KIT/317/a", "EKUT/317/b"),
]


@pytest.mark.parametrize("data", ["amass_s2", "amass_s3"])
def test_a_persons_folders_are_one_group(data):
    groups = composed([f"data={data}", "data.root=."]).data.split.groups
    assert tuple(groups[1:]) == PEOPLE
    for names, count in (*((pair, 1) for pair in ONE), *((pair, 2) for pair in TWO)):
        seen = {name: name.removeprefix("archive-1/") for name in names}
        assert len(Grouping(tuple(groups)).tie(seen)) == count


def test_a_person_with_several_folders_in_training_and_test_is_reported():
    for train, test in ONE:
        said = "/".join(train.split("/")[:2])
        assert divided_subjects([(train, "train"), (test, "test")]) == [said]
    for train, test in TWO:
        assert divided_subjects([(train, "train"), (test, "test")]) == []
