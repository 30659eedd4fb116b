"""What `modgnn_rl.visualization` draws of a flock, from the environment's tensordicts."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.visualization.recording import Frame, edge_array

__all__ = ["flock_frame"]


def flock_frame(flock: TensorDictBase, config: FlockingConfig) -> Frame:
    """What is drawn of one flock.

    Args:
        flock: the environment's keys and ``("agents", "action")``, without batch dimension.
        config: settings of the environment.

    Returns:
        the frame; its arrows are the target velocities the environment uses: actions projected onto the ball of
        ``max_speed``, zero for agents that have dropped out, and for the leader its velocity.
    """
    agents = flock["agents"]
    position, velocity = flock[config.state_key].split(3, -1)
    controlled = agents["controlled"]
    target = torch.where(controlled.unsqueeze(-1), agents["action"], 0.0).double()
    target[0] = velocity[0]
    speed = target.norm(dim=-1, keepdim=True).clamp(min=config.max_speed)
    return Frame(
        position=position.double().cpu().numpy(),
        arrow=(target * config.max_speed / speed).float().cpu().numpy(),
        edges=edge_array(flock["adjacency"]),
        present=agents.get("mask", torch.ones_like(controlled)).cpu().numpy(),
        leader=0,
    )
