"""The environment of any task under the library's keys, and what is said of one that does not fit."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import check_env_specs

from modgnn_rl import ACTION, EXPERT_ACTION, OBSERVATION, Box, Discrete, InputError, make_task
from modgnn_rl.task_env import TaskEnv
from tests.foreign_tasks import MOVES, Gather, GatherConfig, GatherEnv

KINDS = [
    {},
    {"done": "root", "group": "agents"},
    {"dims": 1},
    {"dims": 3},
    {"actions": "categorical"},
    {"actions": "one_hot", "done": "root"},
]


def make_env(num_envs: int = 3, num_agents: int = 4, **settings: Any) -> Any:
    return TaskEnv(Gather(GatherConfig(**settings)), num_envs, num_agents, seed=0)


@pytest.mark.parametrize("settings", KINDS)
def test_specs_hold_whatever_the_environment_calls_its_keys(settings: dict[str, Any]) -> None:
    env = make_env(**settings)
    check_env_specs(env)
    data = env.rollout(3)
    width = 2 * env.task.config.dims
    assert data[OBSERVATION].shape == (3, 3, 4, width)
    assert data["agents", "controlled"].all()
    assert data["next", "agents", "reward"].shape == (3, 3, 4, 1)
    assert data["adjacency"].shape == (3, 3, 4, 4)
    assert data["next", "done"].shape == (3, 3, 1)


def test_the_graph_connects_robots_within_range() -> None:
    env = make_env(comm_range=0.7)
    data = env.reset()
    position = data[OBSERVATION][..., :2]
    near = torch.cdist(position, position) <= 0.7
    near.diagonal(dim1=-2, dim2=-1).fill_(False)
    assert torch.equal(data["adjacency"], near)


@pytest.mark.parametrize("actions", ["categorical", "one_hot"])
def test_the_highest_score_is_the_move(actions: str) -> None:
    env = make_env(actions=actions)
    assert isinstance(env.task.actions, Discrete)
    before = env.reset()
    scores = torch.randn(3, 4, len(MOVES))
    after = env.step(before.set(ACTION, scores))["next", *OBSERVATION]
    torch.testing.assert_close(after[..., :2] - before[OBSERVATION][..., :2], 0.2 * MOVES[scores.argmax(-1)])


def test_a_box_has_the_bounds_of_the_spec() -> None:
    actions = make_task(GatherConfig()).actions
    assert isinstance(actions, Box)
    output = torch.tensor([[100.0, -100.0], [0.0, 0.3]], requires_grad=True)
    action = actions(output)
    assert action.flatten().tolist() == pytest.approx([1.0, -1.0, 0.0, 0.3])
    action.sum().backward()
    assert output.grad is not None
    assert output.grad.flatten().tolist() == [1.0] * 4  # a policy can return from beyond the bounds
    assert not list(actions.parameters())
    assert not actions.state_dict()


@pytest.mark.parametrize("done", ["root", "agents"])
def test_only_the_environments_that_are_over_begin_anew(done: str) -> None:
    env = make_env(done=done, max_steps=5)
    data = env.reset()
    env.step_count[1] = 4
    for _ in range(2):
        stepped = env.step(data.set(ACTION, torch.zeros(3, 4, 2)))
        if stepped["next", "done"].any():
            break
        data = env.step_mdp(stepped)
    assert stepped["next", "truncated"].flatten().tolist() == [False, True, False]
    again = env.maybe_reset(env.step_mdp(stepped))
    kept = stepped["next", *OBSERVATION]
    assert torch.equal(again[OBSERVATION][[0, 2]], kept[[0, 2]])
    assert not torch.equal(again[OBSERVATION][1], kept[1])
    assert env.step_count.flatten().tolist() == [1, 0, 1]


@pytest.mark.parametrize("actions", ["box", "categorical", "one_hot"])
def test_an_expert_writes_the_numbers_of_an_action_whatever_its_keys(actions: str) -> None:
    env = make_env(actions=actions)
    data = env.task.teacher(env.reset())
    assert data[EXPERT_ACTION].shape == (3, 4, 2 if actions == "box" else 5)
    assert data[EXPERT_ACTION].is_floating_point()
    assert "robots" not in data
    rule = env.task.rule(data[OBSERVATION])
    assert torch.equal(data[EXPERT_ACTION].argmax(-1), rule if actions == "categorical" else rule.argmax(-1))


class Broken(Gather):
    """A task with a defect."""

    defect = ""

    def make_env(self, num_envs: int, num_agents: int, seed: int, device: Any) -> Any:
        """See `Task.make_env`."""
        if self.defect == "raises":
            raise RuntimeError("no licence")
        if self.defect == "fewer environments":
            num_envs -= 1
        env: Any = GatherEnv(self.config, num_envs, num_agents + (self.defect == "more agents"), seed, device)
        if self.defect == "raises in a step":
            env._step = lambda tensordict: 1 / 0
        if self.defect == "other width":
            env._observe = lambda: type(env)._observe(env).set(("robots", "observation"), torch.zeros(num_envs, 4, 7))
        return env

    def expert(self) -> Any:
        """See `Task.expert`."""
        if self.defect == "expert writes another key":
            return TensorDictModule(self.rule, [OBSERVATION], [("agents", "wish")])
        if self.defect == "expert writes another shape":
            return TensorDictModule(lambda observation: observation, [OBSERVATION], [EXPERT_ACTION])
        return super().expert()

    def positions(self, data: Any) -> Any:
        """See `Task.positions`."""
        return None if self.defect == "no graph" else super().positions(data)


def _use(task: Any) -> None:
    """One step of the environment, with the expert's labels."""
    env = TaskEnv(task, 2, 4, seed=0)
    env.step(task.teacher(env.reset()).set(ACTION, torch.zeros(2, 4, 2)))


@pytest.mark.parametrize(
    ("defect", "sentence"),
    [
        ("raises", "cannot make 2 environments of 4 agents: no licence"),
        ("fewer environments", r"batch size \(1,\); expected \(2,\)"),
        ("more agents", r"observations have shape \(2, 5, 4\); expected \(2, 4\)"),
        ("no graph", "emits no 'adjacency' and the task no positions"),
        ("raises in a step", "the step of its environment failed at step 0 of an episode"),
        ("other width", r"'robots.observation' has shape \(2, 4, 7\).*says \(2, 4, 4\)"),
        ("expert writes another key", "the expert writes agents.wish; expected 'agents.expert_action'"),
        ("expert writes another shape", r"shape \(2, 4, 4\); expected \(2, 4, 2\)"),
    ],
)
def test_a_task_that_does_not_fit_is_one_sentence(defect: str, sentence: str) -> None:
    task = Broken(GatherConfig())
    task.defect = defect
    with pytest.raises(InputError, match=sentence) as raised:
        _use(task)
    assert "task 'gather'" in str(raised.value)
    assert str(raised.value).count("\n") == 0
