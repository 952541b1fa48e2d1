"""One page of HTML that says what programs explain of some drives, where they fail and what they lack.

Nothing here computes a figure; it gathers, packs and writes.
"""
