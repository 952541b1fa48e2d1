"""The program forward in time: simulated, or as a particle filter with its resampling and genealogy.

Nothing here linearises; a proposal that looks ahead is in `gaussian`.
"""
