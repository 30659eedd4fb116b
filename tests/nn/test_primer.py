"""Recurrent state in TorchRL's environments and collectors."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import LocalReynolds
from modgnn_rl.errors import InputError
from modgnn_rl.models.factory import make_model
from modgnn_rl.nn.primer import RecurrentStatePrimer, missing
from tests.nn.helpers import dense

FLOCKS, AGENTS = 3, 4
ACTION = ("agents", "action")


def two_layers() -> ModGNN:
    layers = [ModGNNLayer(2, f_pre=dense(6, 6), f_final=dense(6, 3)), ModGNNLayer(1, f_final=dense(9, 3))]
    return ModGNN(layers)


POLICIES: dict[str, Callable[[], ModGNN]] = {
    "pair_force": lambda: make_model("pair_force", hops=2, seed=0),
    "modgnn_mlp": lambda: make_model("modgnn_mlp", hops=1, seed=0),
    "two layers": two_layers,
}
policies = pytest.mark.parametrize("make", POLICIES.values(), ids=POLICIES.keys())


def flocking(agents: int = AGENTS, max_steps: int = 7) -> FlockingEnv:
    """Flocks whose episodes end at different steps."""
    return FlockingEnv(FLOCKS, agents, seed=2, max_steps=max_steps, stagger=True)


def remembering(policy: ModGNN | LocalReynolds, agents: int = AGENTS) -> TransformedEnv:
    return TransformedEnv(flocking(agents), InitTracker()).append_transform(policy.make_tensordict_primer())


def collect(policy: TensorDictModuleBase, steps: int, batches: int, env: EnvBase | None = None) -> list[TensorDictBase]:
    collector = Collector(
        flocking() if env is None else env,
        policy,
        frames_per_batch=FLOCKS * steps,
        total_frames=FLOCKS * steps * batches,
        auto_register_policy_transforms=True,
    )
    with torch.no_grad():
        collected = [batch.clone() for batch in collector]
    collector.shutdown()
    return collected


def joined(batches: list[TensorDictBase]) -> Any:
    """Consecutive batches [B, T] as one."""
    return torch.cat(cast(Any, batches), 1)


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@policies
@torch.no_grad()
def test_a_collector_carries_messages_over_its_batches(make: Callable[[], ModGNN]) -> None:
    policy = make()
    batches = collect(policy, steps=5, batches=3)
    rollouts = joined(batches)
    begins = rollouts["is_init"].squeeze(-1)
    messages, sent = rollouts["messages"], rollouts["next", "messages"]
    carried = ~begins[:, 1:]
    torch.testing.assert_close(messages[:, 1:][carried], sent[:, :-1][carried], equal_nan=True)
    assert not messages[begins].any()
    for batch in batches[1:]:
        continues = ~batch["is_init"][:, 0, 0]
        assert continues.any()
        assert batch["messages"][continues, 0, :, 0].abs().sum(-1).gt(0).all()
    assert begins[:, 1:].any(0).logical_not().any()
    assert begins[:, 1:].any()

    # All batches are one window that begins with an episode, and each is a window that continues from its messages.
    bare = rollouts.exclude("messages", "next", ACTION)
    with set_recurrent_mode(True):
        torch.testing.assert_close(policy(bare)[ACTION], rollouts[ACTION])
        for batch in batches:
            torch.testing.assert_close(policy(batch.exclude("next", ACTION))[ACTION], batch[ACTION])


@policies
@torch.no_grad()
def test_without_memory_the_window_would_differ(make: Callable[[], ModGNN]) -> None:
    policy = make()
    late = collect(policy, steps=5, batches=2)[1]
    late["is_init"][:] = False
    with set_recurrent_mode(True):
        forgetful = policy(late.exclude("messages", "next", ACTION))[ACTION]
    assert not torch.allclose(forgetful[:, 0], late[ACTION][:, 0])


@policies
@torch.no_grad()
def test_a_rollout_with_the_primer_is_a_window(make: Callable[[], ModGNN]) -> None:
    policy = make()
    rollouts = remembering(policy).rollout(12, policy, break_when_any_done=False)
    assert rollouts["is_init"].sum() > FLOCKS
    with set_recurrent_mode(True):
        window = policy(rollouts.exclude("messages", "next", ACTION))
    torch.testing.assert_close(window[ACTION], rollouts[ACTION])
    torch.testing.assert_close(window["next", "messages"], rollouts["next", "messages"], equal_nan=True)


@pytest.mark.parametrize("collected", [True, False])
@torch.no_grad()
def test_local_reynolds_remembers_the_last_observation(collected: bool) -> None:
    expert = LocalReynolds(hops=2, action=ACTION)
    if collected:
        rollouts = joined(collect(expert, steps=5, batches=3))
    else:
        rollouts = remembering(expert).rollout(12, expert, break_when_any_done=False)
    observation, begins = rollouts["agents", "observation"], rollouts["is_init"].squeeze(-1)
    assert begins[:, 1:].any()
    assert not rollouts[ACTION][begins].any()
    assert rollouts[ACTION][~begins].any(-1).any(-1).all()
    carried = ~begins[:, 1:]
    assert torch.equal(rollouts["last_observation"][:, 1:][carried], observation[:, :-1][carried])


@policies
def test_specs_with_messages_hold(make: Callable[[], ModGNN]) -> None:
    policy = make()
    env = remembering(policy)
    check_env_specs(env, seed=0)
    hops, width = policy.hops, 9 if len(policy.layers) > 1 else 6
    assert env.observation_spec["messages"].shape == (FLOCKS, AGENTS, hops, width)
    assert env.observation_spec["messages"].dtype == torch.float32


@torch.no_grad()
def test_one_policy_acts_in_flocks_of_any_size() -> None:
    policy = make_model("pair_force", seed=0)
    for agents in (1, 3, 6):
        env = remembering(policy, agents)
        assert env.observation_spec["messages"].shape == (FLOCKS, agents, 1, 6)
        assert env.rollout(3, policy, break_when_any_done=False)[ACTION].shape == (FLOCKS, 3, agents, 3)


@torch.no_grad()
def test_a_policy_without_messages_acts_in_the_same_environments() -> None:
    policy = make_model("central", num_agents=AGENTS, seed=0)
    rollouts = remembering(policy).rollout(9, policy, break_when_any_done=False)
    assert rollouts["messages"].shape == (FLOCKS, 9, AGENTS, 0, 6)
    (batch,) = collect(policy, steps=9, batches=1)
    torch.testing.assert_close(batch[ACTION], rollouts[ACTION])


@torch.no_grad()
def test_every_key_of_the_memory_may_be_renamed() -> None:
    names: dict[str, Any] = {"is_init": "begins", "messages": "memory"}
    policy = make_model("modgnn_mlp", seed=0, **names)
    env = TransformedEnv(flocking(), InitTracker(init_key="begins"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.append_transform(policy.make_tensordict_primer())
        rollouts = env.rollout(9, policy, break_when_any_done=False)
    expected = remembering(make_model("modgnn_mlp", seed=0))
    plain = expected.rollout(9, make_model("modgnn_mlp", seed=0), break_when_any_done=False)
    torch.testing.assert_close(rollouts[ACTION], plain[ACTION])
    assert rollouts["memory"].any()


def test_a_policy_that_cannot_run_on_what_the_environment_emits_is_refused() -> None:
    policy = make_model("modgnn_mlp", adjacency="graph")
    env = TransformedEnv(flocking(), InitTracker())
    with pytest.raises(InputError, match=r"'graph' is missing .* must be appended before the policy"):
        env.append_transform(policy.make_tensordict_primer()).reset()


@torch.no_grad()
def test_the_state_takes_the_type_of_the_world() -> None:
    policy = make_model("gcn", seed=0).double()
    base = FlockingEnv(FLOCKS, AGENTS, seed=1, dtype=torch.float64)
    env = TransformedEnv(base, InitTracker()).append_transform(policy.make_tensordict_primer())
    assert env.rollout(3, policy)["messages"].dtype == torch.float64


def test_the_policy_does_not_become_a_part_of_the_environment() -> None:
    policy = make_model("modgnn_mlp")
    assert not list(policy.make_tensordict_primer().parameters())
    env = remembering(policy)
    env.reset()
    assert not list(env.parameters())
    assert not env.state_dict()


def test_an_environment_may_be_built_inside_recurrent_mode() -> None:
    with set_recurrent_mode(True):
        env = remembering(make_model("gcn", hops=2))
        assert env.reset()["messages"].shape == (FLOCKS, AGENTS, 2, 6)


def test_sizing_leaves_weights_and_generator_alone() -> None:
    policy = make_model("modgnn_mlp", seed=0)
    before = torch.get_rng_state()
    remembering(policy)
    assert torch.equal(torch.get_rng_state(), before)
    assert all(parameter.grad is None for parameter in policy.parameters())


class _Counter(TensorDictModuleBase):
    """Two states, one of them the steps of the episode."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys = [("agents", "observation"), "is_init", "steps"]
        self.out_keys = [ACTION, ("next", "steps"), ("next", "first")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, is_init = tensordict["agents", "observation"], tensordict["is_init"]
        steps = tensordict.get("steps")
        steps = is_init.long() if steps is None else torch.where(is_init, 0, steps) + 1
        tensordict[ACTION] = torch.zeros_like(observation[..., :3])
        return tensordict.set(("next", "steps"), steps).set(("next", "first"), observation[..., 0, :])

    def make_tensordict_primer(self) -> RecurrentStatePrimer:
        return RecurrentStatePrimer(self, ["steps", "first"])


def test_any_module_may_keep_states_of_any_shape_and_type() -> None:
    rollouts = joined(collect(_Counter(), steps=4, batches=3))
    assert rollouts["first"].shape == (FLOCKS, 12, 6)
    assert rollouts["next", "steps"].dtype == torch.long
    expected = torch.zeros(FLOCKS, dtype=torch.long)
    for t in range(12):
        expected = torch.where(rollouts["is_init"][:, t, 0], 0, expected) + 1
        assert torch.equal(rollouts["next", "steps"][:, t, 0], expected)


def test_missing_is_nan_of_the_same_kind() -> None:
    like: Tensor = torch.ones(2, 3, dtype=torch.float64)
    assert missing(like).isnan().all()
    assert missing(like).dtype == torch.float64
    assert TensorDict({"a": missing(like)}, [2])["a"].shape == (2, 3)
