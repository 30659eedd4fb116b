from .env import FlockingEnv as FlockingEnv
from .expert import LocalReynolds as LocalReynolds
from .expert import Reynolds as Reynolds
from .expert import reynolds as reynolds
from .physics.engine import Physics as Physics
from .physics.engine import TorchPhysics as TorchPhysics
from .task import FlockingTask as FlockingTask
