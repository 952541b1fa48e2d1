"""Published logs as trajectories. Nothing here downloads; a reader is given a folder."""
