"""Functions of torch as machine code for many particles at once: trace, lower, write, compile.

A leaf: it knows torch, LLVM and `utils`. Nothing here knows a program. README.md beside it says how a kernel comes
about.
"""
