"""Whether runs are better than another, and by how much: errors, scores and paired intervals on unused drives."""
