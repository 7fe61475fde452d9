"""Pure pipeline from a frame to a hidden depth map with its uncertainty and verdict."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
