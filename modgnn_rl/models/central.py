"""The paper's centralised baseline, as a layer of `modgnn_rl.ModGNN` without messages."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from modgnn_rl.errors import InputError
from modgnn_rl.nn.aggregation import NodeFeatures
from modgnn_rl.nn.recorder import Recorder
from modgnn_rl.nn.topology import Topology
from modgnn_rl.nn.window import mask_invalid
from modgnn_rl.utils.tensors import mask_rows

__all__ = ["CentralLayer"]


class CentralLayer(nn.Module):
    """A network from all agents' observations to all actions: no graph, no delay, a fixed number of agents.

    Positions are relative to the mean position, which makes it invariant to translations. Agents that do not exist, or
    whose observation contains NaN or infinity, are zeros. It is not equivariant to permutations.

    Args:
        num_agents: N.
        features: width of an observation.
        hidden: width of the three hidden layers.
        outputs: width of an agent's output.
        centred: number of leading columns that are a position, of which the mean over the agents is subtracted.
        scale: applied to the centred observation, a module [*, F] -> [*, F].
        head: applied to each agent's output.
    """

    hops = 0
    own_keys: frozenset[tuple[str, ...]] = frozenset()
    sends_plain_data = True
    intermediate_names = (("f_final",),)

    def __init__(
        self,
        num_agents: int,
        features: int,
        hidden: int,
        outputs: int,
        *,
        centred: int = 3,
        scale: nn.Module,
        head: nn.Module,
    ) -> None:
        super().__init__()
        self.num_agents, self.outputs, self.centred = num_agents, outputs, centred
        self.scale, self.head = scale, head
        self.network = nn.Sequential(
            *(nn.Linear(num_agents * features, hidden), nn.ReLU()),
            *(nn.Linear(hidden, hidden), nn.ReLU()),
            *(nn.Linear(hidden, hidden), nn.ReLU()),
            nn.Linear(hidden, num_agents * outputs),
        )

    def forward(
        self,
        observation: Tensor,
        adjacency: Tensor | Topology,
        is_init: Tensor | None = None,
        messages: Tensor | None = None,
        own: NodeFeatures | None = None,
        *,
        receivers: Tensor | None = None,
        record: Recorder | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Run a window; the arguments are those of `ModGNNLayer.forward`, of which it ignores the graph and messages.

        Returns:
            outputs [*B, T, N, O], and no messages [*B, T, N, 0, F].

        Raises:
            InputError: the number of agents is not ``num_agents``.
        """
        shape = observation.shape[:-1]
        if shape[-1] != self.num_agents:
            raise InputError(
                f"a central model for {self.num_agents} agents was given {shape[-1]}; it works for one number only: "
                "train another, or use a model that shares its weights between agents"
            )
        topology = adjacency if isinstance(adjacency, Topology) else Topology(adjacency, shape[-1], receivers=receivers)
        inputs, _, valid = mask_invalid(observation.reshape(shape.numel(), -1), {})
        present = valid if topology.exists is None else valid & topology.exists
        flocks = mask_rows(inputs, present).unflatten(0, (-1, self.num_agents))
        counts = present.view(-1, self.num_agents, 1).sum(1, keepdim=True).clamp(min=1)
        mean = flocks[..., : self.centred].sum(1, keepdim=True) / counts
        centred = torch.cat((flocks[..., : self.centred] - mean, flocks[..., self.centred :]), -1).flatten(0, 1)
        features = mask_rows(self.scale(centred), present).view(-1, self.num_agents * centred.shape[-1])
        output = self.head(self.network(features).view(shape.numel(), self.outputs))
        output = mask_rows(output, valid, torch.nan)
        if topology.targets is not None:
            output = mask_rows(output, topology.targets)
        if record is not None and record.wants("f_final"):
            record.record_nodes("f_final", None, output)
        return output.unflatten(0, shape), inputs.new_zeros(*shape, 0, inputs.shape[-1])
