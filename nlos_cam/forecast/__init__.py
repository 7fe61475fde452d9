"""Forecast of a bench: what its maps determine of a hidden object, before anything is trained."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
