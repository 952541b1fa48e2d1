"""Where, when and in which regime a program fails, who is at fault, and whether its time step suits.

Nothing here proposes an effect; that is `discovery`.
"""
