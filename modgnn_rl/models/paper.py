"""The paper's models: ModGNN-MLP, its ablations, the GCN baselines and the centralised baseline."""

from __future__ import annotations

from torch import nn

from modgnn_rl.errors import InputError
from modgnn_rl.models.blocks import LATENT, LayerSpec, Scale, mlp
from modgnn_rl.models.central import CentralLayer
from modgnn_rl.nn.communication import Adjacency
from modgnn_rl.nn.modgnn import ModGNNLayer
from modgnn_rl.registry import MODELS

__all__ = ["central", "gcn", "gcn_final", "modgnn_adjacency", "modgnn_mlp", "no_mid", "no_pre"]


@MODELS.register("modgnn_mlp")
def modgnn_mlp(spec: LayerSpec) -> ModGNNLayer:
    """ModGNN-MLP of the paper: three-layer networks as f_pre and f_mid (10 features) of each hop and as f_final."""
    f_pre = [nn.Sequential(scale, mlp(spec.inputs, spec.hidden, LATENT)) for scale in spec.scales()]
    f_mid = [mlp(LATENT, spec.hidden, LATENT) for _ in f_pre]
    f_final = spec.end(mlp(LATENT, spec.hidden, spec.outputs))
    return ModGNNLayer(spec.hops, f_pre=f_pre, f_mid=f_mid, f_final=f_final)


@MODELS.register("modgnn_adjacency")
def modgnn_adjacency(spec: LayerSpec) -> ModGNNLayer:
    """ModGNN-MLP with the adjacency as f_com: sums of the neighbours' data, not of differences, as in a plain GCN."""
    layer = modgnn_mlp(spec)
    layer.f_com = nn.ModuleList([Adjacency() for _ in range(spec.hops)])
    return layer


@MODELS.register("no_pre")
def no_pre(spec: LayerSpec) -> ModGNNLayer:
    """ModGNN-MLP without f_pre: the neighbours' data are summed before any network is applied."""
    f_mid = [mlp(spec.inputs, spec.hidden, LATENT) for _ in range(spec.hops + 1)]
    f_final = spec.end(mlp(LATENT, spec.hidden, spec.outputs))
    return ModGNNLayer(spec.hops, f_pre=spec.scales(), f_mid=f_mid, f_final=f_final)


@MODELS.register("no_mid")
def no_mid(spec: LayerSpec) -> ModGNNLayer:
    """ModGNN-MLP without f_mid: the outputs of f_pre are summed over neighbours and hops."""
    f_pre = [nn.Sequential(scale, mlp(spec.inputs, spec.hidden, LATENT)) for scale in spec.scales()]
    return ModGNNLayer(spec.hops, f_pre=f_pre, f_final=spec.end(mlp(LATENT, spec.hidden, spec.outputs)))


@MODELS.register("gcn")
def gcn(spec: LayerSpec) -> ModGNNLayer:
    """GCN: one matrix per hop as f_mid, no f_pre, a pointwise f_final (the head); ``hidden`` is not used."""
    f_mid = [nn.Linear(spec.inputs, spec.outputs, bias=hop == 0) for hop in range(spec.hops + 1)]
    f_final = nn.Tanh() if spec.head is None else spec.head
    return ModGNNLayer(spec.hops, f_pre=spec.scales(), f_mid=f_mid, f_final=f_final)


@MODELS.register("gcn_final")
def gcn_final(spec: LayerSpec) -> ModGNNLayer:
    """GCN + f_final of the paper: one matrix per hop, then a three-layer network in place of the activation."""
    f_mid = [nn.Linear(spec.inputs, LATENT, bias=hop == 0) for hop in range(spec.hops + 1)]
    f_final = spec.end(mlp(LATENT, spec.hidden, spec.outputs))
    return ModGNNLayer(spec.hops, f_pre=spec.scales(), f_mid=f_mid, f_final=f_final)


@MODELS.register("central")
def central(spec: LayerSpec) -> CentralLayer:
    """The paper's centralised baseline: four linear layers from all observations to all actions, for a fixed N."""
    if spec.num_agents is None:
        raise InputError("model 'central' reads all agents at once: give num_agents")
    if spec.head is None or spec.earlier:
        raise InputError("model 'central' has one layer; give layers=1")
    return CentralLayer(
        spec.num_agents,
        spec.inputs,
        spec.hidden,
        spec.outputs,
        centred=spec.layout.hidden,
        scale=Scale(spec.layout),
        head=spec.head,
    )
