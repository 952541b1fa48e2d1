"""One training loop for every guide, its stopping rule and its checkpoints.

Nothing here knows one guide from another.
"""
