"""The models: configurations of ModGNN's submodules, by name.

All of them act on observations (position, velocity) [*B, N, 6] with one head, the projection onto the action ball, and
none of them sees an absolute position: hop 0 reads the agent's velocity, the other hops differences. The exception is
``modgnn_adjacency``, there for comparison, whose communication forms no differences.

With several layers, each but the last puts out features that the next ones communicate beside the observation.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

from modgnn_rl.configs.schema import BUILT_IN_MODELS, MODEL_NAMES, MODEL_PLUGINS, FlockingConfig, ModelConfig
from modgnn_rl.errors import InputError, suggestion
from modgnn_rl.models.blocks import BallHead, LayerSpec
from modgnn_rl.models.central import CentralLayer
from modgnn_rl.models.equivariant import PairForce, moment_force, pair_force
from modgnn_rl.models.message_passing import gat, mpnn
from modgnn_rl.models.paper import central, gcn, gcn_final, modgnn_adjacency, modgnn_mlp, no_mid, no_pre
from modgnn_rl.nn.modgnn import ModGNN, ModGNNLayer
from modgnn_rl.utils.seeds import seeded

__all__ = [
    "MODELS",
    "PairForce",
    "configured_model",
    "make_model",
    "register_model",
]


Builder = Callable[[LayerSpec], ModGNNLayer | CentralLayer]
MODELS: dict[str, Builder] = {
    "moment_force": moment_force,
    "pair_force": pair_force,
    "modgnn_mlp": modgnn_mlp,
    "modgnn_adjacency": modgnn_adjacency,
    "no_pre": no_pre,
    "no_mid": no_mid,
    "gcn": gcn,
    "gcn_final": gcn_final,
    "central": central,
    "gat": gat,
    "mpnn": mpnn,
}


LAYERS = {"moment_force": 2}  # of models that have not one


def register_model(name: str, builder: Builder) -> None:
    """Give a model of one's own a name, by which settings, trainers and run folders know it in this process.

    A package does so for every command, without a call, with an entry point in its ``pyproject.toml``::

        [project.entry-points."modgnn_rl.models"]
        my_model = "my_package.my_module:my_model"

    Args:
        name: a new name, or one that was registered before: the new builder replaces the old one.
        builder: builds one layer; see `LayerSpec`. `make_model` calls it for each.

    Raises:
        InputError: the name is that of a model which is built in.
    """
    if name in BUILT_IN_MODELS:
        raise InputError(f"model '{name}' is built in; give your own another name")
    MODELS[name] = builder
    if name not in MODEL_NAMES:
        MODEL_NAMES.append(name)


def _builder(name: str) -> Builder:
    """What builds a model's layers; an installed package's is imported now."""
    if name not in MODELS:
        for entry in entry_points(group=MODEL_PLUGINS, name=name):
            register_model(name, entry.load())
    if name not in MODELS:
        raise InputError(f"model '{name}' is not one of {', '.join(MODEL_NAMES)}{suggestion(name, MODEL_NAMES)}")
    return MODELS[name]


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
        name: one of `MODELS`, or of an installed package's; see `register_model`.
        hops: number of communication hops K, of each layer.
        hidden: width of the hidden layers.
        layers: number of layers L; with several, an agent hears of others over L K links, one step late for each.
            Default: 2 for ``moment_force``, 1 for the others.
        max_speed: radius of the action ball, m/s.
        num_agents: number of agents, which only ``central`` needs to know.
        seed: seed of the initial weights; default: torch's global generator as it stands.
        keys: names of keys and further arguments of `ModGNN`.

    Returns:
        the policy, a TensorDictModule for any number of agents (``central``: for one).

    Raises:
        InputError: for an unknown name, or a number that cannot be.
    """
    builder = _builder(name)
    if layers is None:
        layers = LAYERS.get(name, 1)
    if not isinstance(layers, int) or layers < 1:
        raise InputError(f"layers={layers!r} is not a number of layers; expected an integer of at least 1")
    with contextlib.nullcontext() if seed is None else seeded(seed):
        built = []
        for earlier in range(layers):
            head = BallHead(max_speed) if earlier == layers - 1 else None
            built.append(builder(LayerSpec(hops, hidden, earlier, head, num_agents)))
        return ModGNN(built, **keys)


def configured_model(model: ModelConfig, env_config: FlockingConfig, seed: int) -> ModGNN:
    """The policy that a configuration asks for.

    Args:
        model: which one.
        env_config: the world that it is trained in: its action ball, and for ``central`` its number of agents.
        seed: seed of the initial weights.

    Raises:
        InputError: a model that cannot serve that world.
    """
    if model.name == "central" and len(env_config.sizes) > 1:
        raise InputError(
            f"model 'central' serves one number of agents, and env.num_agents={env_config.sizes} asks for more"
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
