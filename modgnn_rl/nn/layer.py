"""One layer of ModGNN over delayed messages, as a function of tensors."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn

from modgnn_rl.errors import InputError
from modgnn_rl.nn.aggregation import NodeFeatures, NodeInputs, aggregate, call_submodule, resolve_form
from modgnn_rl.nn.communication import GraphShift, Laplacian
from modgnn_rl.nn.delay import STARTS, previous_step
from modgnn_rl.nn.graph import AGGREGATIONS
from modgnn_rl.nn.recorder import Recorder
from modgnn_rl.nn.topology import Topology
from modgnn_rl.nn.window import Window, call_where, mask_invalid, select
from modgnn_rl.utils.tensors import mask_rows, stack_padded

__all__ = ["ModGNNLayer"]

Submodule = nn.Module | None
PerHop = Submodule | Sequence[Submodule]
PER_HOP = {"f_com": 1, "f_pre": 0, "f_mid": 0}  # submodules that may differ between hops, and their first hop


class ModGNNLayer(nn.Module):
    r"""One layer of ModGNN over delayed messages.

    With c_i(t) = f_input(o_i(t)) and m_i^(0)(t) = c_i(t), at every agent i with neighbours N_i(t)::

        y_ij^(k)(t) = f_com(m_j^(k-1)(t-1), m_i^(k-1)(t-1)),                    j in N_i(t), k = 1..K
        m_i^(k)(t)  = sum_j y_ij^(k)(t),                                        k = 1..K-1
        x_i(t)      = f_final( f_mid^(0)(f_pre^(0)(c_i(t))) + sum_k f_mid^(k)( sum_j f_pre^(k)(y_ij^(k)(t)) ) )

    A submodule that is left out is the identity. Each may be a plain module or a TensorDictModule with its own keys,
    whose last out-key is the result. It reads ``"data"``, the input that a plain module would get (f_com reads
    ``"sender"`` and ``"receiver"`` instead), and any of

    - ``("own", name)``: the agent's own data at time t (in f_com and f_pre, the receiver's), for example
      ``("own", "observation")`` or another entry beside the observation;
    - ``"input"``: the agent's own input to this layer at time t, observation and outputs of earlier layers;
    - in f_com and f_pre, ``("edge", "weight")`` and ``("edge", "feature")``.

    Submodules can be replaced after construction like any attribute: ``layer.f_final = module``,
    ``layer.f_pre[1] = module`` for one hop, ``layer.f_pre = module`` for all hops. One module in several places shares
    its weights between them.

    An agent whose observation contains NaN or infinity sends nothing, and its output at that step is NaN, so that
    these values reach neither other agents nor the gradients.

    Args:
        hops: number of hops K >= 0.
        f_input: encodes the observation.
        f_com: what an agent computes from one incoming message, see `modgnn_rl.nn.communication`; one module for all
            hops, or a list of K. Default: the Laplacian, incoming minus own.
        f_pre: applied to each incoming datum before the sum over neighbours; one module for all hops, or a list of
            K + 1 (``None`` in it is the identity).
        f_mid: applied to each hop's sum; one module or a list of K + 1.
        f_final: applied to the sum over hops.
        start: what stands in for data that an agent does not hold yet. ``mask``: the hop contributes nothing; ``zero``:
            the data are zero; ``repeat``: the first observation and graph are repeated backwards in time.
        aggregation: ``sum``, ``mean`` or ``max`` over the neighbours, where the equations above have a sum; zero for an
            agent without neighbours.

    Raises:
        InputError: ``hops`` is negative or not an integer, a list has the wrong length, or ``start`` or ``aggregation``
            is unknown.
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
        """f_input, f_com of each hop, f_pre and f_mid of each hop, f_final."""
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
    def intermediate_names(self) -> list[tuple[str, ...]]:
        """Names of the intermediate results that a `Recorder` may request, with their hops."""
        hops = {"messages": range(self.hops), "f_com": range(1, self.hops + 1)}
        names = ("messages", "f_com", "f_pre", "sum", "f_mid")
        numbered = [(name, str(hop)) for name in names for hop in hops.get(name, range(self.hops + 1))]
        return [("f_input",), *numbered, ("f_final",)]

    @property
    def sends_plain_data(self) -> bool:
        """Whether messages are sums of observations: stored ones never become stale, and they rotate as vectors do."""
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
            adjacency: the graphs of all steps, in any form that `Topology` reads, or a Topology, which then also knows
                the receivers.
            is_init: steps at which an episode begins, bool [*B, T]; default: none.
            messages: the messages of the step before the window [*B, N, K, D]; NaN for a hop that an agent does not
                hold. Default: nobody holds anything.
            own: further data of the agents for keyed submodules [*B, T, N, ...].
            receivers: the agents and steps whose output is wanted, bool [*B, T, N]; for the others, only messages are
                computed, and the output is zero. Default: all.
            record: collects intermediate results.

        Returns:
            x [*B, T, N, O], and the messages sent at each step [*B, T, N, K, D].

        Raises:
            InputError: the graphs do not match the observations, or lack what a submodule reads.
        """
        window = self._make_window(observation, adjacency, own, receivers, record)
        # Submodules may work in place, so they get a copy of what is read again.
        data = call_where(window.topology.exists, window, self.f_input, window.inputs.clone(), window.own)
        window.record("f_input", None, data)
        held, start = window.valid, STARTS[self.start](data, window.valid)
        pass_on = functools.partial(self._pass_on, window)
        total = self._hop_zero(data, window)
        sent: list[Tensor] = []
        for hop in range(1, self.hops + 1):
            sent.append(mask_rows(data, held, torch.nan).to(observation.dtype))
            window.record("messages", hop - 1, sent[-1])
            stored = None if messages is None else messages[..., hop - 1, : data.shape[-1]]
            shifted = previous_step(data.unflatten(0, window.shape), held.unflatten(0, window.shape), stored, is_init)
            before, held = start.fill(*shifted)
            total = total + self._hop_output(hop, before, held, window)
            if hop < self.hops:
                data = pass_on(hop, before, held)
                start.advance(hop, pass_on)
                held = held if window.topology.exists is None else held & window.topology.exists
        output = self._output(total, window)
        all_sent = stack_padded(sent) if sent else data.new_zeros(len(data), 0, data.shape[-1])
        return output.unflatten(0, window.shape), all_sent.unflatten(0, window.shape)

    def _make_window(
        self,
        observation: Tensor,
        adjacency: Tensor | Topology,
        own: NodeFeatures | None,
        receivers: Tensor | None,
        record: Recorder | None,
    ) -> Window:
        """Flatten the data of a window to nodes, and check them against the graphs."""
        shape = observation.shape[:-1]
        topology = adjacency
        if isinstance(topology, Tensor):
            topology = Topology(topology, shape[-1], receivers=receivers, form=resolve_form("auto", self))
        if topology.num_nodes != shape.numel():
            raise InputError(
                f"there are {topology.num_graphs} graphs for observations {list(shape)} (batch, steps, agents); each "
                "step of each flock needs one"
            )
        for (name,) in self._keys_under("edge"):
            if getattr(topology, name, None) is None:
                raise InputError(f"a submodule reads ('edge', '{name}'), but the edges have no {name}; see edge_{name}")
        nodes = {("own", *key): value.flatten(0, len(shape) - 1) for key, value in (own or {}).items()}
        inputs = observation.reshape(shape.numel(), observation.shape[-1])
        inputs, nodes, valid = mask_invalid(inputs, nodes, topology.exists)
        nodes["input",] = inputs
        target_own = {key: select(value, topology.target_index) for key, value in nodes.items()}
        return Window(shape, topology, valid, nodes, target_own, record)

    def _hop_zero(self, data: Tensor, window: Window) -> Tensor:
        """``f_mid^(0)(f_pre^(0)(c_i))`` of the targets."""
        processed = call_submodule(self.f_pre[0], window.of_targets(data).clone(), window.target_own)
        window.record("f_pre", 0, processed)
        return self._contribution(0, processed, None, window)

    def _hop_output(self, hop: int, before: Tensor, held: Tensor, window: Window) -> Tensor:
        """``f_mid^(k)(sum_j f_pre^(k)(y_ij))`` of the targets, from what all nodes held one step earlier."""
        target_held = window.of_targets(held)
        graph = window.topology.target_edges().subgraph(held, target_held)
        inputs = NodeInputs(before, window.of_targets(before), window.target_own)
        record = window.edge_recorder(hop, graph)
        summed = aggregate(graph, self.f_com[hop - 1], self.f_pre[hop], inputs, self.aggregation, record)
        return self._contribution(hop, summed, target_held, window)

    def _contribution(self, hop: int, summed: Tensor, held: Tensor | None, window: Window) -> Tensor:
        """F_mid of one hop's sum; zero for targets that do not hold this hop."""
        window.record("sum", hop, summed)
        result = call_where(held, window, self.f_mid[hop], summed, window.target_own)
        window.record("f_mid", hop, result)
        return result

    def _pass_on(self, window: Window, hop: int, before: Tensor, held: Tensor) -> Tensor:
        """``m_i^(k) = sum_j y_ij``, what every node will send next, from what all nodes held one step earlier."""
        graph = window.topology.all_edges().subgraph(held, held)
        inputs = NodeInputs(before, before, window.own)
        return aggregate(graph, self.f_com[hop - 1], nn.Identity(), inputs, self.aggregation)

    def _output(self, total: Tensor, window: Window) -> Tensor:
        """F_final of the sum over hops: NaN for invalid targets, zero for nodes that are not targets."""
        topology = window.topology
        output = call_submodule(self.f_final, total, window.target_own)
        output = mask_rows(output, window.of_targets(window.valid), torch.nan)
        if topology.target_index is not None:
            zeros = output.new_zeros(topology.num_nodes, output.shape[-1])
            output = zeros.index_copy(0, topology.target_index, output)
        elif topology.targets is not None:
            output = mask_rows(output, topology.targets)
        window.record("f_final", None, output)
        return output


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
