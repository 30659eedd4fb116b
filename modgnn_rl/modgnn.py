"""ModGNN (Kortvelesy and Prorok 2021): delayed K-hop messages with a module between every pair of aggregations.

`ModGNNLayer` is the layer as a function of tensors; `ModGNN` stacks layers into a TensorDictModule with the messages
as recurrent state.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Self, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.nn.functional import pad
from torchrl.modules import recurrent_mode

from modgnn_rl.cache import AgentCache
from modgnn_rl.errors import InputError
from modgnn_rl.graph import FORMS, Graph, Topology
from modgnn_rl.layer import ModGNNLayer
from modgnn_rl.settings import suggestion

__all__ = ["ModGNN", "ModGNNLayer"]


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

    Submodules go by their names, ``"layers.0.f_pre.1"`` being f_pre of hop 1 of the first layer:
    ``policy.get_submodule(name)`` fetches one, ``policy.set_submodule(name, module)`` puts another in its place, and
    `request` asks for what it computes.

    Args:
        layers: one layer or several.
        observation: key of the observations [*B, N, F].
        adjacency: key of the graph, in any form that `modgnn_rl.graph.Topology` takes: dense [*B, N, N], with weights
            if it is floating-point, or an edge list, int64 [*B, 2, E].
        is_init: key of the flag that an episode begins [*B, 1].
        messages: root key of the recurrent state [*B, N, K, D].
        action: key that the output is written to [*B, N, O].
        mask: key of the agents that exist, bool [*B, N], read where there is one. Nobody hears of the others, whatever
            their data are; their actions are zero, and one that comes (back) starts with nothing.
        link_weight: key of the links' weights, [*B, N, N] or of an edge list [*B, E].
        link_feature: key of the links' features, [*B, N, N, F] or [*B, E, F].
        own: where ``("own", name)`` of a keyed submodule is found, by name; default: beside the observation.
        form: ``links`` (a list: costs what is linked), ``pairs`` (all pairs: shapes do not depend on data), ``auto``.
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
        mask: NestedKey = ("agents", "mask"),
        link_weight: NestedKey | None = None,
        link_feature: NestedKey | None = None,
        own: Mapping[NestedKey, NestedKey] | None = None,
        form: str = "auto",
    ) -> None:
        super().__init__()
        if form not in FORMS:
            raise InputError(f"form={form!r} is not one of {', '.join(FORMS)}")
        modules = nn.ModuleList([layers] if isinstance(layers, ModGNNLayer) else layers)
        self.layers = cast(Sequence[ModGNNLayer], modules)
        self.form = form
        self.messages_key = messages
        self._keys: list[NestedKey] = [observation, adjacency, is_init, messages, mask]
        self._link_keys = {"weight": link_weight, "feature": link_feature}
        self._found = {_as_tuple(name): key for name, key in (own or {}).items()}
        self._requests: dict[tuple[str, ...], NestedKey] = {}
        self.out_keys: list[NestedKey] = [action, ("next", messages)]
        self._warned = False

    @property
    def in_keys(self) -> list[NestedKey]:
        """What is read; ``is_init``, ``messages`` and the mask may be missing."""
        keys = [*self._keys, *(key for key in self._link_keys.values() if key is not None)]
        return [*keys, *(key for key in self._own_keys().values() if key not in keys)]

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

    @property
    def num_parameters(self) -> int:
        """Number of trainable weights."""
        return sum(parameter.numel() for parameter in self.parameters() if parameter.requires_grad)

    @property
    def intermediate_keys(self) -> list[tuple[str, ...]]:
        """All that `request` can ask for.

        With l the number of the layer and k of the hop, under ``("layers", l)``:

        - ``"f_input"``: c [*B, N, D]; ``("messages", k)``: m^(k), k < K [*B, N, D];
        - ``("f_com", k)``: y^(k), k >= 1; ``("f_pre", k)``: f_pre of it, for k = 0 of the agent's own data [*B, N, F];
        - ``("sum", k)``: the sum of f_pre over the neighbours; ``("f_mid", k)``: f_mid of it [*B, N, F];
        - ``"f_final"``: the layer's output x [*B, N, O].

        Values of links are [*B, N, N, F], zero where there is no link, or [*B, E, F] of an edge list.
        """
        keys: list[tuple[str, ...]] = []
        for number, layer in enumerate(self.layers):
            hops = {"f_com": range(1, layer.hops + 1), "messages": range(layer.hops)}
            for name in ("f_input", "messages", "f_com", "f_pre", "sum", "f_mid", "f_final"):
                path = ("layers", str(number), name)
                numbered = hops.get(name, range(layer.hops + 1))
                keys += [path] if name in ("f_input", "f_final") else [(*path, str(hop)) for hop in numbered]
        return keys

    def request(self, *keys: NestedKey, rename: Mapping[str, NestedKey] | None = None) -> Self:
        """Ask for intermediate results, which are then written beside the action; nothing is computed twice for it.

        Args:
            keys: some of `intermediate_keys`, as tuples or with dots, ``"layers.0.f_com.1"``; they replace those asked
                for before. Without any, nothing is asked for any more.
            rename: other keys to write to, ``{"layers.0.f_final": ("agents", "embedding")}``.

        Returns:
            the policy itself.

        Raises:
            InputError: for a key that there is not.
        """
        known = {".".join(key): key for key in self.intermediate_keys}
        wanted: dict[tuple[str, ...], NestedKey] = {}
        for key in keys:
            name = key if isinstance(key, str) else ".".join(key)
            if name not in known:
                raise InputError(f"'{name}' is no intermediate result of this policy{suggestion(name, known)}")
            wanted[known[name]] = (rename or {}).get(name, known[name])
        self._requests = wanted
        self.out_keys = [*self.out_keys[:2], *wanted.values()]
        return self

    def forward(self, tensordict: TensorDictBase, receivers: Tensor | None = None) -> TensorDictBase:
        """Write the actions and the messages to remember.

        Args:
            tensordict: one step [*B], or a window [*B, T] in recurrent mode.
            receivers: the agents and steps whose action is wanted, bool [*B, N] or [*B, T, N]; the others get zeros.
                Default: all.

        Raises:
            InputError: on data whose shapes do not fit the observations'.
        """
        found = [tensordict.get(key, None) for key in self._keys]
        observation, adjacency, is_init, messages, mask = found
        agents = observation.shape[:-1]
        own = {name: tensordict.get(key) for name, key in self._own_keys().items()}
        of_links = {name: None if key is None else tensordict.get(key) for name, key in self._link_keys.items()}
        self._check(observation, own, mask, receivers)
        topology = Topology(
            adjacency,
            agents[-1],
            receivers=receivers,
            mask=mask,
            **of_links,
            form=self.form,
            keep_positions=bool(self._requests),
        )
        if recurrent_mode():
            messages = None if messages is None or is_init is None else messages.select(observation.ndim - 3, 0)
        else:
            if is_init is None:
                self._warn_of_no_memory()
            time = observation.ndim - 2
            observation = observation.unsqueeze(time)
            own = {name: value.unsqueeze(time) for name, value in own.items()}
            is_init = None if is_init is None else is_init.unsqueeze(time)
        record = _Requested(topology, agents) if self._requests else None
        output, sent = self._run(observation, topology, is_init, messages, own, record)
        tensordict.set(self.out_keys[0], output.reshape(*agents, -1))
        tensordict.set(self.out_keys[1], sent.reshape(*agents, *sent.shape[-2:]))
        if record is not None:
            for key, target in self._requests.items():
                tensordict.set(target, record.results[key])
        return tensordict

    def _run(
        self,
        observation: Tensor,
        topology: Topology,
        is_init: Tensor | None,
        messages: Tensor | None,
        own: Mapping[tuple[str, ...], Tensor],
        record: _Requested | None,
    ) -> tuple[Tensor, Tensor]:
        """All layers over a window, see `ModGNNLayer.forward`."""
        is_init = None if is_init is None else is_init.squeeze(-1)
        seen, sent, first = observation, [], 0
        for number, layer in enumerate(self.layers):
            stored = None if messages is None else messages[..., first : first + layer.hops, :]
            # Later layers hear of everybody's outputs.
            graphs = topology if number == len(self.layers) - 1 else topology.of_everyone()
            if record is not None:
                record.begin_layer(number, self._requests)
            output, sends = layer(seen, graphs, is_init, stored, own, record=record)
            seen = torch.cat((seen, output), -1)
            first += layer.hops
            sent.append(sends)
        width = max(sends.shape[-1] for sends in sent)
        return output, torch.cat([pad(sends, (0, width - sends.shape[-1])) for sends in sent], -2)

    def make_tensordict_primer(self) -> AgentCache:
        """The transform that puts ``messages`` into an environment's specs, sized by that environment."""
        return AgentCache(self, [self.messages_key])

    def _own_keys(self) -> dict[tuple[str, ...], NestedKey]:
        """Where the data lie that keyed submodules read under ``"own"``, by name."""
        key = unravel_key(self._keys[0])
        group = key[:-1] if isinstance(key, tuple) else ()
        found = {**self._found, ("observation",): self._found.get(("observation",), key)}
        names = sorted({name for layer in self.layers for name in layer.own_keys})
        return {name: found.get(name, unravel_key((*group, *name))) for name in names}

    def _check(
        self,
        observation: Tensor,
        own: Mapping[tuple[str, ...], Tensor | None],
        mask: Tensor | None,
        receivers: Tensor | None,
    ) -> None:
        agents = tuple(observation.shape[:-1])
        named = {f"'{'.'.join(name)}' (read under 'own')": value for name, value in own.items()}
        for name, value in named.items():
            if value is None:
                raise InputError(f"{name} is missing from the data; a submodule needs it with shape [{agents}, ...]")
        for name, value in {**named, "the mask": mask, "receivers": receivers}.items():
            if value is not None and tuple(value.shape[: len(agents)]) != agents:
                raise InputError(f"{name} has shape {tuple(value.shape)}; for these observations it begins {agents}")

    def _warn_of_no_memory(self) -> None:
        if self.hops and not self._warned:
            self._warned = True
            warnings.warn(
                f"ModGNN finds no '{self._keys[2]}' and cannot tell where episodes begin: append InitTracker() and "
                "policy.make_tensordict_primer() to the environment",
                stacklevel=3,
            )


class _Requested:
    """Collects the intermediate results that were asked for, in the shape of the data."""

    def __init__(self, topology: Topology, agents: torch.Size) -> None:
        self.topology, self.agents = topology, agents
        self.results: dict[tuple[str, ...], Tensor] = {}
        self.layer = ""
        self.asked: set[tuple[str, ...]] = set()
        self.rows: Tensor | None = None

    def begin_layer(self, number: int, asked: Mapping[tuple[str, ...], NestedKey]) -> None:
        """What comes now is of this layer."""
        self.layer, self.asked = str(number), set(asked)

    def wants(self, name: str, hop: int | None = None) -> bool:
        """Whether the result of this name is asked for."""
        return self._key(name, hop) in self.asked

    def nodes(self, name: str, hop: int | None, value: Tensor) -> None:
        """Take a result of all agents [R, F]."""
        rows = self.topology.rows
        if rows is not None and len(value) != self.topology.num_nodes:
            value = value.new_zeros(self.topology.num_nodes, value.shape[-1]).index_copy(0, rows, value)
        self.results[self._key(name, hop)] = value.reshape(*self.agents, -1)

    def links(self, name: str, hop: int, value: Tensor, graph: Graph) -> None:
        """Take a result of all links [E, F]."""
        spread = self.topology.spread_links(value, graph)
        self.results[self._key(name, hop)] = spread.reshape(*self.agents[:-1], *spread.shape[1:])

    def _key(self, name: str, hop: int | None) -> tuple[str, ...]:
        path = ("layers", self.layer, name)
        return path if hop is None else (*path, str(hop))


def _as_tuple(key: NestedKey) -> tuple[str, ...]:
    key = unravel_key(key)
    return key if isinstance(key, tuple) else (key,)
