"""Bench folder: the measured walls of a bench, its weights and reports, with a checked record."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
