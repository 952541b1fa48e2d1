"""Posteriors over the noise of given drives, for the training loop: by particles or known, linearised, variational."""
