"""Detection of three-bounce light before any reconstruction: object in, object out, in turns."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
