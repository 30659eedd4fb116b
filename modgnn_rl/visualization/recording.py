"""Record a rollout of one flock."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.recording import Recorder, Recording
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.utils.progress import Progress

__all__ = ["record"]


def record(
    policy: TensorDictModuleBase,
    env_config: FlockingConfig,
    *,
    num_agents: int,
    steps: int,
    seed: int,
    stride: int = 1,
    device: str = "cpu",
    progress: Progress | None = None,
    watch: Callable[[TensorDictBase], None] | None = None,
    expert: TensorDictModuleBase | None = None,
) -> Recording:
    """Fly one flock with a policy and keep what it looks like, for `modgnn_rl.visualization.html.write_replay`.

    Args:
        policy: as `modgnn_rl.evaluation.rollout.rollout` flies it.
        env_config: the world.
        num_agents: agents in the flock.
        steps: steps of the rollout, which goes on whatever happens to the flock.
        seed: seed of start and leader.
        stride: of the steps flown, each how-manyth is kept.
        device: where to fly.
        progress: counts steps.
        watch: is shown the flock before each step, too.
        expert: what errors are measured against; default: Reynolds flocking.
    """
    recorder = Recorder(env_config, stride)

    def look(tensordict: TensorDictBase) -> None:
        recorder(tensordict)
        if watch is not None:
            watch(tensordict)

    rollout(
        policy,
        env_config,
        num_agents=num_agents,
        num_flocks=1,
        steps=steps,
        seed=seed,
        device=device,
        progress=progress,
        expert=expert,
        watch=look,
    )
    return recorder.recording()
