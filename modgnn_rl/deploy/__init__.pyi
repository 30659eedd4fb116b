from .agent import Agent as Agent
from .export import Exported as Exported
from .export import export_agent as export_agent
from .onnx_agent import AgentError as AgentError
from .onnx_agent import OnnxAgent as OnnxAgent
