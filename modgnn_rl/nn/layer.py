"""One layer of ModGNN over delayed messages, as a function of tensors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import torch
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn

from modgnn_rl.errors import InputError
from modgnn_rl.nn.aggregation import Hop, NodeFeatures, aggregate, call, suited_form
from modgnn_rl.nn.communication import GraphShift, Laplacian
from modgnn_rl.nn.graph import AGGREGATIONS, Graph
from modgnn_rl.nn.topology import Topology
from modgnn_rl.utils.tensors import flatnonzero, mask_rows, stack_padded

__all__ = ["STARTS", "ModGNNLayer", "Recorder", "only_finite"]

Submodule = nn.Module | None
PerHop = Submodule | Sequence[Submodule]
STARTS = ("mask", "zero", "repeat")
PER_HOP = {"f_com": 1, "f_pre": 0, "f_mid": 0}  # submodules that may differ between hops, and their first hop


class Recorder(Protocol):
    """Takes intermediate results that somebody asked for."""

    def wants(self, name: str, hop: int | None = None) -> bool:
        """Whether the result of this name is asked for."""

    def nodes(self, name: str, hop: int | None, value: Tensor) -> None:
        """Take a result of all agents [R, F]."""

    def links(self, name: str, hop: int, value: Tensor, graph: Graph) -> None:
        """Take a result of all links [E, F]."""


class ModGNNLayer(nn.Module):
    r"""One layer of ModGNN over delayed messages.

    With c_i(t) = f_input(o_i(t)) and m_i^(0)(t) = c_i(t), at every agent i with neighbours N_i(t)::

        y_ij^(k)(t) = f_com(m_j^(k-1)(t-1), m_i^(k-1)(t-1)),                    j in N_i(t), k = 1..K
        m_i^(k)(t)  = sum_j y_ij^(k)(t),                                        k = 1..K-1
        x_i(t)      = f_final( f_mid^(0)(f_pre^(0)(c_i(t))) + sum_k f_mid^(k)( sum_j f_pre^(k)(y_ij^(k)(t)) ) )

    A submodule that is left out is the identity. Each may be a plain module or a TensorDictModule with keys of its own,
    whose out-key, or the last of several, is the result. It reads ``"data"`` (what a plain module would get; f_com
    instead ``"sender"`` and ``"receiver"``), and anything of

    - ``("own", name)``: the agent's own data at time t (in f_com and f_pre: the receiver's), for example
      ``("own", "observation")``, or another name that lies beside the observation;
    - ``"input"``: the agent's own input of this layer at time t, observation and outputs of earlier layers;
    - in f_com and f_pre, ``("link", "weight")`` and ``("link", "feature")``.

    On a built layer a submodule is an attribute like any other: ``layer.f_final = module``, ``layer.f_pre[1] = module``
    for one hop, ``layer.f_pre = module`` for all hops. One module in several places has one set of weights.

    What an agent sees that is not finite is not sent, and its output at that step is NaN; so nothing of it reaches
    others, nor the gradients.

    Args:
        hops: number of hops K >= 0.
        f_input: encodes the observation.
        f_com: what an agent makes of one incoming message, see `modgnn_rl.nn.communication`; one module for all hops,
            or
            a list of K. Default: the Laplacian, incoming minus own.
        f_pre: applied to each incoming datum before the sum over neighbours; one module for all hops, or a list of
            K + 1 (``None`` in it is the identity).
        f_mid: applied to each hop's sum; one module or a list of K + 1.
        f_final: applied to the sum over hops.
        start: what stands for data that an agent does not hold yet. ``mask``: the hop contributes nothing; ``zero``:
            the data are zero; ``repeat``: the first observation and graph are repeated backwards.
        aggregation: what is written as a sum over the neighbours above: ``sum``, ``mean`` or ``max``; zero for an agent
            without neighbours.

    Raises:
        InputError: on a negative or fractional ``hops``, a list of the wrong length, an unknown ``start`` or
            ``aggregation``.
    """

    f_input: nn.Module
    f_com: nn.ModuleList
    f_pre: nn.ModuleList
    f_mid: nn.ModuleList
    f_final: nn.Module

    def __init__(
        self,
        hops: int,
        f_input: Submodule = None,
        f_com: PerHop = None,
        f_pre: PerHop = None,
        f_mid: PerHop = None,
        f_final: Submodule = None,
        *,
        start: str = "mask",
        aggregation: str = "sum",
    ) -> None:
        super().__init__()
        if not isinstance(hops, int) or hops < 0:
            raise InputError(f"hops={hops!r} is not a number of hops; expected an integer of at least 0")
        for name, value, choices in (("start", start, STARTS), ("aggregation", aggregation, AGGREGATIONS)):
            if value not in choices:
                raise InputError(f"{name}={value!r} is not one of {', '.join(choices)}")
        self.hops, self.start, self.aggregation = hops, start, aggregation
        submodules = {"f_input": f_input, "f_com": f_com, "f_pre": f_pre, "f_mid": f_mid, "f_final": f_final}
        for name, module in submodules.items():
            setattr(self, name, module)  # completed by __setattr__

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; a submodule is completed first: identities where it is None, one module for each hop."""
        if name in PER_HOP:
            value = _per_hop(name, value, self.hops)
        elif name in ("f_input", "f_final") and value is None:
            value = nn.Identity()
        super().__setattr__(name, value)

    @property
    def submodules(self) -> Iterable[nn.Module]:
        """F_input, f_com of each hop, f_pre and f_mid of each hop, f_final."""
        return self.f_input, *self.f_com, *self.f_pre, *self.f_mid, self.f_final

    @property
    def own_keys(self) -> set[tuple[str, ...]]:
        """What the keyed submodules read of the agent's own data, without the leading ``"own"``."""
        return self._keys_under("own")

    def _keys_under(self, group: str) -> set[tuple[str, ...]]:
        keyed = (module for module in self.submodules if isinstance(module, TensorDictModuleBase))
        keys = {unravel_key(key) for module in keyed for key in module.in_keys}
        return {key[1:] for key in keys if isinstance(key, tuple) and key[0] == group}

    @property
    def results(self) -> list[tuple[str, ...]]:
        """Names of the intermediate results that a recorder may want, with their hops."""
        hops = {"messages": range(self.hops), "f_com": range(1, self.hops + 1)}
        names = ("messages", "f_com", "f_pre", "sum", "f_mid")
        numbered = [(name, str(hop)) for name in names for hop in hops.get(name, range(self.hops + 1))]
        return [("f_input",), *numbered, ("f_final",)]

    @property
    def sends_plain_data(self) -> bool:
        """Whether messages are sums of observations, so that stored ones never grow stale and turn as vectors do."""
        plain = all(isinstance(f_com, GraphShift) for f_com in self.f_com[: self.hops - 1])
        return isinstance(self.f_input, nn.Identity) and (self.hops <= 1 or (plain and self.aggregation != "max"))

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
        """Run a window of T steps; one environment step is a window with T = 1.

        Args:
            observation: o [*B, T, N, F].
            adjacency: the graphs of all steps, in any form that `Topology` takes, or the Topology itself, which then
                also knows the receivers.
            is_init: steps at which an episode begins, bool [*B, T]; default: none does.
            messages: the messages of the step before the window [*B, N, K, D]; a hop that an agent does not hold is
                NaN. Default: nobody holds anything.
            own: further data of the agents for keyed submodules [*B, T, N, ...].
            receivers: the agents and steps whose output is wanted, bool [*B, T, N]; the others cost nothing but their
                messages and get zeros. Default: all.
            record: takes intermediate results.

        Returns:
            x [*B, T, N, O], and the messages sent at each step [*B, T, N, K, D].
        """
        shape = observation.shape[:-1]
        if isinstance(adjacency, Tensor):
            adjacency = Topology(adjacency, shape[-1], receivers=receivers, form=suited_form("auto", self))
        topology, rows = adjacency, adjacency.rows
        if topology.num_nodes != shape.numel():
            flocks = topology.num_nodes // max(shape[-1], 1)
            raise InputError(f"there are {flocks} graphs for observations {list(shape)} of flocks; each needs its own")
        for (name,) in self._keys_under("link"):
            if getattr(topology, name, None) is None:
                raise InputError(f"a submodule reads ('link', '{name}'), and the links have no {name}; see link_{name}")
        flat = {("own", *key): value.flatten(0, len(shape) - 1) for key, value in (own or {}).items()}
        seen, flat, sees = only_finite(observation.reshape(shape.numel(), observation.shape[-1]), flat, topology.exists)
        flat[("input",)] = seen

        # Modules may work in place; what they are given here is read again.
        data, held = _call_for(topology.exists, topology, self.f_input, seen.clone(), flat), sees
        _record(record, "f_input", None, data)
        mine = {key: _take(value, rows) for key, value in flat.items()}
        processed = call(self.f_pre[0], _take(data, rows).clone(), mine)
        _record(record, "f_pre", 0, processed)
        total = self._contribution(0, processed, mine, None, topology, record)
        first = data  # of start="repeat"
        sent = []
        for hop in range(1, self.hops + 1):
            sent.append(mask_rows(data, held, torch.nan).to(seen.dtype))
            _record(record, "messages", hop - 1, sent[-1])
            stored = None if messages is None else messages[..., hop - 1, : data.shape[-1]]
            before, held = _one_step_earlier(data, held, stored, is_init, shape)
            if self.start == "repeat":
                known = sees & first.isfinite().all(-1)
                before, held = torch.where((held | ~known).unsqueeze(-1), before, first), held | known
            elif self.start == "zero":
                held = torch.ones_like(held)
            graph = topology.target_edges().between(held, _take(held, rows))
            incoming = Hop(before, _take(before, rows), mine)
            summed = self._summed(hop, self.f_pre[hop], graph, incoming, record)
            total = total + self._contribution(hop, summed, mine, _take(held, rows), topology, record)
            if hop < self.hops:
                everyone = topology.all_edges()
                data = self._summed(hop, None, everyone.between(held, held), Hop(before, before, flat))
                if self.start == "repeat":
                    first = self._summed(hop, None, everyone.between(known, known), Hop(first, first, flat))
                if topology.exists is not None:
                    held = held & topology.exists

        output = call(self.f_final, total, mine)
        output = mask_rows(output, _take(sees, rows), torch.nan)
        if rows is not None:
            output = output.new_zeros(shape.numel(), output.shape[-1]).index_copy(0, rows, output)
        elif topology.wanted_nodes is not None:
            output = mask_rows(output, topology.wanted_nodes)
        _record(record, "f_final", None, output)
        messages = stack_padded(sent) if sent else data.new_zeros(shape.numel(), 0, data.shape[-1])
        return output.unflatten(0, shape), messages.unflatten(0, shape)

    def _summed(
        self, hop: int, f_pre: nn.Module | None, graph: Graph, incoming: Hop, record: Recorder | None = None
    ) -> Tensor:
        """Aggregate one hop's incoming messages over the neighbours; without f_pre, what the agent will pass on."""
        take = None
        if record is not None and (record.wants("f_com", hop) or record.wants("f_pre", hop)):
            recorder = record

            def take(name: str, value: Tensor) -> None:
                if recorder.wants(name, hop):
                    recorder.links(name, hop, value, graph)

        module = nn.Identity() if f_pre is None else f_pre
        return aggregate(graph, self.f_com[hop - 1], module, incoming, self.aggregation, take)

    def _contribution(
        self,
        hop: int,
        summed: Tensor,
        mine: NodeFeatures,
        held: Tensor | None,
        topology: Topology,
        record: Recorder | None,
    ) -> Tensor:
        """F_mid of one hop's sum; zero for agents that hold no such hop."""
        _record(record, "sum", hop, summed)
        result = _call_for(held, topology, self.f_mid[hop], summed, mine)
        _record(record, "f_mid", hop, result)
        return result


def _call_for(who: Tensor | None, topology: Topology, module: nn.Module, data: Tensor, own: NodeFeatures) -> Tensor:
    """Apply a submodule for some agents, bool [R], or all; zeros for the others, whose rows no batch statistics see."""
    if who is None:
        return call(module, data, own)
    if topology.as_pairs or who.all():
        return mask_rows(call(module, data, own), who)
    rows = flatnonzero(who)
    result = call(module, _take(data, rows), {key: _take(value, rows) for key, value in own.items()})
    return result.new_zeros(len(data), *result.shape[1:]).index_copy(0, rows, result)


def _take(table: Tensor, rows: Tensor | None) -> Tensor:
    return table if rows is None else table.index_select(0, rows)


def _record(record: Recorder | None, name: str, hop: int | None, value: Tensor) -> None:
    if record is not None and record.wants(name, hop):
        record.nodes(name, hop, value)


def only_finite(
    observation: Tensor, own: NodeFeatures, exists: Tensor | None = None
) -> tuple[Tensor, dict[tuple[str, ...], Tensor], Tensor]:
    """Zero all data of agents that see anything not finite or do not exist, bool [R]; also returns the others."""
    sees = observation.isfinite().all(-1)
    if exists is not None:
        sees = sees & exists
    for value in own.values():
        sees = sees & value.isfinite().flatten(1).all(-1)
    clean = {key: mask_rows(value, sees) for key, value in own.items()}
    return mask_rows(observation, sees), clean, sees


def _one_step_earlier(
    data: Tensor, held: Tensor, stored: Tensor | None, is_init: Tensor | None, shape: torch.Size
) -> tuple[Tensor, Tensor]:
    """What the agents [*B, T, N] held one step earlier, [R, D], zero where they held nothing, and who held it [R].

    What was stored comes first in the window; at the start of episodes nobody holds anything, and never what is not
    finite.
    """
    window, holds = data.unflatten(0, shape), held.unflatten(0, shape)
    stored_held = torch.full_like(holds[..., 0, :], stored is not None)
    if stored is None:
        stored = torch.zeros_like(window[..., 0, :, :])
    before = torch.cat((stored.unsqueeze(-3), window[..., :-1, :, :]), -3)
    held_before = torch.cat((stored_held.unsqueeze(-2), holds[..., :-1, :]), -2) & before.isfinite().all(-1)
    if is_init is not None:
        held_before = held_before & ~is_init.unsqueeze(-1)
    before, held_before = before.flatten(0, -2), held_before.flatten()
    return mask_rows(before, held_before), held_before


def _per_hop(name: str, module: PerHop, hops: int) -> nn.ModuleList:
    """One module for each of the hops: the given ones, or the given one shared by all."""
    first = PER_HOP[name]
    count = hops + 1 - first
    is_one = module is None or (isinstance(module, nn.Module) and not isinstance(module, nn.ModuleList))
    modules: list[Submodule] = [module] * count if is_one else list(module)  # type: ignore[arg-type, list-item]
    if len(modules) != count:
        raise InputError(
            f"{name} has {len(modules)} modules; hops={hops} needs one module, or {count} (hops {first}..{hops})"
        )
    missing = Laplacian if name == "f_com" else nn.Identity
    return nn.ModuleList([missing() if item is None else item for item in modules])
