"""ModGNN (Kortvelesy and Prorok 2021): delayed K-hop messages with a module between every pair of aggregations.

`ModGNNLayer` is the layer as a function of tensors; `ModGNN` stacks layers into a TensorDictModule with the messages
as recurrent state.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Self, cast

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.nn.functional import pad
from torchrl.modules import recurrent_mode

from modgnn_rl.errors import InputError, suggestion
from modgnn_rl.nn.aggregation import resolve_form
from modgnn_rl.nn.keys import as_tuple, check_leading, dotted, read_entry
from modgnn_rl.nn.layer import ModGNNLayer
from modgnn_rl.nn.primer import RecurrentStatePrimer
from modgnn_rl.nn.recorder import RequestRecorder
from modgnn_rl.nn.topology import FORMS, Topology
from modgnn_rl.utils.tensors import is_transformed, mask_rows

__all__ = ["ModGNN", "ModGNNLayer"]


class ModGNN(TensorDictModuleBase):
    """Layers of ModGNN as a TorchRL policy: reads observations and a graph, writes actions, stores messages.

    The f_input of layer l reads the observation and the outputs of all earlier layers, concatenated. Each layer has its
    own messages. They are stored one layer after another along the hops of one tensor ``messages`` [*B, N, K, D], where
    K is the sum over layers and D the largest width; hops that an agent does not hold are NaN.

    The module runs one environment step, or under ``torchrl.modules.set_recurrent_mode(True)`` a window [*B, T]. If a
    window has no ``is_init``, an episode begins at its first step; where ``is_init`` is false at the first step, the
    ``messages`` stored there are used. The environment's specs must contain the recurrent state: TorchRL's collectors
    add it (``auto_register_policy_transforms=True``); elsewhere append ``InitTracker()`` and `make_tensordict_primer`.

    Submodules are addressed by name, ``"layers.0.f_pre.1"`` being f_pre of hop 1 of the first layer:
    ``policy.get_submodule(name)`` returns one, ``policy.set_submodule(name, module)`` replaces one, and `request`
    outputs what it computes.

    Args:
        layers: one layer or several: `ModGNNLayer`, or another module with its attributes and its forward.
        observation: key of the observations [*B, N, F].
        adjacency: key of the graph, in any form that `modgnn_rl.nn.topology.Topology` reads: dense [*B, N, N], with
            edge weights if it is floating-point, or an edge list, int64 [*B, 2, E].
        is_init: key of the flag that an episode begins [*B, 1].
        messages: root key of the recurrent state [*B, N, K, D].
        action: key that the output is written to [*B, N, O].
        mask: key of the agents that exist, bool [*B, N], read if present. Nobody receives from the others, whatever
            their data are; their actions are zero, and an agent that returns holds nothing at first.
        edge_weight: key of the edge weights, [*B, N, N], or [*B, E] of an edge list.
        edge_feature: key of the edge features, [*B, N, N, F], or [*B, E, F] of an edge list.
        own: keys of what keyed submodules read as ``("own", name)``, by name; default: beside the observation.
        form: form of the graphs, see `modgnn_rl.nn.topology.Topology`: ``edges`` (computes existing edges only),
            ``dense`` (computes all pairs: shapes do not depend on data, and batch statistics include all pairs), or
            ``auto``.

    Raises:
        InputError: ``form`` is unknown.
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
        if isinstance(observation, list) or isinstance(action, list):
            raise InputError(
                f"observation={observation} and action={action} must be one key each: a policy acts for one group of "
                "agents; put all agents into one group, or build one policy for each"
            )
        if form not in FORMS:
            raise InputError(f"form={form!r} is not one of {', '.join(FORMS)}")
        modules = nn.ModuleList(layers if isinstance(layers, Sequence) else [layers])
        self.layers = cast(Sequence[ModGNNLayer], modules)
        self.form = form
        self.messages_key = messages
        self._keys: list[NestedKey] = [observation, adjacency, is_init, messages, mask]
        self.edge_keys = {"weight": edge_weight, "feature": edge_feature}
        self._given_own_keys = {as_tuple(name): key for name, key in (own or {}).items()}
        self._requests: dict[tuple[str, ...], NestedKey] = {}
        self.out_keys: list[NestedKey] = [action, ("next", messages)]
        self._warned = False

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that are read; ``is_init``, ``messages`` and the mask may be missing."""
        keys = [*self._keys, *(key for key in self.edge_keys.values() if key is not None)]
        return [*keys, *(key for key in self.own_keys().values() if key not in keys)]

    @property
    def hops(self) -> int:
        """Messages that an agent sends in one step: the sum of K over the layers."""
        return sum(layer.hops for layer in self.layers)

    @property
    def window(self) -> int:
        """Length of the shortest window whose last action does not depend on stored messages: sum of K, plus 1."""
        return self.hops + 1

    @property
    def sends_plain_data(self) -> bool:
        """Whether messages depend on no parameter, so that stored ones stay exact while the policy learns."""
        *earlier, last = self.layers
        fixed = all(layer.sends_plain_data and not any(True for _ in layer.parameters()) for layer in earlier)
        return fixed and last.sends_plain_data

    @property
    def num_parameters(self) -> int:
        """Number of trainable weights."""
        return sum(parameter.numel() for parameter in self.parameters() if parameter.requires_grad)

    @property
    def intermediate_keys(self) -> list[tuple[str, ...]]:
        """All keys that `request` accepts.

        With layer l and hop k, under ``("layers", l)``:

        - ``"f_input"``: c [*B, N, D]; ``("messages", k)``: m^(k), k < K [*B, N, D];
        - ``("f_com", k)``: y^(k), k >= 1; ``("f_pre", k)``: f_pre of it, for k = 0 of the agent's own data [*B, N, F];
        - ``("sum", k)``: the sum of f_pre over the neighbours; ``("f_mid", k)``: f_mid of it [*B, N, F];
        - ``"f_final"``: the layer's output x [*B, N, O].

        Edge values are [*B, N, N, F], zero where there is no edge, or [*B, E, F] of an edge list. What is not computed
        is zero: agents that do not exist, and, except for ``f_input`` and ``messages``, agents whose action is not
        wanted. Messages that are not held are NaN.
        """
        names = [(str(number), *name) for number, layer in enumerate(self.layers) for name in layer.intermediate_names]
        return [("layers", *name) for name in names]

    def request(self, *keys: NestedKey, rename: Mapping[NestedKey, NestedKey] | None = None) -> Self:
        """Request intermediate results, which are then written beside the action; nothing is computed twice.

        Args:
            keys: some of `intermediate_keys`, as tuples or with dots, ``"layers.0.f_com.1"``; they replace earlier
                requests. No keys: request nothing.
            rename: other keys to write some of these to, ``{"layers.0.f_final": ("agents", "embedding")}``.

        Returns:
            the policy itself.

        Raises:
            InputError: a key is unknown, or renamed without being requested.
        """
        known = {".".join(key): key for key in self.intermediate_keys}
        wanted = {dotted(key): key for key in keys}
        targets = {dotted(key): target for key, target in (rename or {}).items()}
        for name in wanted:
            if name not in known:
                raise InputError(f"'{name}' is not an intermediate result of this policy{suggestion(name, known)}")
        for name in targets:
            if name not in wanted:
                raise InputError(f"'{name}' is renamed but not requested{suggestion(name, wanted)}")
        self._requests = {known[name]: targets.get(name, known[name]) for name in wanted}
        self.out_keys = [*self.out_keys[:2], *self._requests.values()]
        return self

    def forward(self, tensordict: TensorDictBase, receivers: Tensor | None = None) -> TensorDictBase:
        """Write actions and messages.

        Args:
            tensordict: one step [*B], or a window [*B, T] in recurrent mode.
            receivers: the agents and steps whose action is wanted, bool [*B, N] or [*B, T, N]; the others get zeros.
                In a window, later layers then compute only the messages that these actions depend on; the others are
                NaN. Default: all.

        Returns:
            the same tensordict.

        Raises:
            InputError: an entry is missing, or its shape does not match the observations.
        """
        if not is_tensor_collection(tensordict):
            raise InputError(
                f"the policy reads a TensorDict with '{dotted(self._keys[0])}' and '{dotted(self._keys[1])}', and was "
                f"given a {type(tensordict).__name__}: pass TensorDict({{...}}, batch_size)"
            )
        data = self._read(tensordict, receivers)
        if recurrent_mode():
            needed = None if receivers is None else self._needed_outputs(receivers)
            window = data
        else:
            if self._lacks_memory(data.is_init, data.messages):
                self._warn_of_missing_memory()
            needed, window = None, data.as_window()
        recorder = RequestRecorder(data.observation.shape[:-1], self._requests) if self._requests else None
        output, sent = self._run_layers(window, needed, recorder)
        agents = data.observation.shape[:-1]
        tensordict.set(self.out_keys[0], output.reshape(*agents, output.shape[-1]))
        tensordict.set(self.out_keys[1], sent.reshape(*agents, *sent.shape[-2:]))
        if recorder is not None:
            for key, target in self._requests.items():
                tensordict.set(target, recorder.results[key])
        return tensordict

    def _read(self, tensordict: TensorDictBase, receivers: Tensor | None) -> _Inputs:
        """Read and check the entries; in recurrent mode, the messages stored at the first step of the window."""
        observation, adjacency = (read_entry(tensordict, key) for key in self._keys[:2])
        is_init, messages, mask = (tensordict.get(key, None) for key in self._keys[2:])
        own = {name: read_entry(tensordict, key, name) for name, key in self.own_keys().items()}
        edges = {name: None if key is None else read_entry(tensordict, key) for name, key in self.edge_keys.items()}
        agents = observation.shape[:-1]
        flocks = agents[:-1]
        check_leading(flocks, {"the adjacency": adjacency} | {f"the edge {name}": edges[name] for name in edges})
        check_leading(agents, {f"'{dotted(name)}' (read under 'own')": value for name, value in own.items()})
        check_leading(agents, {"the mask": mask, "receivers": receivers}, torch.bool)
        check_leading((*flocks, 1), {"the flag that an episode begins": is_init}, torch.bool)
        check_leading((*agents, self.hops), {"the stored messages": messages})
        form = resolve_form(self.form, self)
        topology = Topology(adjacency, agents[-1], receivers=receivers, mask=mask, **edges, form=form)
        if recurrent_mode():
            messages = None if messages is None or is_init is None else messages.select(observation.ndim - 3, 0)
        return _Inputs(observation, topology, is_init, messages, own)

    def _run_layers(
        self, data: _Inputs, needed: Sequence[Tensor] | None, recorder: RequestRecorder | None
    ) -> tuple[Tensor, Tensor]:
        """Run all layers over a window.

        Args:
            data: the window.
            needed: whose output later layers depend on, for each layer but the last, bool [*B, T, N]; None: everyone's.
            recorder: collects intermediate results.

        Returns:
            output of the last layer [*B, T, N, O], messages of all layers [*B, T, N, K, D].
        """
        is_init = None if data.is_init is None else data.is_init.squeeze(-1)
        inputs, sent, first_hop = data.observation, [], 0
        for number, layer in enumerate(self.layers):
            hops = slice(first_hop, first_hop + layer.hops)
            stored = None if data.messages is None else data.messages[..., hops, :]
            is_last = number == len(self.layers) - 1
            targets = None if needed is None or is_last else needed[number]
            topology = data.topology if is_last else data.topology.with_targets(targets)
            if recorder is not None:
                recorder.begin_layer(number, topology)
            output, messages = layer(inputs, topology, is_init, stored, data.own, record=recorder)
            if targets is not None:
                # An output that is not computed is NaN, so that nobody sends it.
                output = mask_rows(output.flatten(0, -2), targets.flatten(), torch.nan).view_as(output)
            inputs = torch.cat((inputs, output), -1)
            first_hop += layer.hops
            sent.append(messages)
        # A layer that sends nothing does not widen the messages of the others.
        width = max([part.shape[-1] for part in sent if part.shape[-2]] or [sent[0].shape[-1]])
        return output, torch.cat([pad(part, (0, width - part.shape[-1])) for part in sent], -2)

    def _needed_outputs(self, receivers: Tensor) -> list[Tensor]:
        """For each layer but the last, the agents and steps whose output the wanted actions depend on, bool [*B, T, N].

        A layer reads the current outputs of its receivers, and those of the whole flock in the K steps before.
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
        """The transform that adds ``messages`` to an environment's specs, with the shapes that it needs there."""
        return RecurrentStatePrimer(self, [self.messages_key], is_init=self._keys[2])

    def own_keys(self) -> dict[tuple[str, ...], NestedKey]:
        """Keys of the data that keyed submodules read under ``"own"``, by name."""
        key = unravel_key(self._keys[0])
        group = key[:-1] if isinstance(key, tuple) else ()
        given = {("observation",): key, **self._given_own_keys}
        names = sorted({name for layer in self.layers for name in layer.own_keys})
        return {name: given.get(name, unravel_key((*group, *name))) for name in names}

    def _lacks_memory(self, is_init: Tensor | None, messages: Tensor | None) -> bool:
        """Whether a single step lacks the messages of the step before; the first step of an episode needs none."""
        if is_init is None or messages is not None or self._warned or is_transformed():
            return is_init is None
        return not is_init.all()

    def _warn_of_missing_memory(self) -> None:
        if self.hops and not self._warned:
            self._warned = True
            warnings.warn(
                f"'{self._keys[2]}', or '{self._keys[3]}' in mid-episode, is missing, so ModGNN remembers no messages: "
                "append InitTracker() and policy.make_tensordict_primer() to the environment",
                stacklevel=3,
            )


class _Inputs(NamedTuple):
    """What a policy reads: one step [*B], or a window [*B, T].

    Attributes:
        observation: [*B, N, F].
        topology: the graphs.
        is_init: whether an episode begins [*B, 1].
        messages: the messages of the step before [*B, N, K, D].
        own: further data for keyed submodules, by name [*B, N, ...].
    """

    observation: Tensor
    topology: Topology
    is_init: Tensor | None
    messages: Tensor | None
    own: Mapping[tuple[str, ...], Tensor]

    def as_window(self) -> _Inputs:
        """A step as a window of one step."""
        time = self.observation.ndim - 2
        return self._replace(
            observation=self.observation.unsqueeze(time),
            is_init=None if self.is_init is None else self.is_init.unsqueeze(time),
            own={name: value.unsqueeze(time) for name, value in self.own.items()},
        )
