"""Files: atomic and exclusive writes, claims, checksums, a cache, and bounded reading."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
