"""ROS bags to trajectories: read messages, pick fields by a mapping, bring them to even rows."""
