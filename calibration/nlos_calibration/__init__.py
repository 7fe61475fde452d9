"""Wall calibration: planes, boards, occluders and drift, from depth maps to rigs and records."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
