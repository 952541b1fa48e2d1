"""Functions of torch as machine code for many particles at once: trace, lower, write, compile.

A leaf: it knows torch, LLVM, numba's loops for it and `utils`. A program is any torch module here. README.md beside it
says how a kernel comes about.
"""
