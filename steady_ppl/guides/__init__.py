"""Posteriors over the noise of given drives, for the training loop: filtered, linearised, variational, or known."""
