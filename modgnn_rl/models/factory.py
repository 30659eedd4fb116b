"""Build a policy from a model's name and settings.

The built-in models act on observations (position, velocity) [*B, N, 6] and end in the projection onto the action ball.
None of them sees an absolute position: hop 0 reads the agent's velocity, the other hops read differences. The exception
is ``modgnn_adjacency``, a baseline for comparison, whose communication sums plain data instead of differences.

With several layers, every layer but the last outputs features that the next layers communicate beside the observation.
"""

from __future__ import annotations

import contextlib
from typing import Any

from modgnn_rl.configs.schema import FlockingConfig, ModelConfig
from modgnn_rl.errors import InputError
from modgnn_rl.models.blocks import BallHead, LayerSpec
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.registry import MODELS
from modgnn_rl.utils.seeds import seeded

__all__ = ["configured_model", "make_model"]


def make_model(
    name: str,
    hops: int = 1,
    hidden: int = 32,
    *,
    layers: int | None = None,
    max_speed: float = 0.92,
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
        max_speed: radius of the action ball, m/s.
        num_agents: number of agents; only ``central`` needs it.
        seed: seed of the initial weights; default: use torch's global generator as it is.
        keys: key names and other arguments of `ModGNN`.

    Returns:
        the policy, a TensorDictModule for any number of agents (``central``: for one).

    Raises:
        InputError: the name is unknown, or a number is out of range.
    """
    entry = MODELS[name]
    if layers is None:
        layers = entry.option("layers", 1)
    if not isinstance(layers, int) or layers < 1:
        raise InputError(f"layers={layers!r} is not a number of layers; expected an integer of at least 1")
    builder = entry.load()
    with contextlib.nullcontext() if seed is None else seeded(seed):
        built = []
        for earlier in range(layers):
            head = BallHead(max_speed) if earlier == layers - 1 else None
            built.append(builder(LayerSpec(hops, hidden, earlier, head, num_agents)))
        return ModGNN(built, **keys)


def configured_model(model: ModelConfig, env_config: FlockingConfig, seed: int) -> ModGNN:
    """Build the policy that a configuration describes.

    Args:
        model: name and settings of the model.
        env_config: the environment to train in, for the radius of the action ball and, for ``central``, the number of
            agents.
        seed: seed of the initial weights.

    Raises:
        InputError: the model cannot be used in this environment.
    """
    if model.name == "central" and len(env_config.sizes) > 1:
        raise InputError(
            f"model 'central' works for one number of agents, but env.num_agents={env_config.sizes} has several"
        )
    return make_model(
        model.name,
        model.hops,
        model.hidden,
        layers=model.layers,
        max_speed=env_config.max_speed,
        num_agents=env_config.sizes[0],
        seed=seed,
    )
