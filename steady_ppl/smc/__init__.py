"""The program forward in time: simulated, or as a particle filter with its resampling and genealogy."""
