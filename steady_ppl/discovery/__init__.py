"""Which physical effect a program lacks: screen the catalogue, refit the leaders, judge them on held-out drives.

What an effect does is in `effects`. Pictures are in `plotting`.
"""
