"""The memory slot: what the backbone sees of the past, and what is kept for the next call.

A memory makes the backbone's blocks (`block`), turns the buffers of past frames into what those blocks see
(`recall`), and updates its buffers with the network's output (`remember`). All of these values are in network
space.
"""

from memmlp.networks.memory.memory_block import (
    Blend,
    MemoryBlock,
    Past,
    ProjectedFeature,
    Projection,
    Recurred,
    State,
)
from memmlp.networks.memory.memory_slot import Memory, NoMemory
from memmlp.networks.memory.own_past import (
    CodeMemory,
    JointCodeMemory,
    NoCodesMemory,
    OwnPastMemory,
    VQMemory,
)
from memmlp.networks.memory.recurrent import GRUMemory, LSTMMemory, RecurrentMemory

__all__ = [
    "Blend",
    "CodeMemory",
    "GRUMemory",
    "JointCodeMemory",
    "LSTMMemory",
    "Memory",
    "MemoryBlock",
    "NoCodesMemory",
    "NoMemory",
    "OwnPastMemory",
    "Past",
    "ProjectedFeature",
    "Projection",
    "Recurred",
    "RecurrentMemory",
    "State",
    "VQMemory",
]
