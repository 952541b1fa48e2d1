"""Posteriors over the noise of given drives, for the training loop: by particles or known, linearised, variational.

A guide makes paths; the loop, its steps and its stopping rule are in `training`.
"""
