"""Pictures of data, fits and results. Nothing here computes a figure; it draws what a result holds."""
