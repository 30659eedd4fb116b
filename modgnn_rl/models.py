"""The models: configurations of ModGNN's submodules, by name.

All of them act on observations (position, velocity) [*B, N, 6] with one head, the projection onto the action ball, and
none of them sees an absolute position: hop 0 reads the agent's velocity, the other hops differences.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from modgnn_rl.errors import InputError
from modgnn_rl.modgnn import ModGNN, ModGNNLayer
from modgnn_rl.settings import suggestion
from modgnn_rl.tensors import clip_to_ball

__all__ = ["MODELS", "BallHead", "PairForce", "Scale", "make_model"]

POSITION_SCALE = 0.5  # 1/m
VELOCITY_SCALE = 1.4  # s/m
LATENT = 10  # width of f_pre's and f_mid's outputs in the paper


class BallHead(nn.Module):
    """Projection onto the ball of allowed actions: what the environment and the expert do to theirs."""

    def __init__(self, max_speed: float) -> None:
        super().__init__()
        self.max_speed = max_speed

    def forward(self, action: Tensor) -> Tensor:
        """Project actions [..., 3], m/s."""
        return clip_to_ball(action, self.max_speed)


class Scale(nn.Module):
    """Bring positions and velocities to order one, and hide the position where it is absolute.

    Args:
        hide_position: return zero positions, for data that are no differences.
    """

    is_linear_map = True
    factor: Tensor

    def __init__(self, *, hide_position: bool = False) -> None:
        super().__init__()
        position = 0.0 if hide_position else POSITION_SCALE
        self.register_buffer("factor", torch.tensor([position] * 3 + [VELOCITY_SCALE] * 3), persistent=False)

    def forward(self, data: Tensor) -> Tensor:
        """Scale position and velocity [..., 6]."""
        return data * self.factor


class Zero(nn.Module):
    """A hop that contributes nothing: zeros of a given width."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.features = features

    def forward(self, data: Tensor) -> Tensor:
        """Return zeros [..., features]."""
        return data.new_zeros(*data.shape[:-1], self.features)


class PairForce(nn.Module):
    r"""The force between two agents, equivariant to rotations and reflections.

    With the relative position r u (distance r, unit vector u) and relative velocity w that hop 1 of the Laplacian
    brings (further hops bring sums of such differences, which are treated alike), and the receiver's own velocity v, a
    small network maps the invariants to (a, b, c), and the force is ``a u + b w + c v``. Forces are summed over the
    neighbours, so that a policy trained at one flock size flies at others.

    Args:
        hidden: width of the network's two hidden layers.
    """

    def __init__(self, hidden: int = 32) -> None:
        super().__init__()
        self.network = _mlp(7, hidden, 3)

    def forward(self, relative: Tensor, observation: Tensor) -> Tensor:
        """Forces of links.

        Args:
            relative: sender minus receiver, one step old: position, m, and velocity, m/s [E, 6].
            observation: the receiver's own position, m (unused), and velocity, m/s, now [E, 6].

        Returns:
            force, m/s [E, 3].
        """
        # Components first: sums over three numbers in a row are several times slower.
        offset, drift = relative.movedim(-1, 0).contiguous().split(3)
        own = observation[..., 3:].movedim(-1, 0).contiguous()
        distance, drift_speed, own_speed = _norm(offset), _norm(drift), _norm(own)
        unit = offset / distance
        invariants = (
            0.7 * distance - 1.2,
            (distance + 0.05).log(),
            VELOCITY_SCALE * drift_speed,
            VELOCITY_SCALE * _dot(unit, drift),
            VELOCITY_SCALE * own_speed,
            VELOCITY_SCALE * _dot(own, unit),
            _dot(own, drift),
        )
        radial, along_drift, along_own = self.network(torch.stack(invariants, -1)).unbind(-1)
        return (radial * unit + along_drift * drift + along_own * own).movedim(0, -1)


def modgnn_mlp(hops: int, hidden: int, max_speed: float) -> ModGNNLayer:
    """ModGNN-MLP of the paper: three-layer networks for f_pre, f_mid (10 features out) and f_final, one a hop."""
    f_pre = [nn.Sequential(Scale(hide_position=hop == 0), _mlp(6, hidden, LATENT)) for hop in range(hops + 1)]
    f_mid = [_mlp(LATENT, hidden, LATENT) for _ in range(hops + 1)]
    return ModGNNLayer(
        hops, f_pre=f_pre, f_mid=f_mid, f_final=nn.Sequential(_mlp(LATENT, hidden, 3), BallHead(max_speed))
    )


def gcn(hops: int, hidden: int, max_speed: float) -> ModGNNLayer:
    """A GCN: a matrix for each hop as f_mid, no f_pre, and the head as pointwise f_final; ``hidden`` is not used."""
    f_pre = [Scale(hide_position=hop == 0) for hop in range(hops + 1)]
    f_mid = [nn.Linear(6, 3, bias=hop == 0) for hop in range(hops + 1)]
    return ModGNNLayer(hops, f_pre=f_pre, f_mid=f_mid, f_final=BallHead(max_speed))


def pair_force(hops: int, hidden: int, max_speed: float) -> ModGNNLayer:
    """Equivariant forces of pairs as f_pre, summed over the neighbours: `PairForce`; hop 0 contributes nothing."""
    force = ["data", ("own", "observation")]
    f_pre: list[nn.Module] = [Zero(3)]
    f_pre += [TensorDictModule(PairForce(hidden), in_keys=force, out_keys=["data"]) for _ in range(hops)]
    return ModGNNLayer(hops, f_pre=f_pre, f_final=BallHead(max_speed))


MODELS: dict[str, Callable[[int, int, float], ModGNNLayer]] = {
    "modgnn_mlp": modgnn_mlp,
    "gcn": gcn,
    "pair_force": pair_force,
}


def make_model(
    name: str, hops: int = 1, hidden: int = 32, *, max_speed: float = 0.92, seed: int | None = None, **keys: Any
) -> ModGNN:
    """Build a model by name.

    Args:
        name: one of `MODELS`.
        hops: number of communication hops K.
        hidden: width of the hidden layers.
        max_speed: radius of the action ball, m/s.
        seed: seed of the initial weights; default: torch's global generator as it stands.
        keys: names of keys, see `ModGNN`.

    Returns:
        the policy, a TensorDictModule for any number of agents.

    Raises:
        InputError: for an unknown name.
    """
    if name not in MODELS:
        raise InputError(f"model '{name}' is not one of {', '.join(MODELS)}{suggestion(name, MODELS)}")
    with torch.random.fork_rng(devices=[], enabled=seed is not None):
        if seed is not None:
            torch.default_generator.manual_seed(seed)  # torch.manual_seed would also seed the accelerators
        return ModGNN(MODELS[name](hops, hidden, max_speed), **keys)


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Linear-ReLU-Linear-ReLU-Linear, the paper's three-layer network."""
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs)
    )


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products [...] of vectors with the component first [3, ...]."""
    return (a * b).sum(0)


def _norm(vector: Tensor) -> Tensor:
    """Lengths [...] of vectors [3, ...], softened so that the gradient exists at zero."""
    return (_dot(vector, vector) + 1e-8).sqrt()
