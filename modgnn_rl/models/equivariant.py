"""Forces of pairs: a rotation-equivariant f_pre, and vector messages between layers.

Everything that such a layer reads and writes is made of 3-vectors and scalars, so that a policy of these layers is
invariant to translations and equivariant to rotations and reflections, whatever its weights.
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from modgnn_rl.models.blocks import VELOCITY_SCALE, LayerSpec, Zero, mlp
from modgnn_rl.nn.modgnn import ModGNNLayer
from modgnn_rl.registry import MODELS

__all__ = [
    "SCALARS",
    "VECTORS",
    "Moments",
    "PairForce",
    "VectorSquash",
    "moment_force",
    "pair_force",
]

SOFTENING = 1e-8
TYPICAL_DEGREE = 8.0  # sums over about this many neighbours are scaled to order one


class PairForce(nn.Module):
    r"""The force between two agents, equivariant to rotations and reflections.

    With the relative position r u (distance r, unit vector u) and relative velocity w that hop 1 of the Laplacian
    brings (further hops bring sums of such differences, which are treated alike), and the receiver's own velocity v, a
    small network maps the invariants to (a, b, c), and the force is ``a u + b w + c v``. Forces are summed over the
    neighbours, so that a policy trained at one flock size works at others.

    The C vectors and S scalars that each earlier layer outputs are used in the same way: their differences, and the
    receiver's own.

    Args:
        hidden: width of the network's two hidden layers.
        vectors: number of output vectors.
        scalars: number of output scalars, after the vectors.
        earlier: number of earlier layers.
        features: (C, S), numbers of vectors and scalars that each earlier layer outputs.
    """

    is_equivariant = True

    def __init__(
        self,
        hidden: int = 32,
        *,
        vectors: int = 1,
        scalars: int = 0,
        earlier: int = 0,
        features: tuple[int, int] = (0, 0),
    ) -> None:
        super().__init__()
        self.vectors, self.scalars, self.earlier, self.features = vectors, scalars, earlier, features
        further, numbers = 2 * earlier * features[0], 2 * earlier * features[1]
        self.network = mlp(7 + 4 * further + numbers, hidden, vectors * (3 + further) + scalars)

    def forward(self, relative: Tensor, own: Tensor) -> Tensor:
        """Forces of edges.

        Args:
            relative: sender minus receiver, one step old: position, m, velocity, m/s, outputs of earlier layers [E, F].
            own: the receiver's own position, m (unused), velocity, m/s, and outputs of earlier layers, now [E, F].

        Returns:
            vectors (one: the force, m/s), then scalars [E, 3 V + S].
        """
        # Components first: sums over a last dimension of three are several times slower.
        ends = [data.movedim(-1, 0).contiguous() for data in (relative, own)]
        offset, drift, velocity = ends[0][:3], ends[0][3:6], ends[1][3:6]
        distance, drift_speed, own_speed = _norm(offset), _norm(drift), _norm(velocity)
        unit = offset / distance
        invariants = [
            torch.stack(
                [
                    0.7 * distance - 1.2,
                    (distance + 0.05).log(),
                    VELOCITY_SCALE * drift_speed,
                    VELOCITY_SCALE * _dot(unit, drift),
                    VELOCITY_SCALE * own_speed,
                    VELOCITY_SCALE * _dot(velocity, unit),
                    _dot(velocity, drift),
                ]
            )
        ]
        basis = [torch.stack([unit, drift, velocity])]
        further = [self._of_earlier_layers(end[6:]) for end in ends] if self.earlier else []
        for vectors, scalars in further:
            lengths = (vectors.square().sum(1) + SOFTENING).sqrt()
            products = [(vectors * other).sum(1) for other in (unit, drift, velocity)]
            invariants += [torch.cat(torch.stack([lengths, *products], 1).unbind()), scalars]
            basis.append(vectors)
        numbers = torch.cat(invariants).movedim(0, -1)
        coefficients = self.network(numbers).movedim(-1, 0).contiguous()
        directions = torch.cat(basis)
        weights = coefficients[: self.vectors * len(directions)].unflatten(0, (self.vectors, -1))
        forces = torch.cat((weights.unsqueeze(2) * directions).sum(1).unbind())
        results = [forces, coefficients[self.vectors * len(directions) :]] if self.scalars else [forces]
        return torch.cat(results).movedim(0, -1)

    def _of_earlier_layers(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Vectors [L C, 3, E] and scalars [L S, E] in the outputs of L earlier layers [L (3 C + S), E]."""
        count = self.features[0]
        blocks = outputs.unflatten(0, (self.earlier, -1))
        return blocks[:, : 3 * count].unflatten(1, (count, 3)).flatten(0, 1), blocks[:, 3 * count :].flatten(0, 1)


class Moments(nn.Module):
    r"""Moments of the neighbours' distribution, an f_pre without parameters.

    With relative position r u and relative velocity w of each neighbour, five vectors, ``r u``, ``r^2 u``,
    ``u / (r + 0.3)``, ``w`` and ``r^4 u``, and three scalars, ``1``, ``r`` and ``1 / (r + 0.3)``, scaled to order one.
    The powers of r distinguish near from far neighbours: the fourth is dominated by the farthest.

    After earlier layers, their outputs are summed, in the same form.

    Args:
        earlier: number of earlier layers.
    """

    is_equivariant = True
    vectors, scalars = 5, 3

    def __init__(self, earlier: int = 0) -> None:
        super().__init__()
        self.earlier = earlier

    def forward(self, relative: Tensor) -> Tensor:
        """Vectors and scalars of edges [E, 18].

        Args:
            relative: sender minus receiver, one step old: position, m, velocity, m/s, outputs of earlier layers [E, F].
        """
        if self.earlier:
            return relative[..., -(3 * self.vectors + self.scalars) :] / TYPICAL_DEGREE
        offset, drift = relative[..., :6].movedim(-1, 0).contiguous().split(3)
        distance = _norm(offset)
        nearness = 1 / (distance + 0.3)
        vectors = [
            offset / TYPICAL_DEGREE,
            offset * (distance / (2 * TYPICAL_DEGREE)),
            offset * (2 * nearness / (distance * TYPICAL_DEGREE)),
            drift * (2 / TYPICAL_DEGREE),
            offset * (distance**3 / (8 * TYPICAL_DEGREE)),
        ]
        scalars = torch.stack([torch.ones_like(distance), distance / 2, nearness]) / TYPICAL_DEGREE
        return torch.cat([*vectors, scalars]).movedim(0, -1)


class VectorSquash(nn.Module):
    """Scale vectors and scalars of any size to order one, equivariantly: ``x / (1 + |x|)`` each.

    Args:
        vectors: number of vectors V; scalars follow them.
    """

    is_equivariant = True

    def __init__(self, vectors: int) -> None:
        super().__init__()
        self.vectors = vectors

    def forward(self, data: Tensor) -> Tensor:
        """Squash [..., 3 V + S]."""
        vectors, scalars = data[..., : 3 * self.vectors].unflatten(-1, (-1, 3)), data[..., 3 * self.vectors :]
        length = (vectors.square().sum(-1, keepdim=True) + 1e-8).sqrt()
        return torch.cat(((vectors / (1 + length)).flatten(-2), scalars / (1 + scalars.abs())), -1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products [...] of vectors with the component first [3, ...]."""
    return (a * b).sum(0)


def _norm(vector: Tensor) -> Tensor:
    """Lengths [...] of vectors [3, ...], softened so that the gradient exists at zero."""
    return (_dot(vector, vector) + SOFTENING).sqrt()


VECTORS, SCALARS = 4, 4  # outputs of pair_force's layers before the last: 3 * 4 + 4 features


@MODELS.register("moment_force", layers=2, is_physical=True)
def moment_force(spec: LayerSpec) -> ModGNNLayer:
    """`pair_force` that also reads `Moments` of the neighbours' own neighbourhoods, from the layers before the last.

    These have no parameters, so that an agent uses data from two hops away at little more training cost than with one.
    """
    features = Moments.vectors, Moments.scalars
    if spec.head is not None:
        return _sum_of_forces(spec, 1, 0, features)
    f_pre = [Zero(3 * Moments.vectors + Moments.scalars), *(Moments(spec.earlier) for _ in range(spec.hops))]
    return ModGNNLayer(spec.hops, f_pre=f_pre, f_final=VectorSquash(Moments.vectors))


@MODELS.register("pair_force", is_physical=True)
def pair_force(spec: LayerSpec) -> ModGNNLayer:
    """Equivariant pairwise forces as f_pre, summed over the neighbours: `PairForce`; hop 0 contributes nothing.

    Layers before the last output four vectors and four scalars, which later layers use like velocities.
    """
    vectors, scalars = (VECTORS, SCALARS) if spec.head is None else (1, 0)
    return _sum_of_forces(spec, vectors, scalars, features=(VECTORS, SCALARS))


def _sum_of_forces(spec: LayerSpec, vectors: int, scalars: int, features: tuple[int, int]) -> ModGNNLayer:
    """A layer with a `PairForce` in each hop, after layers that output ``features``."""
    f_pre: list[nn.Module] = [Zero(3 * vectors + scalars)]
    for _ in range(spec.hops):
        force = PairForce(spec.hidden, vectors=vectors, scalars=scalars, earlier=spec.earlier, features=features)
        f_pre.append(TensorDictModule(force, in_keys=["data", "input"], out_keys=["data"]))
    f_final = VectorSquash(vectors) if spec.head is None else spec.head
    return ModGNNLayer(spec.hops, f_pre=f_pre, f_final=f_final)
