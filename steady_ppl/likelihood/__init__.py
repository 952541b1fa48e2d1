"""How well a program explains given drives: log p(y), its derivatives, its maximum, the posterior about that.

Nothing here says what is wrong with a program.
"""
