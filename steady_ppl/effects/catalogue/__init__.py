"""The effects that everybody has, by what they act on; `registry` reads each file's list.

A file here declares effects and does nothing else.
"""
