"""Pictures of motion: heat-map figures and films of truth and predictions side by side."""
