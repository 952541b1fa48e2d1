"""One training loop for every guide, whichever it is; its stopping rule and its checkpoints."""
