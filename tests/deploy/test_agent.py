"""Agents that run alone do together what the policy does for all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from modgnn_rl import Agent, ModGNN, ModGNNLayer, make_model
from modgnn_rl.deploy.agent import EdgeData, step
from modgnn_rl.errors import InputError
from modgnn_rl.nn.communication import (
    Adjacency,
    CoordinateFrame,
    GraphAttention,
    Laplacian,
    MessagePassing,
    NormalizedAdjacency,
)
from modgnn_rl.nn.graph import AGGREGATIONS
from modgnn_rl.registry import MODELS

AGENTS, FEATURES, WIDTH, LINK_FEATURES, STEPS = 4, 6, 4, 2, 6
LOCAL_STARTS = ("mask", "zero")


class Rollout:
    """Random observations, graphs and perturbations, for the policy of all agents and for agents alone."""

    def __init__(self, policy: ModGNN, seed: int, links: EdgeData | None = None, dtype: torch.dtype = torch.float64):
        self.policy = policy.to(dtype).eval()
        self.generator = torch.Generator().manual_seed(seed)
        self.links, self.dtype = links or EdgeData(), dtype
        self.agents = [Agent(self.policy, links) for _ in range(AGENTS)]
        self.own_names = {name for layer in policy.layers for name in layer.own_keys} - {("observation",)}
        self.existed = torch.zeros(AGENTS, dtype=torch.bool)
        self.messages: Tensor | None = None

    @torch.no_grad()
    def run(self, tolerance: float = 1e-12) -> None:
        """Roll out; every action and every message of every agent is the policy's."""
        for _ in range(STEPS):
            data = self.next_step()
            together = self.policy(data.clone())
            broadcast, actions = self.alone(data)
            for i, action in actions.items():
                close(action, together["agents", "action"][i], tolerance)
                held = torch.full_like(broadcast[i], torch.nan) if self.messages is None else data["messages"][i]
                close(only_held(broadcast[i]), only_held(held), tolerance)
            self.messages, self.existed = together["next", "messages"], data["agents", "mask"]

    def next_step(self) -> TensorDict:
        """What the policy reads: agents may be gone, blind or rebooted, messages may be lost."""
        exists = self._chance(0.8, AGENTS)
        observation = self._random(AGENTS, FEATURES)
        observation[self._chance(0.1, AGENTS) | ~exists] = torch.nan
        arrived = self._chance(0.6, AGENTS, AGENTS) & ~torch.eye(AGENTS, dtype=torch.bool)
        agents = {"observation": observation, "mask": exists, "sensors": {"battery": self._random(AGENTS, 1)}}
        data = TensorDict({"agents": agents, "adjacency": arrived, "is_init": torch.tensor([self.messages is None])})
        data["feature"] = self._random(AGENTS, AGENTS, LINK_FEATURES)
        data["rebooted"] = self._chance(0.15, AGENTS)
        if self.links.weight:
            data["adjacency"] = arrived * self._random(AGENTS, AGENTS).abs()
        if self.messages is not None:
            data["messages"] = torch.where(data["rebooted"].view(-1, 1, 1), torch.nan, self.messages)
        return data

    def alone(self, data: TensorDict) -> tuple[dict[int, Tensor], dict[int, Tensor]]:
        """One step of the agents that exist: what they broadcast and do. Messages travel along links, in any order."""
        for agent, begins in zip(self.agents, data["rebooted"] | ~self.existed, strict=True):
            if begins:
                agent.reset()
        there = data["agents", "mask"].nonzero().view(-1).tolist()
        broadcast, actions = {}, {}
        for i in there:
            own = {name: data["agents", *name][i] for name in self.own_names}
            broadcast[i] = self.agents[i].observe(data["agents", "observation"][i], own)
        for i in there:
            order = torch.randperm(AGENTS, generator=self.generator).tolist()
            heard = [j for j in order if j in there and data["adjacency"][i, j]]
            known: dict[str, Any] = {}
            if self.links.weight:
                known["weight"] = [float(data["adjacency"][i, j]) for j in heard]
            if self.links.feature:
                known["feature"] = data["feature"][i, heard]
            self.agents[i].receive([broadcast[j] for j in heard], **known)
            actions[i] = self.agents[i].act()
        return broadcast, actions

    def _random(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator, dtype=self.dtype)

    def _chance(self, share: float, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator) < share


def only_held(messages: Tensor) -> Tensor:
    """Messages [K, D] that are NaN as a whole where they are in part: a hop may be narrower than the widest."""
    return torch.where(messages.isnan().any(-1, keepdim=True), torch.nan, messages)


def close(ours: Tensor, theirs: Tensor, tolerance: float) -> None:
    torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance, equal_nan=True)


class _Pairwise(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * width, width)

    def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
        return self.linear(torch.cat((sender, receiver), -1)).tanh()


class _Both(nn.Module):
    """An f_com after which messages are wider."""

    def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
        return torch.cat((sender, 0.1 * receiver), -1)


class _Concatenated(nn.Module):
    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *parts: Tensor) -> Tensor:
        return self.network(torch.cat(parts, -1))


def dense(inputs: int, outputs: int) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, 5), nn.Tanh(), nn.Linear(5, outputs))


def keyed(inputs: int, outputs: int, *keys: Any) -> nn.Module:
    return TensorDictModule(_Concatenated(dense(inputs, outputs)), in_keys=["data", *keys], out_keys=["data"])


def full_layer(hops: int, f_com: nn.Module | Sequence[nn.Module] | None, inputs: int, **options: Any) -> ModGNNLayer:
    """A layer with all submodules; each reads data of the agent's own beside what it is given."""
    battery, observation = ("own", "sensors", "battery"), ("own", "observation")
    f_pre = [keyed(WIDTH + FEATURES, 3, observation) for _ in range(hops + 1)]
    f_mid = [keyed(3 + inputs, 2, "input") for _ in range(hops + 1)]
    f_input, f_final = keyed(inputs + 1, WIDTH, battery), keyed(2 + 1, 3, battery)
    return ModGNNLayer(hops, f_input, f_com, f_pre, f_mid, f_final, **options)


COMMUNICATIONS: dict[str, tuple[Callable[[], nn.Module], EdgeData]] = {
    "plain": (Laplacian, EdgeData()),
    "weighted": (Adjacency, EdgeData(weight=True)),
    "normalised": (NormalizedAdjacency, EdgeData(weight=True)),
    "frame": (lambda: CoordinateFrame(heading=3), EdgeData()),
    "attention": (lambda: GraphAttention(WIDTH, WIDTH, heads=2), EdgeData()),
    "network": (lambda: _Pairwise(WIDTH), EdgeData()),
    "messages": (
        lambda: MessagePassing(dense(2 * WIDTH + 1 + LINK_FEATURES, WIDTH)),
        EdgeData(weight=True, feature=LINK_FEATURES),
    ),
}


@settings(max_examples=12)
@given(
    communication=st.sampled_from(sorted(COMMUNICATIONS)),
    hops=st.lists(st.integers(0, 3), min_size=1, max_size=2),
    start=st.sampled_from(LOCAL_STARTS),
    aggregation=st.sampled_from(AGGREGATIONS),
    seed=st.integers(0, 999),
)
def test_agents_act_as_the_policy_does(
    communication: str, hops: list[int], start: str, aggregation: str, seed: int
) -> None:
    make, links = COMMUNICATIONS[communication]
    torch.manual_seed(seed)
    layers = []
    for number, count in enumerate(hops):
        f_com = [make() for _ in range(count)]
        layers.append(full_layer(count, f_com, FEATURES + 3 * number, start=start, aggregation=aggregation))
    Rollout(ModGNN(layers, edge_feature="feature" if links.feature else None), seed, links).run()


@pytest.mark.parametrize(("hops", "layers"), [(0, 1), (1, 1), (3, 1), (2, 2)])
@pytest.mark.parametrize("name", [name for name in MODELS if name != "central"])
def test_every_model_runs_agent_by_agent(name: str, hops: int, layers: int) -> None:
    Rollout(make_model(name, hops, 8, layers=layers, seed=1), seed=hops).run()


def test_single_precision_is_equal_up_to_rounding() -> None:
    Rollout(make_model("modgnn_mlp", 2, 8, seed=1), seed=1, dtype=torch.float32).run(1e-5)


def test_an_f_com_may_change_the_width_between_hops() -> None:
    torch.manual_seed(0)
    f_mid = [nn.Linear(FEATURES * width, 3) for width in (1, 2, 4, 8)]
    last = ModGNNLayer(1, f_mid=[nn.Linear(FEATURES + 3, 2) for _ in range(2)])
    Rollout(ModGNN([ModGNNLayer(3, f_com=_Both(), f_mid=f_mid), last]), seed=0).run()


def test_modules_may_work_in_place() -> None:
    torch.manual_seed(0)
    layers = [
        ModGNNLayer(
            3, nn.ReLU(inplace=True), Adjacency(), nn.Sequential(nn.ReLU(inplace=True), nn.Linear(6 + 6 * n, 6))
        )
        for n in range(2)
    ]
    Rollout(ModGNN(layers), seed=0).run()


# What an agent is told.


def policy(**keys: Any) -> ModGNN:
    torch.manual_seed(0)
    return ModGNN(ModGNNLayer(2, f_final=nn.Linear(FEATURES, 3)), **keys)


def test_an_agent_begins_with_nothing_and_may_reuse_its_buffers() -> None:
    generator = torch.Generator().manual_seed(0)
    observation, inbox = torch.randn(FEATURES, generator=generator), torch.randn(3, 2, FEATURES, generator=generator)
    agent, careless = Agent(policy()), Agent(policy())
    for _ in range(3):
        seen, heard = observation.clone(), inbox.clone()
        message = careless.observe(seen)
        seen.fill_(9.0)
        careless.receive(heard)
        heard.fill_(9.0)
        expected = agent.observe(observation)
        close(message, expected, 0.0)
        message.fill_(9.0)
        agent.receive(list(inbox))
        close(careless.act(), agent.act(), 0.0)
    assert expected.isfinite().all()
    agent.reset()
    assert agent.observe(observation).isnan().all()


def test_the_keys_of_a_policy_say_whether_links_have_weights() -> None:
    assert Agent(policy()).edges == EdgeData()
    assert Agent(policy(edge_weight="weight")).edges == EdgeData(weight=True)
    with pytest.raises(InputError, match=r"give their number, as in edges=EdgeData\(feature=2\)"):
        Agent(policy(edge_feature="feature"))


def test_no_agent_is_heard_whatever_edge_data_there_are() -> None:
    agent = Agent(policy(), EdgeData(weight=True, feature=2))
    agent.observe(torch.zeros(FEATURES))
    agent.receive([])
    assert agent.act().isfinite().all()


def test_a_step_has_gradients() -> None:
    observation, messages, inbox = (torch.randn(shape).requires_grad_() for shape in ((6,), (2, 6), (3, 2, 6)))
    action, sent = step(policy(), observation, messages, inbox)
    (action.sum() + sent.sum()).backward()
    for tensor in (observation, messages, inbox):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()
        assert tensor.grad.abs().max() > 0


# What is refused.


@pytest.mark.parametrize(
    ("calls", "sentence"),
    [
        (["receive"], "receive was called before observe"),
        (["act"], "act was called before observe"),
        (["observe", "act"], r"act was called before receive \(pass \[\]"),
        (["observe", "observe"], "observe was called twice"),
        (["observe", "receive", "receive"], "receive was called twice"),
        (["observe", "receive", "observe"], "observe was called twice"),
        (["observe", "receive", "act", "act"], "act was called before observe"),
        (["observe", "receive", "reset", "act"], "act was called before observe"),
    ],
)
def test_calls_out_of_turn(calls: list[str], sentence: str) -> None:
    agent = Agent(policy())
    arguments: dict[str, list[Any]] = {"observe": [torch.zeros(FEATURES)], "receive": [[]]}
    for name in calls[:-1]:
        getattr(agent, name)(*arguments.get(name, []))
    with pytest.raises(InputError, match=sentence):
        getattr(agent, calls[-1])(*arguments.get(calls[-1], []))


@pytest.mark.parametrize(
    ("observation", "sentence"),
    [
        (torch.zeros(1, FEATURES), r"observation of one agent is \[F\], not \[1, 6\]"),
        (torch.zeros(FEATURES - 1), "cannot read an observation of 5 numbers"),
    ],
)
def test_a_wrong_observation(observation: Tensor, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Agent(policy()).observe(observation)


def test_an_observation_does_not_change_its_width() -> None:
    agent = Agent(ModGNN(ModGNNLayer(1)))
    agent.observe(torch.zeros(4))
    agent.reset()
    with pytest.raises(InputError, match=r"is \[4\], not \[5\]"):
        agent.observe(torch.zeros(5))


MESSAGES = torch.zeros(3, 2, FEATURES)


@pytest.mark.parametrize(
    ("links", "arguments", "sentence"),
    [
        (EdgeData(), {"messages": MESSAGES[0]}, r"messages are \[M, 2, 6\], not \[2, 6\]"),
        (EdgeData(), {"messages": MESSAGES[:, :1]}, r"messages are \[M, 2, 6\], not \[3, 1, 6\]"),
        (EdgeData(), {"messages": [MESSAGES[0], MESSAGES[0, :1]]}, r"messages are \[2, 6\] each; one is \[1, 6\]"),
        (EdgeData(), {"messages": MESSAGES, "weight": torch.ones(3)}, "was built without an edge weight"),
        (EdgeData(weight=True), {"messages": MESSAGES}, "needs an edge weight"),
        (EdgeData(weight=True), {"messages": MESSAGES, "weight": [1.0]}, r"edge weight are \[3\], not \[1\]"),
        (EdgeData(feature=2), {"messages": MESSAGES, "feature": torch.ones(3, 1)}, r"are \[3, 2\], not \[3, 1\]"),
    ],
)
def test_wrong_messages(links: EdgeData, arguments: dict[str, Any], sentence: str) -> None:
    agent = Agent(policy(), links)
    agent.observe(torch.zeros(FEATURES))
    with pytest.raises(InputError, match=sentence):
        agent.receive(**arguments)
    agent.receive(MESSAGES, **links.example(3, MESSAGES))  # it may be told again


def test_own_data_are_named() -> None:
    torch.manual_seed(0)
    agent = Agent(ModGNN(full_layer(1, None, FEATURES)))
    wanted = r"read \['observation', 'sensors.battery'\] of the agent's own data, but got "
    with pytest.raises(InputError, match=wanted + r"\['observation'\]"):
        agent.observe(torch.zeros(FEATURES))
    with pytest.raises(InputError, match=wanted + r"\['load', 'observation'\]"):
        agent.observe(torch.zeros(FEATURES), {"load": torch.zeros(1)})
    elsewhere = ModGNN(full_layer(1, None, FEATURES), own={"observation": "other"})
    with pytest.raises(InputError, match=r"but got \['sensors.battery'\]"):
        Agent(elsewhere).observe(torch.zeros(FEATURES), {("sensors", "battery"): torch.zeros(1)})


def test_what_no_agent_can_know_is_refused() -> None:
    with pytest.raises(InputError, match="start='repeat', for which an agent would"):
        Agent(ModGNN([ModGNNLayer(1), ModGNNLayer(1, start="repeat")]))
    central = make_model("central", num_agents=AGENTS)
    with pytest.raises(InputError, match="layer 0 of this policy is a CentralLayer, which reads all agents at once"):
        Agent(central)
