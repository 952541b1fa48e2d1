"""Published logs as trajectories."""
