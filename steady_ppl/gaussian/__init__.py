"""The program to first order along a path: linearise, smooth, look ahead, predict; and what that gives a particle filter."""
