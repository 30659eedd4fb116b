"""modgnn_rl: imitation learning of robot swarms with ModGNN, on TorchRL.

The names that ``__init__.pyi`` lists are imported when they are first used, so that ``--help`` need not wait for torch.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
