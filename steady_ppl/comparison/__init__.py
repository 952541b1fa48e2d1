"""Whether runs are better than another, and by how much: errors, scores and paired intervals on unused drives.

Begin at `prove`. Nothing here fits a program, draws a picture or says what is wrong with one.
"""
