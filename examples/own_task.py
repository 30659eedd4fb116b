"""Your own task in one file: robots of VMAS that see nothing of one another and pass each other without colliding.

    pip install 'modgnn-rl[vmas]'
    cd examples
    python -m modgnn_rl.train env=own_task:BlindNavigation trainer=dagger trainer.rounds=30
    python -m modgnn_rl.train env=own_task:BlindNavigation trainer=dagger trainer.rounds=30 model.hops=0

In VMAS' "navigation", each robot has a goal and is penalised for collisions. Here robots have no rays with which to
sense each other. The expert knows all of them: it steers each to its goal, away from and to the right of robots nearby.
The policy learns of them from its neighbours' messages, one step late. It gets the expert's return, 1.0, at an error of
0.011 (zero action: 0.827); without communication (``model.hops=0``) robots collide: -3.1 at 0.215.

The class adds to `modgnn_rl.envs.vmas.Vmas` what differs. A task from nothing is in docs/howto/task.md.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase, TransformedEnv, UnaryTransform

from modgnn_rl import EXPERT_ACTION, OBSERVATION, TASKS, Layout, setting
from modgnn_rl.envs.vmas import Vmas, VmasConfig, keep_right


@dataclass
class BlindNavigationConfig(VmasConfig):
    """Robots that cannot see one another."""

    name: str = "blind_navigation"
    max_steps: int = setting(100, "steps after which an episode is truncated", ge=1)
    reach: float = setting(0.4, "distance at which the expert's robots begin to avoid each other (m)", gt=0)
    options: dict[str, Any] = field(default_factory=lambda: {"shared_rew": False})


@TASKS.register("blind_navigation", settings=BlindNavigationConfig)
class BlindNavigation(Vmas):
    """Robots that cannot see one another and pass each other on their ways to their goals."""

    config: BlindNavigationConfig
    # Position, velocity and offset from the goal. Only differences of positions matter; in a mirror robots would keep
    # to the left.
    layout = Layout(6, dims=2, vectors=3, symmetries=("translation",))

    def make_env(self, num_envs: int, num_agents: int, seed: int, device: torch.device | str) -> EnvBase:
        """VMAS' navigation without the rays."""
        env = super().make_env(num_envs, num_agents, seed, device)
        return TransformedEnv(env, UnaryTransform([OBSERVATION], [OBSERVATION], fn=lambda seen: seen[..., :6]))

    def expert(self) -> TensorDictModule:
        """A rule that sees all robots."""
        rule = functools.partial(keep_right, reach=self.config.reach)
        return TensorDictModule(rule, in_keys=[OBSERVATION], out_keys=[EXPERT_ACTION])
