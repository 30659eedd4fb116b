"""A policy as one robot runs it: from its own observation, its own memory, and the messages that it receives.

`step` is the computation, a pure function of tensors that can be exported; `Agent` keeps its state between steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import pad

from modgnn_rl.errors import InputError
from modgnn_rl.nn.aggregation import NodeFeatures, NodeInputs, aggregate, call_submodule
from modgnn_rl.nn.graph import DenseGraph
from modgnn_rl.nn.keys import as_tuple
from modgnn_rl.nn.layer import ModGNNLayer
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.nn.window import mask_invalid
from modgnn_rl.utils.tensors import mask_rows

__all__ = ["Agent", "EdgeData", "check_local", "edge_data", "no_messages", "own_data", "step"]


class EdgeData(NamedTuple):
    """What an agent knows about each incoming edge beside the message.

    Attributes:
        weight: whether edges have a weight.
        feature: number of features per edge F.
    """

    weight: bool = False
    feature: int = 0

    def example(self, count: int, like: Tensor) -> dict[str, Tensor]:
        """Such data for some edges as `step` takes them, all ones, with the dtype and device of ``like``."""
        data = {"weight": like.new_ones(count)} if self.weight else {}
        return data | ({"feature": like.new_ones(count, self.feature)} if self.feature else {})


class Agent:
    """One robot that runs a `ModGNN` policy from its own observation and received messages alone.

    At every control step::

        message = agent.observe(observation)  # broadcast this
        agent.receive(messages)  # the neighbours' broadcasts that arrived
        action = agent.act()

    Together the agents compute the same actions as the policy for all of them. A lost message is a missing edge. An
    agent that reboots or joins calls `reset` and holds nothing, which its messages express as NaN.

    Args:
        policy: layers of `ModGNNLayer`, in evaluation mode; agents may share it.
        edges: edge data that the agent receives; default: inferred from the policy's keys. Required if weights come
            from a floating-point adjacency, or if edges have features.

    Raises:
        InputError: the policy needs more than one agent knows, see `check_local`.
    """

    def __init__(self, policy: ModGNN, edges: EdgeData | None = None) -> None:
        check_local(policy)
        self.policy = policy
        self.edges = edge_data(policy) if edges is None else edges
        self._features: int | None = None
        self.reset()

    def reset(self) -> None:
        """Forget everything: a reboot, or the start of an episode."""
        self._messages: Tensor | None = None
        self._observed: tuple[Tensor, NodeFeatures] | None = None
        self._received: dict[str, Tensor] | None = None

    @torch.no_grad()
    def observe(self, observation: Tensor, own: Mapping[NestedKey, Tensor] | None = None) -> Tensor:
        """Start a step.

        Args:
            observation: o [F].
            own: further data of the agent for keyed submodules, by their name under ``"own"`` [...].

        Returns:
            the message to broadcast now [K, D], from data up to the previous step.

        Raises:
            InputError: called out of order, or the policy cannot read the data.
        """
        if self._observed is not None:
            raise InputError(
                "observe was called twice in a step; call observe, receive, act in turn; reset starts over"
            )
        if observation.ndim != 1 or self._features not in (None, len(observation)):
            wanted = "[F]" if self._features is None else [self._features]
            raise InputError(f"the observation of one agent is {wanted}, not {list(observation.shape)}")
        data = own_data(self.policy, observation, own or {})
        if self._messages is None:
            self._messages = no_messages(self.policy, observation, data, self.edges)
        self._features = len(observation)
        self._observed = observation.clone(), {name: value.clone() for name, value in data.items()}
        return self._messages.clone()

    def receive(
        self,
        messages: Tensor | Sequence[Tensor],
        *,
        weight: Tensor | Sequence[float] | None = None,
        feature: Tensor | Sequence[Tensor] | None = None,
    ) -> None:
        """Receive the messages that arrived in this step, in any order.

        Args:
            messages: what the neighbours returned from `observe`, [M, K, D] or a sequence of [K, D]; M may be zero.
            weight: weights of their edges [M].
            feature: features of their edges [M, F].

        Raises:
            InputError: called out of order, or data have the wrong shape.
        """
        if self._observed is None or self._messages is None:
            raise InputError("receive was called before observe; the order is observe, receive, act")
        if self._received is not None:
            raise InputError("receive was called twice in a step; pass all messages at once")
        inbox = _rows("messages", messages, self._messages.shape, self._messages)
        received = {"inbox": inbox}
        for name, given, width in (("weight", weight, ()), ("feature", feature, (self.edges.feature,))):
            has_it = bool(getattr(self.edges, name))
            rows = [] if given is None and has_it and len(inbox) == 0 else given
            if (rows is not None) != has_it:
                need = "needs" if has_it else "was built without"
                raise InputError(f"this agent {need} an edge {name}; its EdgeData is {tuple(self.edges)}")
            if rows is not None:
                received[name] = _rows(f"the edge {name}", rows, width, self._messages, len(inbox))
        self._received = received

    @torch.no_grad()
    def act(self) -> Tensor:
        """End the step: return the action [O], and store the message to broadcast in the next step.

        Raises:
            InputError: called out of order.
        """
        if self._observed is None or self._messages is None or self._received is None:
            missing = "observe" if self._observed is None else "receive (pass [] if nothing arrived)"
            raise InputError(f"act was called before {missing}; the order is observe, receive, act")
        observation, own = self._observed
        action, self._messages = step(self.policy, observation, self._messages, **self._received, own=own)
        self._observed = self._received = None
        return action


def step(
    policy: ModGNN,
    observation: Tensor,
    messages: Tensor,
    inbox: Tensor,
    own: Mapping[tuple[str, ...], Tensor] | None = None,
    weight: Tensor | None = None,
    feature: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """One step of one agent.

    Args:
        policy: see `check_local`.
        observation: o [F].
        messages: what the agent returned one step earlier [K, D]; NaN for what it does not hold.
        inbox: what each neighbour returned one step earlier [M, K, D]; M may be zero.
        own: the agent's data for keyed submodules, see `own_data` [...].
        weight: edge weights [M].
        feature: edge features [M, F].

    Returns:
        action [O], and messages [K, D] for itself and its neighbours in the next step.
    """
    # The agent itself is the first sender, without an edge, so that maxima over senders are never empty.
    stored = torch.cat((messages.unsqueeze(0), inbox))
    is_neighbour = torch.arange(stored.shape[0], device=stored.device) > 0
    weight = None if weight is None else pad(weight, (1, 0))
    feature = None if feature is None else pad(feature, (0, 0, 1, 0))
    graph = DenseGraph(is_neighbour.view(1, 1, -1), weight, feature)
    holds = stored.isfinite().all(-1)
    stored = torch.where(holds.unsqueeze(-1), stored, 0.0)

    tables = {("own", *name): value.unsqueeze(0) for name, value in (own or {}).items()}
    seen, sent, first = observation.unsqueeze(0), [], 0
    for layer in policy.layers:
        hops = slice(first, first + layer.hops)
        output, sends = _layer_step(layer, seen, tables, stored[:, hops], holds[:, hops], graph)
        seen = torch.cat((seen, output), -1)
        first += layer.hops
        sent.append(sends)
    return output[0], torch.cat(_of_one_width(sent))


def _layer_step(
    layer: ModGNNLayer, observation: Tensor, own: NodeFeatures, stored: Tensor, holds: Tensor, graph: DenseGraph
) -> tuple[Tensor, Tensor]:
    """One layer as `ModGNNLayer` defines it, for a graph with one receiver.

    Args:
        layer: the layer.
        observation: input of the layer [1, F].
        own: the agent's own data [1, ...].
        stored: what the senders (the agent is the first) held one step earlier [S, K, D].
        holds: which hops they held, bool [S, K].
        graph: edges from these senders to the agent.

    Returns:
        output [1, O], and messages [K, D'] of this step.
    """
    seen, tables, sees = mask_invalid(observation, own)
    tables[("input",)] = seen
    # Submodules may work in place, so they get a copy of what is read again.
    data, held = call_submodule(layer.f_input, seen.clone(), tables), sees
    total = call_submodule(layer.f_mid[0], call_submodule(layer.f_pre[0], data.clone(), tables), tables)
    sent = []
    for hop in range(1, layer.hops + 1):
        sent.append(mask_rows(data, held, torch.nan).to(seen.dtype)[0])
        senders, they_hold = _of_width(stored[:, hop - 1], data.shape[-1]), holds[:, hop - 1]
        if layer.start == "zero":
            they_hold = torch.ones_like(they_hold)
        held = they_hold[:1]
        edges, incoming = graph.subgraph(they_hold, held), NodeInputs(senders, senders[:1], tables)
        f_com = layer.f_com[hop - 1]
        if hop < layer.hops:  # before f_pre, which may change the messages in place
            data = aggregate(edges, f_com, nn.Identity(), incoming, layer.aggregation)
        summed = aggregate(edges, f_com, layer.f_pre[hop], incoming, layer.aggregation)
        total = total + mask_rows(call_submodule(layer.f_mid[hop], summed, tables), held)
    output = mask_rows(call_submodule(layer.f_final, total, tables), sees, torch.nan)
    return output, torch.stack(_of_one_width(sent)) if sent else data.new_zeros(0, data.shape[-1])


def check_local(policy: ModGNN) -> None:
    """Check that one agent's observation and messages are all that a policy needs.

    Raises:
        InputError: a layer is not a `ModGNNLayer` (a central model), or has ``start="repeat"``.
    """
    for number, layer in enumerate(policy.layers):
        if not isinstance(layer, ModGNNLayer):
            raise InputError(
                f"layer {number} of this policy is a {type(layer).__name__}, which reads all agents at once; only "
                "layers of ModGNNLayer can be run agent by agent"
            )
        if layer.start == "repeat":
            raise InputError(
                f"layer {number} of this policy has start='repeat', for which an agent would have to know what its "
                "neighbours first saw; only start='mask' and 'zero' can be run agent by agent"
            )


def edge_data(policy: ModGNN) -> EdgeData:
    """The edge data that a policy reads, according to its keys.

    Raises:
        InputError: it reads edge features, whose number is unknown.
    """
    if policy.edge_keys["feature"] is not None:
        raise InputError("this policy reads edge features: give their number, as in edges=EdgeData(feature=2)")
    return EdgeData(weight=policy.edge_keys["weight"] is not None)


def own_data(policy: ModGNN, observation: Tensor, given: Mapping[NestedKey, Tensor]) -> dict[tuple[str, ...], Tensor]:
    """The data that the keyed submodules of a policy read under ``"own"``, by name; the observation may be among them.

    Raises:
        InputError: data are missing, or are not read by any submodule.
    """
    keys = policy.own_keys()
    found = {as_tuple(name): value for name, value in given.items()}
    if keys.get(("observation",)) == policy.in_keys[0]:
        found.setdefault(("observation",), observation)
    if found.keys() != keys.keys():
        wanted, there = (sorted(".".join(name) for name in names) for names in (keys, found))
        raise InputError(f"the submodules of this policy read {wanted} of the agent's own data, but got {there}")
    return found


def no_messages(policy: ModGNN, observation: Tensor, own: NodeFeatures, edges: EdgeData) -> Tensor:
    """The messages of an agent that holds nothing, NaN [K, D]; a step without neighbours determines their width.

    Raises:
        InputError: the policy cannot read the observation.
    """
    unknown = observation.new_full((policy.hops, 1), torch.nan)
    nobody = observation.new_zeros(0, policy.hops, 1)
    try:
        _, messages = step(policy, observation, unknown, nobody, own, **edges.example(0, observation))
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"the policy cannot read an observation of {len(observation)} numbers: {reason}") from error
    return torch.full_like(messages, torch.nan)


def _of_width(data: Tensor, width: int) -> Tensor:
    """Pad data [..., D] with zeros, or cut them, to a width; adds no operation to an export if the width fits."""
    return data if data.shape[-1] == width else pad(data, (0, width - data.shape[-1]))


def _of_one_width(rows: Sequence[Tensor]) -> list[Tensor]:
    width = max(row.shape[-1] for row in rows)
    return [_of_width(row, width) for row in rows]


def _rows(
    name: str, values: Tensor | Sequence[Any], row: Sequence[int], like: Tensor, count: int | None = None
) -> Tensor:
    """A copy of rows [M, *row], given as one tensor or a sequence, with the dtype and device of ``like``."""
    if not isinstance(values, Tensor):
        parts = [torch.as_tensor(value, dtype=like.dtype, device=like.device) for value in values]
        wrong = next((part for part in parts if part.shape != torch.Size(row)), None)
        if wrong is not None:
            raise InputError(f"{name} are {list(row)} each; one is {list(wrong.shape)}")
        values = torch.stack(parts) if parts else like.new_zeros(0, *row)
    if values.shape[1:] != torch.Size(row) or count not in (None, len(values)):
        wanted = ", ".join(map(str, ("M" if count is None else count, *row)))
        raise InputError(f"{name} are [{wanted}], not {list(values.shape)}")
    return values.to(like, copy=True)
