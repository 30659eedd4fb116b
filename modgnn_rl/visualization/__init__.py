"""Drawing of recorded rollouts: replay page, images, videos, live viewer. Nothing here depends on the task.

Public names are imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
