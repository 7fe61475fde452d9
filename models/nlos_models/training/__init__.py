"""Training: map sets and their batches, the loop, one task per kind of network, and runs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
