"""Transients in tal's HDF5: rendered ones out, any one in, a look at it by plain back-projection."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
