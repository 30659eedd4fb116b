"""The models: configurations of ModGNN's submodules, by name.

All of them act on observations (position, velocity) [*B, N, 6] with one head, the projection onto the action ball, and
none of them sees an absolute position: hop 0 reads the agent's velocity, the other hops differences. The exception is
``modgnn_adjacency``, there for comparison, whose communication forms no differences.

With several layers, each but the last puts out features that the next ones communicate beside the observation.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from modgnn_rl.configs.schema import BUILT_IN_MODELS, MODEL_NAMES, MODEL_PLUGINS, FlockingConfig, ModelConfig
from modgnn_rl.configs.settings import suggestion
from modgnn_rl.errors import InputError
from modgnn_rl.models.central import CentralLayer
from modgnn_rl.models.equivariant import VELOCITY_SCALE, Moments, PairForce, VectorSquash, mlp
from modgnn_rl.nn.communication import Adjacency, GraphAttention, MessagePassing
from modgnn_rl.nn.modgnn import ModGNN, ModGNNLayer
from modgnn_rl.utils.seeds import seeded
from modgnn_rl.utils.tensors import clip_to_ball

__all__ = [
    "MODELS",
    "BallHead",
    "LayerSpec",
    "PairForce",
    "Scale",
    "Zero",
    "configured_model",
    "make_model",
    "register_model",
]

POSITION_SCALE = 0.5  # 1/m
LATENT = 10  # width of f_pre's and f_mid's outputs in the paper
FEATURES = 16  # width of what layers before the last put out
VECTORS, SCALARS = 4, 4  # the same of pair_force: 3 * 4 + 4 features
HEADS = 4  # of attention


class LayerSpec(NamedTuple):
    """What a model is asked to build.

    Attributes:
        hops: communication hops K.
        hidden: width of the hidden layers.
        earlier: number of earlier layers.
        head: what the last layer ends in; None for the layers before it.
        num_agents: N, for a model that needs to know.
    """

    hops: int
    hidden: int
    earlier: int
    head: nn.Module | None
    num_agents: int | None

    @property
    def inputs(self) -> int:
        """Width of the layer's input: observation, and outputs of earlier layers."""
        return 6 + self.earlier * FEATURES

    @property
    def outputs(self) -> int:
        """Width of the layer's output."""
        return FEATURES if self.head is None else 3

    def end(self, *f_final: nn.Module) -> nn.Module:
        """F_final of the layer: the given modules, then the head in the last layer."""
        return nn.Sequential(*f_final) if self.head is None else nn.Sequential(*f_final, self.head)

    def scales(self) -> list[nn.Module]:
        """Scaling for every hop, which hides the absolute position from hop 0."""
        return [Scale(self.inputs, hide_position=hop == 0) for hop in range(self.hops + 1)]


class BallHead(nn.Module):
    """Projection onto the ball of allowed actions: what the environment and the expert do to theirs."""

    is_equivariant = True

    def __init__(self, max_speed: float) -> None:
        super().__init__()
        self.max_speed = max_speed

    def forward(self, action: Tensor) -> Tensor:
        """Project actions [..., 3], m/s."""
        return clip_to_ball(action, self.max_speed)


class Scale(nn.Module):
    """Bring positions and velocities to order one, and hide the position where it is absolute.

    Args:
        features: width of the data; what follows position and velocity stays as it is.
        hide_position: return zero positions, for data that are no differences.
    """

    is_linear_map = True
    factor: Tensor

    def __init__(self, features: int = 6, *, hide_position: bool = False) -> None:
        super().__init__()
        factor = torch.ones(features)
        factor[:3], factor[3:6] = 0.0 if hide_position else POSITION_SCALE, VELOCITY_SCALE
        self.register_buffer("factor", factor, persistent=False)

    def forward(self, data: Tensor) -> Tensor:
        """Scale position, velocity and what follows [..., F]."""
        return data * self.factor


class Relative(nn.Module):
    """From the two ends of a link, side by side, to what does not feel a translation: difference, and receiver.

    Args:
        features: width of one end F, which begins with position and velocity.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.scale = Scale(features)

    def forward(self, ends: Tensor) -> Tensor:
        """Map [E, 2 F] to the scaled difference and the receiver without its position [E, 2 F - 3]."""
        sender, receiver = self.scale(ends.unflatten(-1, (2, -1))).unbind(-2)
        return torch.cat((sender - receiver, receiver[..., 3:]), -1)


class Zero(nn.Module):
    """A hop that contributes nothing: zeros of a given width."""

    is_equivariant = True

    def __init__(self, features: int) -> None:
        super().__init__()
        self.features = features

    def forward(self, data: Tensor) -> Tensor:
        """Return zeros [..., features]."""
        return data.new_zeros(*data.shape[:-1], self.features)


def modgnn_mlp(spec: LayerSpec) -> ModGNNLayer:
    """ModGNN-MLP of the paper: three-layer networks for f_pre, f_mid (10 features out) and f_final, one a hop."""
    f_pre = [nn.Sequential(scale, mlp(spec.inputs, spec.hidden, LATENT)) for scale in spec.scales()]
    f_mid = [mlp(LATENT, spec.hidden, LATENT) for _ in f_pre]
    f_final = spec.end(mlp(LATENT, spec.hidden, spec.outputs))
    return ModGNNLayer(spec.hops, f_pre=f_pre, f_mid=f_mid, f_final=f_final)


def modgnn_adjacency(spec: LayerSpec) -> ModGNNLayer:
    """ModGNN-MLP whose f_com is the adjacency: sums of the neighbours' data, not of differences, as in a plain GCN."""
    layer = modgnn_mlp(spec)
    layer.f_com = nn.ModuleList([Adjacency() for _ in range(spec.hops)])
    return layer


def no_pre(spec: LayerSpec) -> ModGNNLayer:
    """ModGNN-MLP without f_pre: the neighbours' data are summed before any network sees them."""
    f_mid = [mlp(spec.inputs, spec.hidden, LATENT) for _ in range(spec.hops + 1)]
    f_final = spec.end(mlp(LATENT, spec.hidden, spec.outputs))
    return ModGNNLayer(spec.hops, f_pre=spec.scales(), f_mid=f_mid, f_final=f_final)


def no_mid(spec: LayerSpec) -> ModGNNLayer:
    """ModGNN-MLP without f_mid: the hops are summed as they come out of f_pre."""
    f_pre = [nn.Sequential(scale, mlp(spec.inputs, spec.hidden, LATENT)) for scale in spec.scales()]
    return ModGNNLayer(spec.hops, f_pre=f_pre, f_final=spec.end(mlp(LATENT, spec.hidden, spec.outputs)))


def gcn(spec: LayerSpec) -> ModGNNLayer:
    """A GCN: a matrix for each hop as f_mid, no f_pre, a pointwise f_final (the head); ``hidden`` is not used."""
    f_mid = [nn.Linear(spec.inputs, spec.outputs, bias=hop == 0) for hop in range(spec.hops + 1)]
    f_final = nn.Tanh() if spec.head is None else spec.head
    return ModGNNLayer(spec.hops, f_pre=spec.scales(), f_mid=f_mid, f_final=f_final)


def gcn_final(spec: LayerSpec) -> ModGNNLayer:
    """GCN + f_final of the paper: a matrix for each hop, then a three-layer network in place of the activation."""
    f_mid = [nn.Linear(spec.inputs, LATENT, bias=hop == 0) for hop in range(spec.hops + 1)]
    f_final = spec.end(mlp(LATENT, spec.hidden, spec.outputs))
    return ModGNNLayer(spec.hops, f_pre=spec.scales(), f_mid=f_mid, f_final=f_final)


def central(spec: LayerSpec) -> CentralLayer:
    """The paper's centralised baseline: four linear layers from all observations to all actions, for one N only."""
    if spec.num_agents is None:
        raise InputError("model 'central' reads all agents at once: give num_agents, the one number it will serve")
    if spec.head is None or spec.earlier:
        raise InputError("model 'central' has one layer; give layers=1")
    return CentralLayer(spec.num_agents, 6, spec.hidden, 3, scale=Scale(), head=spec.head)


def gat(spec: LayerSpec) -> ModGNNLayer:
    """Attention over the neighbours as f_com (GATv2): to differences in hop 1, to what hop 1 made of them after it."""
    heads = math.gcd(HEADS, spec.hidden)
    f_com: list[nn.Module] = [
        GraphAttention(spec.hidden if hop > 1 else spec.inputs, spec.hidden, heads, relative=hop == 1)
        for hop in range(1, spec.hops + 1)
    ]
    return _networks_of_hops(spec, f_com)


def mpnn(spec: LayerSpec) -> ModGNNLayer:
    """Message passing: a learned network of sender and receiver as f_com."""
    f_com: list[nn.Module] = []
    for hop in range(1, spec.hops + 1):
        width = 2 * spec.inputs - 3 if hop == 1 else 2 * spec.hidden
        network = mlp(width, spec.hidden, spec.hidden)
        f_com.append(MessagePassing(nn.Sequential(Relative(spec.inputs), network) if hop == 1 else network))
    return _networks_of_hops(spec, f_com)


def _networks_of_hops(spec: LayerSpec, f_com: list[nn.Module]) -> ModGNNLayer:
    """A layer whose f_com brings ``hidden`` features, with networks as f_mid and f_final."""
    f_pre = [Scale(spec.inputs, hide_position=True), *[None] * spec.hops]
    f_mid = [mlp(spec.inputs if hop == 0 else spec.hidden, spec.hidden, LATENT) for hop in range(spec.hops + 1)]
    f_final = spec.end(mlp(LATENT, spec.hidden, spec.outputs))
    return ModGNNLayer(spec.hops, f_com=f_com, f_pre=f_pre, f_mid=f_mid, f_final=f_final)


def pair_force(spec: LayerSpec) -> ModGNNLayer:
    """Equivariant forces of pairs as f_pre, summed over the neighbours: `PairForce`; hop 0 contributes nothing.

    Layers before the last put out four vectors and four scalars, which later layers compare like velocities.
    """
    vectors, scalars = (VECTORS, SCALARS) if spec.head is None else (1, 0)
    return _sum_of_forces(spec, vectors, scalars, features=(VECTORS, SCALARS))


def moment_force(spec: LayerSpec) -> ModGNNLayer:
    """`pair_force` over what the neighbours' own neighbourhoods look like: `Moments` in the layers before the last.

    These have nothing to learn, so that an agent sees two links far and training costs little more than with one.
    """
    features = Moments.vectors, Moments.scalars
    if spec.head is not None:
        return _sum_of_forces(spec, 1, 0, features)
    f_pre = [Zero(3 * Moments.vectors + Moments.scalars), *(Moments(spec.earlier) for _ in range(spec.hops))]
    return ModGNNLayer(spec.hops, f_pre=f_pre, f_final=VectorSquash(Moments.vectors))


def _sum_of_forces(spec: LayerSpec, vectors: int, scalars: int, features: tuple[int, int]) -> ModGNNLayer:
    """A layer of `PairForce` in each hop, behind layers that put out ``features``."""
    f_pre: list[nn.Module] = [Zero(3 * vectors + scalars)]
    for _ in range(spec.hops):
        force = PairForce(spec.hidden, vectors=vectors, scalars=scalars, earlier=spec.earlier, features=features)
        f_pre.append(TensorDictModule(force, in_keys=["data", "input"], out_keys=["data"]))
    f_final = VectorSquash(vectors) if spec.head is None else spec.head
    return ModGNNLayer(spec.hops, f_pre=f_pre, f_final=f_final)


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


def configured_model(model: ModelConfig, world: FlockingConfig, seed: int) -> ModGNN:
    """The policy that a configuration asks for.

    Args:
        model: which one.
        world: the world that it is trained in: its action ball, and for ``central`` its number of agents.
        seed: seed of the initial weights.

    Raises:
        InputError: a model that cannot serve that world.
    """
    if model.name == "central" and len(world.sizes) > 1:
        raise InputError(f"model 'central' serves one number of agents, and env.num_agents={world.sizes} asks for more")
    return make_model(
        model.name,
        model.hops,
        model.hidden,
        layers=model.layers,
        max_speed=world.max_speed,
        num_agents=world.sizes[0],
        seed=seed,
    )
