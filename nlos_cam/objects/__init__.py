"""Hidden objects: generators of 18 categories, meshes, placement in the object box, depth maps."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
