"""One test for each known defect of the authors' library, which fails where that defect is repeated."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.deploy.agent import Agent
from modgnn_rl.nn.communication import Adjacency

FEATURES, AGENTS, STEPS = 2, 5, 4
ACTION = ("agents", "action")


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def network(inputs: int = FEATURES, outputs: int = FEATURES) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, 4), nn.Tanh(), nn.Linear(4, outputs))


def make_policy(*hops: int) -> ModGNN:
    """Layers with networks for all submodules."""
    layers = [
        ModGNNLayer(k, network(FEATURES * (1 + n)), None, network(), network(), network()) for n, k in enumerate(hops)
    ]
    return ModGNN(layers).double()


def random_data(*batch: int, share: float = 0.4) -> TensorDict:
    adjacency = (torch.rand(*batch, AGENTS, AGENTS) < share) & ~torch.eye(AGENTS, dtype=torch.bool)
    observation = torch.randn(*batch, AGENTS, FEATURES, dtype=torch.float64)
    return TensorDict({"agents": {"observation": observation}, "adjacency": adjacency}, batch)


def run(policy: nn.Module, data: TensorDict) -> Tensor:
    with set_recurrent_mode(True):
        return policy(data.clone())[ACTION]


@torch.no_grad()
def test_messages_are_received_over_the_links_of_now() -> None:
    """Their example of decentralised calls receives with the old adjacency, A(t-1) instead of A(t)."""
    observation = torch.randn(2, 3, FEATURES)
    nobody, everybody = torch.zeros(3, 3, dtype=torch.bool), ~torch.eye(3, dtype=torch.bool)
    layer = ModGNNLayer(1, f_com=Adjacency())
    heard = observation[0].sum(0) - observation[0]
    linked_now = layer(observation, torch.stack((nobody, everybody)))[0][1]
    torch.testing.assert_close(linked_now, observation[1] + heard)
    linked_before = layer(observation, torch.stack((everybody, nobody)))[0][1]
    torch.testing.assert_close(linked_before, observation[1])
    agents = [Agent(ModGNN(layer)) for _ in range(3)]
    for seen, links in zip(observation, (nobody, everybody), strict=True):
        messages = [agent.observe(own) for agent, own in zip(agents, seen, strict=True)]
        for agent, row in zip(agents, links, strict=True):
            agent.receive([message for message, linked in zip(messages, row, strict=True) if linked])
        actions = torch.stack([agent.act() for agent in agents])
    torch.testing.assert_close(actions, linked_now)


@torch.no_grad()
def test_the_weight_of_a_link_counts_once() -> None:
    """They multiply by the edge weights in f_com, and again when they sum over the neighbours."""
    observation, weight = torch.randn(2, AGENTS, FEATURES), torch.rand(2, AGENTS, AGENTS)
    for form in ("edges", "dense"):
        policy = ModGNN(ModGNNLayer(1, f_com=Adjacency()), form=form)
        data = TensorDict({"agents": {"observation": observation}, "adjacency": weight}, [2])
        torch.testing.assert_close(run(policy, data)[1], observation[1] + weight[1] @ observation[0])


def test_nan_does_not_leak_through_the_mask() -> None:
    """They multiply what is masked by zero, and ``0 * NaN`` is NaN: for the others and for all gradients."""
    data = random_data(STEPS)
    data["adjacency"][:, 1:, 0] = False
    data["agents", "observation"][:, 0] = torch.nan
    for form in ("edges", "dense"):
        policy = make_policy(2, 1)
        policy.form = form
        action = run(policy, data)[:, 1:]
        assert action.isfinite().all()
        action.sum().backward()
        assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in policy.parameters())


def test_f_pre_works_on_links_not_on_all_pairs() -> None:
    """They run f_pre on all N * N * (K + 1) pairs."""
    hops, rows = 2, []
    f_pre = network()
    f_pre.register_forward_pre_hook(lambda module, inputs: rows.append(inputs[0].shape[:-1].numel()))
    data = random_data(STEPS, share=0.3)
    run(ModGNN(ModGNNLayer(hops, f_pre=f_pre)).double(), data)
    links = data["adjacency"].flatten(1).sum(-1)
    assert rows == [STEPS * AGENTS, *(int(links[hop:].sum()) for hop in (1, 2))]


def test_no_hops_are_a_number_of_hops() -> None:
    """They fail for K = 0."""
    policy, data = make_policy(0), random_data(STEPS)
    layer = policy.layers[0]
    expected = data["agents", "observation"]
    for module in (layer.f_input, layer.f_pre[0], layer.f_mid[0], layer.f_final):
        expected = module(expected)
    torch.testing.assert_close(run(policy, data), expected)


def test_later_layers_read_earlier_ones() -> None:
    """Their later layers read the raw inputs, so that the first one changes nothing and learns nothing."""
    policy, data = make_policy(1, 1), random_data(STEPS)
    action = run(policy, data)
    action.square().sum().backward()
    assert all(weight.grad is not None and weight.grad.any() for weight in policy.layers[0].parameters())
    with torch.no_grad():
        policy.layers[0].f_final[2].bias += 1.0  # type: ignore[index]
        assert not torch.allclose(run(policy, data), action)


@torch.no_grad()
def test_later_layers_read_what_earlier_ones_put_out_now() -> None:
    """Their later layers keep outputs of earlier calls."""
    policy, data = make_policy(1, 1), random_data(STEPS)
    expected = run(policy, data)
    run(policy, random_data(STEPS))
    torch.testing.assert_close(run(policy, data), expected, rtol=0, atol=0)
    changed = data.clone()
    changed["agents", "observation"][-1] += 1.0
    assert not torch.allclose(run(policy, changed)[-1], expected[-1])
    torch.testing.assert_close(run(policy, changed)[:-1], expected[:-1], rtol=0, atol=0)


@torch.no_grad()
def test_several_layers_run_agent_by_agent() -> None:
    """They have no decentralised mode for more than one layer."""
    policy, data = make_policy(2, 1), random_data(6)
    agents = [Agent(policy) for _ in range(AGENTS)]
    for t, expected in enumerate(run(policy, data)):
        messages = [agent.observe(data["agents", "observation"][t, i]) for i, agent in enumerate(agents)]
        for i, agent in enumerate(agents):
            agent.receive([messages[j] for j in data["adjacency"][t, i].nonzero().squeeze(-1).tolist()])
            torch.testing.assert_close(agent.act(), expected[i])


def test_any_floating_point_numbers() -> None:
    """They compute in float32 whatever they are given."""
    policy, data = make_policy(2), random_data(STEPS)
    exact = run(policy, data)
    assert exact.dtype == torch.float64
    policy.float()
    data["agents", "observation"] = data["agents", "observation"].float()
    rounded = run(policy, data)
    assert rounded.dtype == torch.float32
    torch.testing.assert_close(rounded.double(), exact, rtol=0, atol=1e-5)
    assert not torch.equal(rounded.double(), exact)


def test_moving_a_policy_returns_it() -> None:
    """Their ``.to()`` returns None."""
    policy = make_policy(1, 1)
    assert policy.to("cpu") is policy
    assert policy.to(torch.float32) is policy
    assert all(parameter.dtype == torch.float32 for parameter in policy.parameters())


@torch.no_grad()
def test_a_policy_holds_no_state_of_a_rollout() -> None:
    """They keep the messages on the module, so that one policy cannot serve two rollouts, or another batch size."""
    policy, rollouts = make_policy(2), [random_data(STEPS), random_data(3, STEPS)]
    stored = [None, None]

    def rollout(which: int, t: int) -> Tensor:
        step = rollouts[which][..., t].clone()
        step["is_init"] = torch.full((*step.shape, 1), t == 0)
        if stored[which] is not None:
            step["messages"] = stored[which]
        step = policy(step)
        stored[which] = step["next", "messages"]
        return step[ACTION]

    before = {name: value.clone() for name, value in policy.state_dict().items()}
    interleaved = [[rollout(which, t) for which in (0, 1)] for t in range(STEPS)]
    for which, data in enumerate(rollouts):
        expected = run(policy, data)
        torch.testing.assert_close(torch.stack([pair[which] for pair in interleaved], -3), expected)
    assert all(torch.equal(value, before[name]) for name, value in policy.state_dict().items())


@pytest.mark.parametrize("name", ["f_input", "f_com", "f_pre", "f_mid", "f_final"])
@torch.no_grad()
def test_a_plain_module_given_as_a_submodule_is_used(name: str) -> None:
    """They ignore it silently unless it is of one of their own classes."""

    class Plain(nn.Module):
        def forward(self, data: Tensor, *others: Tensor) -> Tensor:
            return data.sin() + 0.3

    data = random_data(STEPS)
    module = Plain()
    called = []
    module.register_forward_hook(lambda *_: called.append(True))
    changed = run(ModGNN(ModGNNLayer(2, **{name: module})), data)  # type: ignore[arg-type]
    assert called
    assert not torch.allclose(changed, run(ModGNN(ModGNNLayer(2)), data))


@pytest.mark.parametrize("batch", [(), (2,), (2, 1, 3)])
@torch.no_grad()
def test_any_number_of_batch_dimensions(batch: tuple[int, ...]) -> None:
    """They take exactly one."""
    policy, data = make_policy(2, 1), random_data(*batch, STEPS)
    action = run(policy, data)
    assert action.shape == (*batch, STEPS, AGENTS, FEATURES)
    for flock, expected in zip(data.reshape(-1, STEPS), action.reshape(-1, STEPS, AGENTS, FEATURES), strict=True):
        torch.testing.assert_close(run(policy, flock), expected)


def test_batch_statistics_are_of_links() -> None:
    """They normalise over all pairs, masked rows of zeros among them; see test_aggregation for all submodules."""
    statistics = nn.BatchNorm1d(FEATURES, momentum=1.0).double()
    data = random_data(STEPS, share=0.9)
    run(ModGNN(ModGNNLayer(1, f_com=Adjacency(), f_pre=[None, statistics])), data)
    heard = [data["agents", "observation"][t - 1, j] for t, _, j in data["adjacency"].nonzero().tolist() if t]
    torch.testing.assert_close(statistics.running_mean, torch.stack(heard).mean(0))


@torch.no_grad()
def test_agents_that_do_not_exist_are_masked() -> None:
    """They have no mask for agents that do not exist, and so no flocks of different size in one batch."""
    policy, data = make_policy(2, 1), random_data(2, STEPS)
    data["agents", "mask"] = torch.ones(2, STEPS, AGENTS, dtype=torch.bool)
    data["agents", "mask"][1, :, 3:] = False
    small = data[1].exclude(("agents", "mask"))
    small = TensorDict(
        {
            "agents": {"observation": small["agents", "observation"][:, :3]},
            "adjacency": small["adjacency"][:, :3, :3],
        },
        [STEPS],
    )
    action = run(policy, data)
    torch.testing.assert_close(action[0], run(policy, data[0].exclude(("agents", "mask"))))
    torch.testing.assert_close(action[1, :, :3], run(policy, small))
    assert not action[1, :, 3:].any()


@torch.no_grad()
def test_a_policy_can_be_mapped_over_weights() -> None:
    """Theirs changes itself as it runs, which vmap does not allow."""
    policies, data = [make_policy(1) for _ in range(3)], random_data(STEPS)
    weights, _ = stack_module_state(policies)

    def act(one: dict[str, Tensor]) -> Tensor:
        with set_recurrent_mode(True):
            return functional_call(policies[0], one, (data.clone(),), tie_weights=False)[ACTION]

    torch.testing.assert_close(vmap(act)(weights), torch.stack([run(policy, data) for policy in policies]))
