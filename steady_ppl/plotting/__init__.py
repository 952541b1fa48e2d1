"""Pictures of data, fits and results. Nothing here computes a figure of a result; it draws what the result holds.

Functions for notebooks and papers draw on matplotlib axes and return them; names and units are the program's.
`__init__.pyi` lists them. No module here may be imported by what it draws.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
