"""From a recording on any skeleton to clips on the 22-joint tree, and the proof that they are the same."""
