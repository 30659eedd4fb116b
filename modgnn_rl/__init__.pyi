__version__: str

from .actions import Ball as Ball
from .actions import Box as Box
from .actions import Discrete as Discrete
from .configs.settings import setting as setting
from .configs.task import TaskConfig as TaskConfig
from .deploy.agent import Agent as Agent
from .errors import InputError as InputError
from .layout import Layout as Layout
from .models.factory import make_model as make_model
from .nn.modgnn import ModGNN as ModGNN
from .nn.modgnn import ModGNNLayer as ModGNNLayer
from .registry import METRICS as METRICS
from .registry import MODELS as MODELS
from .registry import TASKS as TASKS
from .registry import TRAINERS as TRAINERS
from .task import ACTION as ACTION
from .task import EXPERT_ACTION as EXPERT_ACTION
from .task import OBSERVATION as OBSERVATION
from .task import Task as Task
from .task import make_task as make_task
from .tracking.loading import load_policy as load_policy
