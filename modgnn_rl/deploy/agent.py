"""A policy as one robot runs it: with its own observation, its own memory, and the messages that reach it.

`step` is the computation, a pure function of tensors that can be exported; `Agent` remembers what it returns.
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
    """What is known of each link beside the message that comes over it.

    Attributes:
        weight: whether links have a weight.
        feature: number of features of a link F.
    """

    weight: bool = False
    feature: int = 0

    def example(self, count: int, like: Tensor) -> dict[str, Tensor]:
        """Such data of some links as `step` takes them, ones, of the dtype and on the device of ``like``."""
        data = {"weight": like.new_ones(count)} if self.weight else {}
        return data | ({"feature": like.new_ones(count, self.feature)} if self.feature else {})


class Agent:
    """One robot that flies by a `ModGNN` policy and needs nothing but what it sees and hears.

    At every control step::

        message = agent.observe(observation)  # broadcast this
        agent.receive(messages)  # what the neighbours broadcast, as far as it arrived
        action = agent.act()

    Together the agents do what the policy does for all of them. A message that is lost is a link that is missing; an
    agent that reboots or joins begins with `reset` and holds nothing, which its messages say with NaN.

    Args:
        policy: layers of `ModGNNLayer`, in evaluation mode; agents may share it.
        links: what is known of links; default: what the keys of the policy say. Needed where weights come from a
            floating-point adjacency, and where links have features.

    Raises:
        InputError: the policy needs more than one agent knows, see `check_local`.
    """

    def __init__(self, policy: ModGNN, links: EdgeData | None = None) -> None:
        check_local(policy)
        self.policy = policy
        self.links = edge_data(policy) if links is None else links
        self._features: int | None = None
        self.reset()

    def reset(self) -> None:
        """Forget everything: a reboot, or the start of an episode."""
        self._messages: Tensor | None = None
        self._seen: tuple[Tensor, NodeFeatures] | None = None
        self._heard: dict[str, Tensor] | None = None

    @torch.no_grad()
    def observe(self, observation: Tensor, own: Mapping[NestedKey, Tensor] | None = None) -> Tensor:
        """Begin a step.

        Args:
            observation: o [F].
            own: further data of the agent for keyed submodules, by their name under ``"own"`` [...].

        Returns:
            the message to broadcast now [K, D]: what the agent gathered up to the step before.

        Raises:
            InputError: out of turn, or for data that the policy cannot read.
        """
        if self._seen is not None:
            raise InputError("observe came twice in a step; the order is observe, receive, act; reset starts over")
        if observation.ndim != 1 or self._features not in (None, len(observation)):
            wanted = "[F]" if self._features is None else [self._features]
            raise InputError(f"the observation of one agent is {wanted}, not {list(observation.shape)}")
        data = own_data(self.policy, observation, own or {})
        if self._messages is None:
            self._messages = no_messages(self.policy, observation, data, self.links)
        self._features = len(observation)
        self._seen = observation.clone(), {name: value.clone() for name, value in data.items()}
        return self._messages.clone()

    def receive(
        self,
        messages: Tensor | Sequence[Tensor],
        *,
        weight: Tensor | Sequence[float] | None = None,
        feature: Tensor | Sequence[Tensor] | None = None,
    ) -> None:
        """Take the messages that arrived in this step, in any order.

        Args:
            messages: what the neighbours returned from `observe`, [M, K, D] or a sequence of [K, D]; M may be zero.
            weight: weights of the links that they came over [M].
            feature: features of these links [M, F].

        Raises:
            InputError: out of turn, or for data of another shape.
        """
        if self._seen is None or self._messages is None:
            raise InputError("receive came before observe; the order is observe, receive, act")
        if self._heard is not None:
            raise InputError("receive came twice in a step; give it all messages at once")
        inbox = _rows("messages", messages, self._messages.shape, self._messages)
        heard = {"inbox": inbox}
        for name, given, width in (("weight", weight, ()), ("feature", feature, (self.links.feature,))):
            has_it = bool(getattr(self.links, name))
            rows = [] if given is None and has_it and len(inbox) == 0 else given
            if (rows is not None) != has_it:
                need = "needs" if has_it else "was built without"
                raise InputError(f"this agent {need} the {name} of links; its EdgeData is {tuple(self.links)}")
            if rows is not None:
                heard[name] = _rows(f"the {name} of links", rows, width, self._messages, len(inbox))
        self._heard = heard

    @torch.no_grad()
    def act(self) -> Tensor:
        """End the step: return the action [O], and remember what to broadcast in the next step.

        Raises:
            InputError: out of turn.
        """
        if self._seen is None or self._messages is None or self._heard is None:
            missing = "observe" if self._seen is None else "receive, which takes [] where nothing was heard"
            raise InputError(f"act came before {missing}; the order is observe, receive, act")
        observation, own = self._seen
        action, self._messages = step(self.policy, observation, self._messages, **self._heard, own=own)
        self._seen = self._heard = None
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
        weight: weights of the links [M].
        feature: features of the links [M, F].

    Returns:
        action [O], and messages [K, D] for itself and its neighbours in the next step.
    """
    # The agent itself stands first, as a sender that nobody hears: so there is always somebody to take a maximum over.
    stored = torch.cat((messages.unsqueeze(0), inbox))
    hears = torch.arange(stored.shape[0], device=stored.device) > 0
    weight = None if weight is None else pad(weight, (1, 0))
    feature = None if feature is None else pad(feature, (0, 0, 1, 0))
    links = DenseGraph(hears.view(1, 1, -1), weight, feature)
    holds = stored.isfinite().all(-1)
    stored = torch.where(holds.unsqueeze(-1), stored, 0.0)

    tables = {("own", *name): value.unsqueeze(0) for name, value in (own or {}).items()}
    seen, sent, first = observation.unsqueeze(0), [], 0
    for layer in policy.layers:
        hops = slice(first, first + layer.hops)
        output, sends = _layer_step(layer, seen, tables, stored[:, hops], holds[:, hops], links)
        seen = torch.cat((seen, output), -1)
        first += layer.hops
        sent.append(sends)
    return output[0], torch.cat(_of_one_width(sent))


def _layer_step(
    layer: ModGNNLayer, observation: Tensor, own: NodeFeatures, stored: Tensor, holds: Tensor, links: DenseGraph
) -> tuple[Tensor, Tensor]:
    """One layer, as `ModGNNLayer` defines it, for the one receiver of a graph.

    Args:
        layer: the layer.
        observation: what the layer sees [1, F].
        own: the agent's own data [1, ...].
        stored: what the senders, of which the agent is the first, held one step earlier [S, K, D].
        holds: which of it they held, bool [S, K].
        links: the graph.

    Returns:
        output [1, O], and messages [K, D'] of this step.
    """
    seen, tables, sees = mask_invalid(observation, own)
    tables[("input",)] = seen
    # Modules may work in place; what they are given here is read again.
    data, held = call_submodule(layer.f_input, seen.clone(), tables), sees
    total = call_submodule(layer.f_mid[0], call_submodule(layer.f_pre[0], data.clone(), tables), tables)
    sent = []
    for hop in range(1, layer.hops + 1):
        sent.append(mask_rows(data, held, torch.nan).to(seen.dtype)[0])
        senders, they_hold = _of_width(stored[:, hop - 1], data.shape[-1]), holds[:, hop - 1]
        if layer.start == "zero":
            they_hold = torch.ones_like(they_hold)
        held = they_hold[:1]
        graph, incoming = links.subgraph(they_hold, held), NodeInputs(senders, senders[:1], tables)
        f_com = layer.f_com[hop - 1]
        if hop < layer.hops:  # before f_pre works on the messages, maybe in place
            data = aggregate(graph, f_com, nn.Identity(), incoming, layer.aggregation)
        summed = aggregate(graph, f_com, layer.f_pre[hop], incoming, layer.aggregation)
        total = total + mask_rows(call_submodule(layer.f_mid[hop], summed, tables), held)
    output = mask_rows(call_submodule(layer.f_final, total, tables), sees, torch.nan)
    return output, torch.stack(_of_one_width(sent)) if sent else data.new_zeros(0, data.shape[-1])


def check_local(policy: ModGNN) -> None:
    """Make sure that one agent's observation and messages are all that a policy needs.

    Raises:
        InputError: for a layer that is no `ModGNNLayer` (a central model), or ``start="repeat"``.
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
    """What a policy reads of links, as far as its keys say.

    Raises:
        InputError: it reads features; their number is not known.
    """
    if policy.edge_keys["feature"] is not None:
        raise InputError("this policy reads features of links: say how many, as in links=EdgeData(feature=2)")
    return EdgeData(weight=policy.edge_keys["weight"] is not None)


def own_data(policy: ModGNN, observation: Tensor, given: Mapping[NestedKey, Tensor]) -> dict[tuple[str, ...], Tensor]:
    """The data that the keyed submodules of a policy read under ``"own"``, by name; the observation may be among them.

    Raises:
        InputError: data are missing, or nobody reads them.
    """
    keys = policy.own_keys()
    found = {as_tuple(name): value for name, value in given.items()}
    if keys.get(("observation",)) == policy.in_keys[0]:
        found.setdefault(("observation",), observation)
    if found.keys() != keys.keys():
        wanted, there = (sorted(".".join(name) for name in names) for names in (keys, found))
        raise InputError(f"the submodules of this policy read {wanted} of the agent's own data, and got {there}")
    return found


def no_messages(policy: ModGNN, observation: Tensor, own: NodeFeatures, links: EdgeData) -> Tensor:
    """The messages of an agent that holds nothing, NaN [K, D]; their width is found by a step without neighbours.

    Raises:
        InputError: the policy cannot read the observation.
    """
    unknown = observation.new_full((policy.hops, 1), torch.nan)
    nobody = observation.new_zeros(0, policy.hops, 1)
    try:
        _, messages = step(policy, observation, unknown, nobody, own, **links.example(0, observation))
    except RuntimeError as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"the policy cannot read an observation of {len(observation)} numbers: {reason}") from error
    return torch.full_like(messages, torch.nan)


def _of_width(data: Tensor, width: int) -> Tensor:
    """Data [..., D] filled up with zeros, or cut, to a width; nothing that a file would have to do where it fits."""
    return data if data.shape[-1] == width else pad(data, (0, width - data.shape[-1]))


def _of_one_width(rows: Sequence[Tensor]) -> list[Tensor]:
    width = max(row.shape[-1] for row in rows)
    return [_of_width(row, width) for row in rows]


def _rows(
    name: str, values: Tensor | Sequence[Any], row: Sequence[int], like: Tensor, count: int | None = None
) -> Tensor:
    """A copy of rows [M, *row], given as one tensor or one by one, in the dtype and on the device of ``like``."""
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
