"""The effects that everybody has, by what they act on. Each file ends in the list that `registry` reads.

A file here declares effects and does nothing else.
"""
