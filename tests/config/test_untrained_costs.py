"""Sizes of networks that were not trained, in the place of runs."""

from conftest import Memmlp, one_line


def test_the_command_refuses_it_for_other_tables(memmlp: Memmlp):
    said = memmlp("table", "5", "--untrained")
    assert one_line(said, "--untrained: sweep table05 shows MPJRE, MPJPE", "FLOPs, MACs")
