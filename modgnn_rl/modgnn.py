"""ModGNN (Kortvelesy and Prorok 2021): delayed K-hop messages with a module between every pair of aggregations.

`ModGNNLayer` is the layer as a function of tensors; `ModGNN` stacks layers into a TensorDictModule with the messages
as recurrent state.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.nn.functional import pad
from torchrl.modules import recurrent_mode

from modgnn_rl.cache import AgentCache, missing
from modgnn_rl.communication import Adjacency, Laplacian, links, sum_over_links
from modgnn_rl.errors import InputError

__all__ = ["ModGNN", "ModGNNLayer"]

Submodule = nn.Module | None
Own = Mapping[tuple[str, ...], Tensor]
STARTS = ("mask", "zero", "repeat")


class ModGNNLayer(nn.Module):
    r"""One layer of ModGNN over delayed messages.

    With c_i(t) = f_input(o_i(t)) and m_i^(0)(t) = c_i(t), at every agent i with neighbours N_i(t)::

        y_ij^(k)(t) = f_com(m_j^(k-1)(t-1), m_i^(k-1)(t-1)),                    j in N_i(t), k = 1..K
        m_i^(k)(t)  = sum_j y_ij^(k)(t),                                        k = 1..K-1
        x_i(t)      = f_final( f_mid^(0)(f_pre^(0)(c_i(t))) + sum_k f_mid^(k)( sum_j f_pre^(k)(y_ij^(k)(t)) ) )

    A submodule that is left out is the identity. Each but f_com may be a TensorDictModule with keys of its own: it
    reads ``"data"`` (what a plain module would get) and anything under ``"own"``, the agent's own data at time t:
    ``("own", "observation")``, or another name that lies beside the observation; its first out-key is the result. In
    f_pre, ``own`` is the receiving agent.

    Args:
        hops: number of hops K >= 0.
        f_input: encodes the observation.
        f_com: ``f_com(sender, receiver)`` [E, D], applied to each link; default: the Laplacian, incoming minus own.
        f_pre: applied to each incoming datum before the sum over neighbours; one module for all hops, or a list of
            K + 1 (``None`` in it is the identity).
        f_mid: applied to each hop's sum; one module or a list of K + 1.
        f_final: applied to the sum over hops.
        start: what stands for data that an agent does not hold yet. ``mask``: the hop contributes nothing; ``zero``:
            the data are zero; ``repeat``: the first observation and graph are repeated backwards.

    Raises:
        InputError: on a negative or fractional ``hops``, a list of the wrong length, an unknown ``start``, or an f_com
            with keys of its own.
    """

    def __init__(
        self,
        hops: int,
        f_input: Submodule = None,
        f_com: Submodule = None,
        f_pre: Submodule | Sequence[Submodule] = None,
        f_mid: Submodule | Sequence[Submodule] = None,
        f_final: Submodule = None,
        *,
        start: str = "mask",
    ) -> None:
        super().__init__()
        if not isinstance(hops, int) or hops < 0:
            raise InputError(f"hops={hops!r} is not a number of hops; expected an integer of at least 0")
        if start not in STARTS:
            raise InputError(f"start={start!r} is not one of {', '.join(STARTS)}")
        if isinstance(f_com, TensorDictModuleBase):
            raise InputError("f_com takes two tensors, f_com(sender, receiver), and cannot have keys of its own")
        self.hops = hops
        self.start = start
        self.f_input = _or_identity(f_input)
        self.f_com = Laplacian() if f_com is None else f_com
        self.f_pre = _per_hop("f_pre", f_pre, hops)
        self.f_mid = _per_hop("f_mid", f_mid, hops)
        self.f_final = _or_identity(f_final)

    @property
    def own_keys(self) -> list[tuple[str, ...]]:
        """What the keyed submodules read of the agent's own data, without the leading ``"own"``."""
        keyed = [module for module in self.modules() if isinstance(module, TensorDictModuleBase)]
        keys = {unravel_key(key) for module in keyed for key in module.in_keys}
        return sorted({key[1:] for key in keys if isinstance(key, tuple) and key[0] == "own"})

    @property
    def sends_plain_data(self) -> bool:
        """Whether messages are sums of observations, so that stored ones never grow stale and turn as vectors do."""
        return isinstance(self.f_input, nn.Identity) and isinstance(self.f_com, (Laplacian, Adjacency))

    def forward(
        self,
        observation: Tensor,
        adjacency: Tensor,
        is_init: Tensor | None = None,
        messages: Tensor | None = None,
        own: Own | None = None,
        receivers: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Run a window of T steps; one environment step is a window with T = 1.

        Args:
            observation: o [*B, T, N, F].
            adjacency: entry i, j, unless zero, says that i receives from j [*B, T, N, N].
            is_init: steps at which an episode begins, bool [*B, T]; default: none does.
            messages: the messages of the step before the window [*B, N, K, D]; a hop that an agent does not hold is
                NaN. Default: nobody holds anything.
            own: further data of the agents for keyed submodules [*B, T, N, ...].
            receivers: the agents and steps whose output is wanted, bool [*B, T, N]; the others cost nothing but their
                messages and get zeros. Default: all.

        Returns:
            x [*B, T, N, O], and the messages sent at each step [*B, T, N, K, D].
        """
        *batch, _, _ = observation.shape
        adjacency = adjacency.bool()
        nodes = observation.shape[:-1].numel()
        own = {key: value.reshape(nodes, *value.shape[len(batch) + 1 :]) for key, value in (own or {}).items()}
        data = _call(self.f_input, observation.reshape(nodes, -1), own)
        rows = slice(None) if receivers is None else receivers.reshape(-1).nonzero().squeeze(-1)
        mine = {key: value[rows] for key, value in own.items()}
        total = _call(self.f_mid[0], _call(self.f_pre[0], data[rows], mine), mine)

        wanted = links(adjacency if receivers is None else adjacency & receivers.unsqueeze(-1))
        graph = wanted if receivers is None or self.hops < 2 else links(adjacency)
        first = data  # of start="repeat"
        sent = []
        for hop in range(1, self.hops + 1):
            sent.append(data)
            stored = None if messages is None else messages[..., hop - 1, : data.shape[-1]]
            before = _one_step_earlier(data.unflatten(0, observation.shape[:-1]), stored, is_init).flatten(0, -2)
            held = ~before.isnan().any(-1, keepdim=True)
            before = torch.where(held, before, first if self.start == "repeat" else 0.0)
            if self.start != "mask":
                held = torch.ones_like(held)
            heard = held.squeeze(-1)
            summed = sum_over_links(self._processed(hop, before, own), wanted.between(heard), nodes)
            total = total + torch.where(held[rows], _call(self.f_mid[hop], summed[rows], mine), 0.0)
            if hop < self.hops:
                sums = sum_over_links(self._incoming(before), graph.between(heard), nodes)
                if sums.shape != data.shape:
                    raise InputError(
                        f"f_com turns {data.shape[-1]} features into {sums.shape[-1]}; with several hops it must keep "
                        "their number"
                    )
                data = torch.where(held, sums, torch.nan)
                if self.start == "repeat":
                    first = sum_over_links(self._incoming(first), graph, nodes)

        output = _call(self.f_final, total, mine)
        if receivers is not None:
            everyone = output.new_zeros(nodes, output.shape[-1])
            everyone[rows] = output
            output = everyone
        stacked = torch.stack(sent, -2) if sent else data.new_zeros(nodes, 0, data.shape[-1])
        return output.unflatten(0, observation.shape[:-1]), stacked.unflatten(0, observation.shape[:-1])

    def _incoming(self, before: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
        """Y of the links, given what every node held one step earlier [R, D]."""
        return lambda sender, receiver: self.f_com(before.index_select(0, sender), before.index_select(0, receiver))

    def _processed(self, hop: int, before: Tensor, own: Own) -> Callable[[Tensor, Tensor], Tensor]:
        """f_pre(y) of the links."""
        incoming, f_pre = self._incoming(before), self.f_pre[hop]

        def processed(sender: Tensor, receiver: Tensor) -> Tensor:
            mine = {key: value.index_select(0, receiver) for key, value in own.items()}
            return _call(f_pre, incoming(sender, receiver), mine)

        return processed


class ModGNN(TensorDictModuleBase):
    """Layers of ModGNN as a policy with keys: reads observations and a graph, writes actions, remembers messages.

    Layer l's f_input sees the observation and the outputs of all earlier layers, concatenated. Each layer keeps its own
    messages: they lie one behind the other along the hops of one tensor ``messages`` [*B, N, K, D], K being the sum
    over layers and D the widest; hops that an agent does not hold are NaN.

    The module runs one environment step, or under ``torchrl.modules.set_recurrent_mode(True)`` a window [*B, T]. In a
    window, a missing ``is_init`` says that it begins an episode; where ``is_init`` is false at its first step, the
    ``messages`` stored there are used. An environment needs the recurrent state in its specs: the collectors of TorchRL
    see to it by themselves (``auto_register_policy_transforms=True``), elsewhere append ``InitTracker()`` and
    `make_tensordict_primer`.

    Args:
        layers: one layer or several.
        observation: key of the observations [*B, N, F].
        adjacency: key of the graph [*B, N, N].
        is_init: key of the flag that an episode begins [*B, 1].
        messages: root key of the recurrent state [*B, N, K, D].
        action: key that the output is written to [*B, N, O].
    """

    def __init__(
        self,
        layers: ModGNNLayer | Sequence[ModGNNLayer],
        *,
        observation: NestedKey = ("agents", "observation"),
        adjacency: NestedKey = "adjacency",
        is_init: NestedKey = "is_init",
        messages: str = "messages",
        action: NestedKey = ("agents", "action"),
    ) -> None:
        super().__init__()
        modules = nn.ModuleList([layers] if isinstance(layers, ModGNNLayer) else layers)
        self.layers = cast(Sequence[ModGNNLayer], modules)
        key = unravel_key(observation)
        group = key[:-1] if isinstance(key, tuple) else ()
        own = sorted({name for layer in self.layers for name in layer.own_keys})
        self._own_keys = {name: key if name == ("observation",) else unravel_key((*group, *name)) for name in own}
        self.messages_key = messages
        self.in_keys: list[NestedKey] = [observation, adjacency, is_init, messages]
        self.in_keys += [name for name in self._own_keys.values() if name not in self.in_keys]
        self.out_keys: list[NestedKey] = [action, ("next", messages)]
        self._warned = False

    @property
    def hops(self) -> int:
        """Messages an agent sends in one step: the sum of K over the layers."""
        return sum(layer.hops for layer in self.layers)

    @property
    def window(self) -> int:
        """Steps of the shortest window whose last action is exact whatever the stored messages: sum of K, plus 1."""
        return self.hops + 1

    @property
    def sends_plain_data(self) -> bool:
        """Whether messages are sums of observations, so that stored ones stay exact while the policy learns."""
        return len(self.layers) == 1 and self.layers[0].sends_plain_data

    def forward(self, tensordict: TensorDictBase, receivers: Tensor | None = None) -> TensorDictBase:
        """Write the actions and the messages to remember.

        Args:
            tensordict: one step [*B], or a window [*B, T] in recurrent mode.
            receivers: the agents and steps whose action is wanted, bool [*B, N] or [*B, T, N]; the others get zeros.
                Default: all.
        """
        observation, adjacency, is_init, messages = (tensordict.get(key) for key in self.in_keys[:4])
        own = {name: tensordict[key] for name, key in self._own_keys.items()}
        if recurrent_mode():
            messages = None if messages is None or is_init is None else messages.select(observation.ndim - 3, 0)
            output, sent = self._run(observation, adjacency, is_init, messages, own, receivers)
        else:
            if is_init is None:
                self._warn_of_no_memory()
            time = observation.ndim - 2
            own = {name: value.unsqueeze(time) for name, value in own.items()}
            is_init = None if is_init is None else is_init.unsqueeze(time)
            receivers = None if receivers is None else receivers.unsqueeze(time)
            observation, adjacency = observation.unsqueeze(time), adjacency.unsqueeze(time)
            output, sent = self._run(observation, adjacency, is_init, messages, own, receivers)
            output, sent = output.squeeze(time), sent.squeeze(time)
        return tensordict.set(self.out_keys[0], output).set(self.out_keys[1], sent)

    def _run(
        self,
        observation: Tensor,
        adjacency: Tensor,
        is_init: Tensor | None,
        messages: Tensor | None,
        own: Own,
        receivers: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """All layers over a window, see `ModGNNLayer.forward`."""
        is_init = None if is_init is None else is_init.squeeze(-1)
        seen, sent, first = observation, [], 0
        for number, layer in enumerate(self.layers, start=1):
            stored = None if messages is None else messages[..., first : first + layer.hops, :]
            # Later layers hear of everybody's outputs.
            asked = receivers if number == len(self.layers) else None
            output, sends = layer(seen, adjacency, is_init, stored, own, asked)
            seen = torch.cat((seen, output), -1)
            first += layer.hops
            sent.append(sends)
        width = max(sends.shape[-1] for sends in sent)
        return output, torch.cat([pad(sends, (0, width - sends.shape[-1])) for sends in sent], -2)

    def make_tensordict_primer(self) -> AgentCache:
        """The transform that puts ``messages`` into an environment's specs, sized by that environment."""
        return AgentCache(self, [self.messages_key])

    def _warn_of_no_memory(self) -> None:
        if self.hops and not self._warned:
            self._warned = True
            warnings.warn(
                f"ModGNN finds no '{self.in_keys[2]}' and cannot tell where episodes begin: append InitTracker() and "
                "policy.make_tensordict_primer() to the environment",
                stacklevel=3,
            )


def _one_step_earlier(window: Tensor, stored: Tensor | None, is_init: Tensor | None) -> Tensor:
    """Shift [*B, T, N, D] by one step: what was stored comes first, and nothing (NaN) at the start of episodes."""
    initial = missing(window[..., 0, :, :]) if stored is None else stored
    before = torch.cat((initial.unsqueeze(-3), window[..., :-1, :, :]), -3)
    return before if is_init is None else torch.where(is_init[..., None, None], torch.nan, before)


def _call(module: nn.Module, data: Tensor, own: Own) -> Tensor:
    """Apply a plain or a keyed submodule to rows of data [R, D]."""
    if not isinstance(module, TensorDictModuleBase):
        return module(data)
    rows = TensorDict({"data": data, "own": TensorDict(dict(own), data.shape[:1])}, data.shape[:1])
    return module(rows)[module.out_keys[0]]


def _or_identity(module: Submodule) -> nn.Module:
    return nn.Identity() if module is None else module


def _per_hop(name: str, module: Submodule | Sequence[Submodule], hops: int) -> nn.ModuleList:
    """One module for each of the hops 0..K: the given ones, or the given one shared by all."""
    modules = [module] * (hops + 1) if module is None or isinstance(module, nn.Module) else list(module)
    if len(modules) != hops + 1:
        raise InputError(
            f"{name} has {len(modules)} modules; hops={hops} needs one module, or {hops + 1} (hops 0..{hops})"
        )
    return nn.ModuleList([_or_identity(item) for item in modules])
