"""Diagnosis of why no camera is found, and of the host it is attached to."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
