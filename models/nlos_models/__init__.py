"""Networks: the compressor and VAE of the paper, uncertainty, training, checkpoints and
inference.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
