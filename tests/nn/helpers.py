"""What several tests of graphs and layers build."""

from __future__ import annotations

import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from modgnn_rl.nn.aggregation import NodeInputs, aggregate
from modgnn_rl.nn.graph import EdgeList

__all__ = [
    "WIDTH",
    "assert_all_close",
    "dense",
    "edge_lists",
    "numbers",
    "random_edges",
    "random_inputs",
    "random_window",
    "results",
    "run",
]

WIDTH = 3  # of messages


def numbers(*shape: int) -> Tensor:
    """Random numbers, float64."""
    return torch.randn(*shape, dtype=torch.float64)


def dense(inputs: int, outputs: int) -> nn.Module:
    """A small smooth network."""
    return nn.Sequential(nn.Linear(inputs, 4), nn.Tanh(), nn.Linear(4, outputs))


def random_window(*batch: int, agents: int = 4, features: int = 2) -> TensorDict:
    """Observations, goals, graphs, edge weights and edge features of a window [*B]."""
    shape = (*batch, agents, agents)
    return TensorDict(
        {
            "agents": {"observation": numbers(*batch, agents, features), "goal": numbers(*batch, agents, 1)},
            "adjacency": (torch.rand(shape) < 0.5) & ~torch.eye(agents, dtype=torch.bool),
            "weight": numbers(*shape),
            "feature": numbers(*shape, 3),
        },
        batch,
    )


def run(policy: nn.Module, data: TensorDict, *receivers: Tensor) -> TensorDict:
    """Run a policy on a copy of a window."""
    with set_recurrent_mode(True):
        return policy(data.clone(), *receivers)


def random_edges(senders: int, receivers: int, share: float, **attributes: Tensor) -> EdgeList:
    """Edges between two different sets of nodes, some of which may have none."""
    receiver, sender = (torch.rand(receivers, senders) < share).nonzero().unbind(-1)
    return EdgeList(sender, receiver, senders, receivers, **attributes)


edge_lists = st.builds(
    lambda senders, receivers, share, seed: (torch.manual_seed(seed), random_edges(senders, receivers, share))[1],
    senders=st.integers(1, 6),
    receivers=st.integers(0, 6),
    share=st.sampled_from([0.0, 0.3, 1.0]),
    seed=st.integers(0, 999),
)


def random_inputs(edges: EdgeList, **own: Tensor) -> NodeInputs:
    """Random messages held by senders and receivers, and the receivers' own data by name."""
    rows = edges.num_senders, edges.num_receivers
    senders, receivers = (numbers(count, WIDTH).requires_grad_() for count in rows)
    return NodeInputs(senders, receivers, {("own", name): value for name, value in own.items()})


def results(
    edges: EdgeList, f_com: nn.Module, f_pre: nn.Module, inputs: NodeInputs, kind: str, *, at_once: bool = False
) -> list[Tensor]:
    """The aggregate, and its gradients for tables and weights; ``at_once`` by plain autograd over all edges."""
    value = aggregate(edges, f_com, f_pre, inputs, kind, (lambda name, rows: None) if at_once else None)
    tables = [table for table in (inputs.senders, inputs.receivers, *inputs.own.values()) if table.requires_grad]
    wanted = tables + [weight for module in (f_com, f_pre) for weight in module.parameters() if weight.requires_grad]
    scale = torch.linspace(0.5, 1.5, value.numel(), dtype=value.dtype).view_as(value)
    if not value.requires_grad:
        return [value, *map(torch.zeros_like, wanted)]
    return [value, *torch.autograd.grad((value * scale).sum(), wanted, allow_unused=True, materialize_grads=True)]


def assert_all_close(ours: list[Tensor], theirs: list[Tensor], tolerance: float = 1e-12) -> None:
    """Two lists of tensors are equal but for rounding."""
    for our, their in zip(ours, theirs, strict=True):
        torch.testing.assert_close(our, their, rtol=tolerance, atol=tolerance)
