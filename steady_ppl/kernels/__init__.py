"""Functions of torch as machine code for many particles at once: trace, lower, write, compile.

A leaf: it knows torch, LLVM and `utils`, and no program. The page beside it, README.md, says how a kernel comes about.
"""
