"""The `steady` command. A command reads its input, calls one function of the library, and writes whole files.

What a command needs is imported when it runs, so that `steady --help` loads no torch.
"""
