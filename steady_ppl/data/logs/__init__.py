"""Logs of autopilots to trajectories: PX4 ULog and ArduPilot DataFlash, with ready mappings in `ready/`."""
