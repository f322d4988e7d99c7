"""What the server that processes are forked off (processes.Forked) does once, in place of each of them.

The digests of memmlp's code are half a second of a training that takes two, and the first composition of a
config is another: a process finds both as a test process does that has trained before.
"""

from __future__ import annotations

import os

from command_line import TINY
from remembered import remember

from memmlp.config.compose import composed
from memmlp.runs import environment

_, _, before = os.environ["PYTHONPATH"].partition(os.pathsep)  # processes._as_begun
if before:
    os.environ["PYTHONPATH"] = before
else:
    del os.environ["PYTHONPATH"]

remember()
environment.code_digests()
for words in (TINY, []):
    composed(words)
