"""Build a policy from a model's name and settings.

The built-in models act on observations as a `modgnn_rl.layout.Layout` describes them, and end in the legal actions of a
`modgnn_rl.actions.ActionSpace`. Where a task does not change under translations, none of them sees an absolute
position: hop 0 reads the rest, the other hops read differences. The exception is ``modgnn_adjacency``, a baseline for
comparison, whose communication sums plain data instead of differences.

With several layers, every layer but the last outputs features that the next layers communicate beside the observation.
"""

from __future__ import annotations

import contextlib
import copy
from typing import Any

from modgnn_rl.actions import ActionSpace, Ball
from modgnn_rl.configs.schema import ModelConfig
from modgnn_rl.errors import InputError
from modgnn_rl.layout import STATE, Layout
from modgnn_rl.models.blocks import LayerSpec
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import MODELS
from modgnn_rl.task import Task
from modgnn_rl.utils.seeds import seeded

__all__ = ["configured_model", "make_model"]


def make_model(
    name: str,
    hops: int = 1,
    hidden: int = 32,
    *,
    layers: int | None = None,
    layout: Layout | int = STATE,
    head: ActionSpace | None = None,
    num_agents: int | None = None,
    seed: int | None = None,
    **keys: Any,
) -> ModGNN:
    """Build a model by name.

    Args:
        name: a name in `modgnn_rl.registry.MODELS`: a built-in model, one that an installed package provides, or one
            that you registered.
        hops: number of communication hops K, of each layer.
        hidden: width of the hidden layers.
        layers: number of layers L. Information travels up to L K hops, one step late for each. Default: the model's
            own number, 2 for ``moment_force`` and 1 for the other built-in models.
        layout: what an observation is, or just the number of its columns; default: position and velocity in space.
        head: what an agent can do; default: velocities in space of up to 0.92 m/s.
        num_agents: number of agents; only ``central`` needs it.
        seed: seed of the initial weights; default: use torch's global generator as it is.
        keys: key names and other arguments of `ModGNN`.

    Returns:
        the policy, a TensorDictModule for any number of agents (``central``: for one).

    Raises:
        InputError: the name is unknown, a number is out of range, or the model does not fit the layout.
    """
    entry = MODELS[name]
    if layers is None:
        layers = entry.option("layers", 1)
    if not isinstance(layers, int) or layers < 1:
        raise InputError(f"layers={layers!r} is not a number of layers; expected an integer of at least 1")
    layout = Layout(layout) if isinstance(layout, int) else layout
    head = Ball(0.92, 3) if head is None else head
    if entry.option("is_physical") and not (layout.is_state and layout.dims == 3 and isinstance(head, Ball)):
        raise InputError(
            f"model '{name}' needs observations of a position and a velocity, of a task that does not change under "
            "translations and rotations, and vectors as actions; use another, such as model=modgnn_mlp"
        )
    builder = entry.load()
    with contextlib.nullcontext() if seed is None else seeded(seed):
        built = []
        for earlier in range(layers):
            end = copy.deepcopy(head) if earlier == layers - 1 else None
            built.append(builder(LayerSpec(hops, hidden, earlier, end, num_agents, layout, head.width)))
        return ModGNN(built, **keys)


def configured_model(model: ModelConfig, task: Task, seed: int) -> ModGNN:
    """Build the policy that a configuration describes.

    Args:
        model: name and settings of the model.
        task: to train on.
        seed: seed of the initial weights.

    Raises:
        InputError: the model cannot be used in this environment.
    """
    name = model.name or task.default_model
    if name == "central" and len(task.sizes) > 1:
        raise InputError(f"model 'central' works for one number of agents, but env.num_agents={task.sizes} has several")
    return make_model(
        name,
        model.hops,
        model.hidden,
        layers=model.layers,
        layout=task.layout,
        head=task.actions,
        num_agents=task.sizes[0],
        seed=seed,
    )
