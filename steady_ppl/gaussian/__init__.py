"""The program to first order along a path: linearise, smooth, look ahead, predict, and steer a particle filter.

Nothing here learns a parameter.
"""
