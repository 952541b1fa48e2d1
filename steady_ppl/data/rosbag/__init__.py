"""ROS bags to trajectories: read messages, pick fields by a mapping, bring them to even rows.

Nothing here needs ROS, or knows a program beyond its columns.
"""
