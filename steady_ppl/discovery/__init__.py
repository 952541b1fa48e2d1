"""Which physical effect a program lacks: screen the catalogue, refit the leaders, judge them on held-out drives."""
