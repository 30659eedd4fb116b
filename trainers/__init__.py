"""Trainers: behaviour cloning, DAgger and MAPPO, and the parts they are made of.

Public names are imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
