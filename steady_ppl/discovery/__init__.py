"""Which physical effect a program lacks: screen the catalogue, refit the leaders, judge them on held-out drives.

Begin at `discover`. Nothing here says what an effect does, which is in `effects`, or draws a picture.
"""
