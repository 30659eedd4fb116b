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

from modgnn_rl.errors import InputError, suggestion
from modgnn_rl.nn.aggregation import resolve_form
from modgnn_rl.nn.graph import Graph
from modgnn_rl.nn.layer import ModGNNLayer
from modgnn_rl.nn.primer import RecurrentStatePrimer
from modgnn_rl.nn.topology import FORMS, Topology
from modgnn_rl.utils.tensors import is_transformed, mask_rows

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
        layers: one layer or several: `ModGNNLayer`, or another module with its attributes and its forward.
        observation: key of the observations [*B, N, F].
        adjacency: key of the graph, in any form that `modgnn_rl.nn.topology.Topology` takes: dense [*B, N, N], with
            weights if it is floating-point, or an edge list, int64 [*B, 2, E].
        is_init: key of the flag that an episode begins [*B, 1].
        messages: root key of the recurrent state [*B, N, K, D].
        action: key that the output is written to [*B, N, O].
        mask: key of the agents that exist, bool [*B, N], read where there is one. Nobody hears of the others, whatever
            their data are; their actions are zero, and one that comes (back) starts with nothing.
        edge_weight: key of the links' weights, [*B, N, N] or of an edge list [*B, E].
        edge_feature: key of the links' features, [*B, N, N, F] or [*B, E, F].
        own: where ``("own", name)`` of a keyed submodule is found, by name; default: beside the observation.
        form: ``links`` (a list: costs what is linked), ``pairs`` (all pairs: shapes do not depend on data, and batch
            statistics see them all), ``auto``.
    """

    def __init__(
        self,
        layers: nn.Module | Sequence[nn.Module],
        *,
        observation: NestedKey = ("agents", "observation"),
        adjacency: NestedKey = "adjacency",
        is_init: NestedKey = "is_init",
        messages: str = "messages",
        action: NestedKey = ("agents", "action"),
        mask: NestedKey = ("agents", "mask"),
        edge_weight: NestedKey | None = None,
        edge_feature: NestedKey | None = None,
        own: Mapping[NestedKey, NestedKey] | None = None,
        form: str = "auto",
    ) -> None:
        super().__init__()
        if form not in FORMS:
            raise InputError(f"form={form!r} is not one of {', '.join(FORMS)}")
        modules = nn.ModuleList(layers if isinstance(layers, Sequence) else [layers])
        self.layers = cast(Sequence[ModGNNLayer], modules)
        self.form = form
        self.messages_key = messages
        self._keys: list[NestedKey] = [observation, adjacency, is_init, messages, mask]
        self._edge_keys = {"weight": edge_weight, "feature": edge_feature}
        self._found = {_as_tuple(name): key for name, key in (own or {}).items()}
        self._requests: dict[tuple[str, ...], NestedKey] = {}
        self.out_keys: list[NestedKey] = [action, ("next", messages)]
        self._warned = False

    @property
    def in_keys(self) -> list[NestedKey]:
        """What is read; ``is_init``, ``messages`` and the mask may be missing."""
        keys = [*self._keys, *(key for key in self._edge_keys.values() if key is not None)]
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
        """Whether messages hold no trace of a parameter, so that stored ones stay exact while the policy learns."""
        *earlier, last = self.layers
        fixed = all(layer.sends_plain_data and not any(True for _ in layer.parameters()) for layer in earlier)
        return fixed and last.sends_plain_data

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

        Values of links are [*B, N, N, F], zero where there is no link, or [*B, E, F] of an edge list. Agents and hops
        that are not computed get zeros: those that do not exist, and but for ``f_input`` and ``messages`` those whose
        action is not wanted; messages that are not held are NaN.
        """
        names = [(str(number), *name) for number, layer in enumerate(self.layers) for name in layer.intermediate_names]
        return [("layers", *name) for name in names]

    def request(self, *keys: NestedKey, rename: Mapping[NestedKey, NestedKey] | None = None) -> Self:
        """Ask for intermediate results, which are then written beside the action; nothing is computed twice for it.

        Args:
            keys: some of `intermediate_keys`, as tuples or with dots, ``"layers.0.f_com.1"``; they replace those asked
                for before. Without any, nothing is asked for any more.
            rename: other keys to write to, for some of these, ``{"layers.0.f_final": ("agents", "embedding")}``.

        Returns:
            the policy itself.

        Raises:
            InputError: for a key that there is not.
        """
        known = {".".join(key): key for key in self.intermediate_keys}
        wanted = {_dotted(key): key for key in keys}
        targets = {_dotted(key): target for key, target in (rename or {}).items()}
        for name in wanted:
            if name not in known:
                raise InputError(f"'{name}' is no intermediate result of this policy{suggestion(name, known)}")
        for name in targets:
            if name not in wanted:
                raise InputError(f"'{name}' is to be renamed but not asked for{suggestion(name, wanted)}")
        self._requests = {known[name]: targets.get(name, known[name]) for name in wanted}
        self.out_keys = [*self.out_keys[:2], *self._requests.values()]
        return self

    def forward(self, tensordict: TensorDictBase, receivers: Tensor | None = None) -> TensorDictBase:
        """Write the actions and the messages to remember.

        Args:
            tensordict: one step [*B], or a window [*B, T] in recurrent mode.
            receivers: the agents and steps whose action is wanted, bool [*B, N] or [*B, T, N]; the others get zeros.
                In a window, later layers then make only the messages that these actions depend on; the others are NaN.
                Default: all.

        Raises:
            InputError: on data that are missing, or whose shapes do not fit the observations'.
        """
        observation, adjacency = (_needed(tensordict, key) for key in self._keys[:2])
        is_init, messages, mask = (tensordict.get(key, None) for key in self._keys[2:])
        agents = observation.shape[:-1]
        own = {name: _needed(tensordict, key, name) for name, key in self._own_keys().items()}
        of_links = {name: None if key is None else _needed(tensordict, key) for name, key in self._edge_keys.items()}
        flocks, links = agents[:-1], {f"the {name} of links": value for name, value in of_links.items()}
        _check_begin(flocks, {"the adjacency": adjacency, **links})
        _check_begin(agents, {f"'{_dotted(name)}' (read under 'own')": value for name, value in own.items()})
        _check_begin(agents, {"the mask": mask, "receivers": receivers}, torch.bool)
        _check_begin((*flocks, 1), {"the flag that an episode begins": is_init}, torch.bool)
        _check_begin((*agents, self.hops), {"the stored messages": messages})
        topology = Topology(
            adjacency,
            agents[-1],
            receivers=receivers,
            mask=mask,
            **of_links,
            form=resolve_form(self.form, self),
        )
        if recurrent_mode():
            messages = None if messages is None or is_init is None else messages.select(observation.ndim - 3, 0)
        else:
            if self._is_forgetful(is_init, messages):
                self._warn_of_no_memory()
            time = observation.ndim - 2
            observation = observation.unsqueeze(time)
            own = {name: value.unsqueeze(time) for name, value in own.items()}
            is_init = None if is_init is None else is_init.unsqueeze(time)
        record = _Requested(agents) if self._requests else None
        needed = self._needed_outputs(receivers) if recurrent_mode() and receivers is not None else None
        output, sent = self._run(observation, topology, is_init, messages, own, record, needed)
        tensordict.set(self.out_keys[0], output.reshape(*agents, output.shape[-1]))
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
        needed: Sequence[Tensor] | None,
    ) -> tuple[Tensor, Tensor]:
        """All layers over a window, see `ModGNNLayer.forward`; ``needed`` are the receivers of each layer but the last.

        Without it, all agents' outputs of these layers are made, since later layers hear of them.
        """
        is_init = None if is_init is None else is_init.squeeze(-1)
        seen, sent, first = observation, [], 0
        for number, layer in enumerate(self.layers):
            stored = None if messages is None else messages[..., first : first + layer.hops, :]
            is_last = number == len(self.layers) - 1
            graphs = topology if is_last else topology.with_targets(None if needed is None else needed[number])
            if record is not None:
                record.begin_layer(number, graphs, self._requests)
            output, sends = layer(seen, graphs, is_init, stored, own, record=record)
            if needed is not None and not is_last:
                # What is not made is NaN: nobody sends it.
                output = mask_rows(output.flatten(0, -2), needed[number].flatten(), torch.nan).view_as(output)
            seen = torch.cat((seen, output), -1)
            first += layer.hops
            sent.append(sends)
        # A layer that sends nothing does not widen the messages of the others.
        width = max([sends.shape[-1] for sends in sent if sends.shape[-2]] or [sent[0].shape[-1]])
        return output, torch.cat([pad(sends, (0, width - sends.shape[-1])) for sends in sent], -2)

    def _needed_outputs(self, receivers: Tensor) -> list[Tensor]:
        """The agents and steps [*B, T, N] whose output of each layer but the last the wanted actions depend on.

        A layer reads the outputs of its receivers now, and of the whole flock in the K steps before.
        """
        needed: list[Tensor] = []
        for layer in reversed(self.layers[1:]):
            flock = receivers.any(-1, keepdim=True)
            for _ in range(layer.hops):
                flock = pad(flock[..., 1:, :], (0, 0, 0, 1))
                receivers = receivers | flock
            needed.insert(0, receivers)
        return needed

    def make_tensordict_primer(self) -> RecurrentStatePrimer:
        """The transform that puts ``messages`` into an environment's specs, sized by that environment."""
        return RecurrentStatePrimer(self, [self.messages_key], is_init=self._keys[2])

    def _own_keys(self) -> dict[tuple[str, ...], NestedKey]:
        """Where the data lie that keyed submodules read under ``"own"``, by name."""
        key = unravel_key(self._keys[0])
        group = key[:-1] if isinstance(key, tuple) else ()
        found = {**self._found, ("observation",): self._found.get(("observation",), key)}
        names = sorted({name for layer in self.layers for name in layer.own_keys})
        return {name: found.get(name, unravel_key((*group, *name))) for name in names}

    def _is_forgetful(self, is_init: Tensor | None, messages: Tensor | None) -> bool:
        """Whether a step comes without the memory of the one before; a first step needs none."""
        if is_init is None or messages is not None or self._warned or is_transformed():
            return is_init is None
        return not is_init.all()

    def _warn_of_no_memory(self) -> None:
        if self.hops and not self._warned:
            self._warned = True
            warnings.warn(
                f"ModGNN finds no '{self._keys[2]}', or no '{self._keys[3]}' in mid-rollout, and remembers nothing: "
                "append InitTracker() and policy.make_tensordict_primer() to the environment",
                stacklevel=3,
            )


class _Requested:
    """Collects the intermediate results that were asked for, in the shape of the data."""

    topology: Topology

    def __init__(self, agents: torch.Size) -> None:
        self.agents = agents
        self.results: dict[tuple[str, ...], Tensor] = {}
        self.layer = ""
        self.asked: set[tuple[str, ...]] = set()

    def begin_layer(self, number: int, topology: Topology, asked: Mapping[tuple[str, ...], NestedKey]) -> None:
        """What comes now is of this layer, and of the agents whose output it is to give."""
        self.layer, self.topology, self.asked = str(number), topology, set(asked)

    def wants(self, name: str, hop: int | None = None) -> bool:
        """Whether the result of this name is asked for."""
        return self._key(name, hop) in self.asked

    def record_nodes(self, name: str, hop: int | None, value: Tensor) -> None:
        """Take a result of all agents, or of the wanted ones [R, F]."""
        rows, wanted = self.topology.target_index, self.topology.targets
        if name in ("f_input", "messages") or wanted is None:
            pass  # all agents send
        elif rows is None or len(value) == self.topology.num_nodes:
            value = mask_rows(value, wanted)
        else:
            value = value.new_zeros(self.topology.num_nodes, value.shape[-1]).index_copy(0, rows, value)
        # A copy, since the next module may work in place.
        self.results[self._key(name, hop)] = value.reshape(*self.agents, value.shape[-1]).clone()

    def record_edges(self, name: str, hop: int, value: Tensor, graph: Graph) -> None:
        """Take a result of all links [E, F]."""
        spread = self.topology.to_input_layout(value, graph)
        self.results[self._key(name, hop)] = spread.reshape(*self.agents[:-1], *spread.shape[1:])

    def _key(self, name: str, hop: int | None) -> tuple[str, ...]:
        path = ("layers", self.layer, name)
        return path if hop is None else (*path, str(hop))


def _needed(tensordict: TensorDictBase, key: NestedKey, own: tuple[str, ...] | None = None) -> Tensor:
    """The entry of a key that must be there; ``own`` is the name that keyed submodules read it under."""
    value = tensordict.get(key, None)
    if value is None:
        reader = "the policy" if own is None else f"a submodule, under '{_dotted(('own', *own))}',"
        raise InputError(f"'{_dotted(key)}' is missing from the data; {reader} reads it: add it, or name another key")
    return value


def _check_begin(begin: Sequence[int], named: Mapping[str, Tensor | None], dtype: torch.dtype | None = None) -> None:
    begin = tuple(begin)
    for name, value in named.items():
        if value is not None and tuple(value.shape[: len(begin)]) != begin:
            raise InputError(f"{name} has shape {tuple(value.shape)}; for these observations it begins {begin}")
        if value is not None and dtype is not None and value.dtype != dtype:
            raise InputError(f"{name} is of {value.dtype}; it must be of {dtype}")


def _dotted(key: NestedKey) -> str:
    return key if isinstance(key, str) else ".".join(map(str, key))


def _as_tuple(key: NestedKey) -> tuple[str, ...]:
    key = unravel_key(key)
    return key if isinstance(key, tuple) else (key,)
