"""Models with learned communication: graph attention and message passing."""

from __future__ import annotations

import math

from torch import nn

from modgnn_rl.models.blocks import LATENT, LayerSpec, Relative, Scale, mlp
from modgnn_rl.nn.communication import GraphAttention, MessagePassing
from modgnn_rl.nn.modgnn import ModGNNLayer
from modgnn_rl.registry import MODELS

__all__ = ["HEADS", "gat", "mpnn"]

HEADS = 4  # attention heads


@MODELS.register("gat")
def gat(spec: LayerSpec) -> ModGNNLayer:
    """Attention over the neighbours as f_com (GATv2): to differences in hop 1, then to the previous hop's output."""
    heads = math.gcd(HEADS, spec.hidden)
    f_com: list[nn.Module] = [
        GraphAttention(spec.hidden if hop > 1 else spec.inputs, spec.hidden, heads, relative=hop == 1)
        for hop in range(1, spec.hops + 1)
    ]
    return _networks_of_hops(spec, f_com)


@MODELS.register("mpnn")
def mpnn(spec: LayerSpec) -> ModGNNLayer:
    """Message passing: a learned network of sender and receiver as f_com."""
    f_com: list[nn.Module] = []
    for hop in range(1, spec.hops + 1):
        width = 2 * spec.inputs - spec.layout.hidden if hop == 1 else 2 * spec.hidden
        network = mlp(width, spec.hidden, spec.hidden)
        f_com.append(
            MessagePassing(nn.Sequential(Relative(spec.layout, spec.inputs), network) if hop == 1 else network)
        )
    return _networks_of_hops(spec, f_com)


def _networks_of_hops(spec: LayerSpec, f_com: list[nn.Module]) -> ModGNNLayer:
    """A layer whose f_com outputs ``hidden`` features, with networks as f_mid and f_final."""
    f_pre = [Scale(spec.layout, spec.inputs, hide_position=True), *[None] * spec.hops]
    f_mid = [mlp(spec.inputs if hop == 0 else spec.hidden, spec.hidden, LATENT) for hop in range(spec.hops + 1)]
    f_final = spec.end(mlp(LATENT, spec.hidden, spec.outputs))
    return ModGNNLayer(spec.hops, f_com=f_com, f_pre=f_pre, f_mid=f_mid, f_final=f_final)
