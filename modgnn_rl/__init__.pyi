__version__: str

from .deploy.agent import Agent as Agent
from .errors import InputError as InputError
from .models.factory import make_model as make_model
from .nn.modgnn import ModGNN as ModGNN
from .nn.modgnn import ModGNNLayer as ModGNNLayer
from .registry import METRICS as METRICS
from .registry import MODELS as MODELS
from .registry import TRAINERS as TRAINERS
from .tracking.loading import load_policy as load_policy
