"""Streaming loop: threads, timing, statistics, and replay of recordings to files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
