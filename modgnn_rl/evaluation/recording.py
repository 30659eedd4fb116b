"""Record a rollout of one flock, for replays, images and videos."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.recording import FlockRecorder, flock_frame
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.utils.progress import Progress
from modgnn_rl.visualization.recording import Frame, Recording

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
    expert: TensorDictModuleBase | None = None,
    on_frame: Callable[[Frame], None] | None = None,
) -> Recording:
    """Roll out a policy in one flock and record it.

    Args:
        policy: see `modgnn_rl.evaluation.rollout.rollout`.
        env_config: settings of the environment.
        num_agents: agents in the flock.
        steps: steps of the rollout; it continues even if the flock diverges.
        seed: seed of initial positions and leader.
        stride: record every ``stride``-th step.
        device: device of the rollout.
        progress: counts steps.
        expert: reference of the error; default: Reynolds flocking.
        on_frame: called with the frame of each step, such as a `modgnn_rl.visualization.viewer.Viewer`.
    """
    recorder = FlockRecorder(env_config, stride)

    def on_step(tensordict: TensorDictBase) -> None:
        recorder(tensordict)
        if on_frame is not None:
            on_frame(flock_frame(tensordict[0], env_config))

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
        watch=on_step,
    )
    return recorder.recording()
