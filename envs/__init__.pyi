from .flocking import FlockingEnv as FlockingEnv
from .flocking import Physics as Physics
from .flocking import TorchPhysics as TorchPhysics
from .parallel import ParallelFlocks as ParallelFlocks
from .parallel import parallel_flocks as parallel_flocks
