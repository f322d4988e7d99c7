"""Pictures of motion: figures, films, sheets of clips and skeleton maps."""
