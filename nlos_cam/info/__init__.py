"""Description of any file or folder that the program writes or reads: kind, origin, content,
damage, next commands.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
