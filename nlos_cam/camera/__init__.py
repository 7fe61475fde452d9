"""Cameras behind one protocol: an L515, or a simulated one; other packages open them by name."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
