"""From a folder of clips to a split, memory-mappable cache."""
