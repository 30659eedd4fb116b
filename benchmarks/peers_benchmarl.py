"""MAPPO of BenchMARL on a VMAS scenario; `peers.py` runs this file in an environment that has BenchMARL.

It prints one line of JSON: seconds of training, and the return of each evaluation episode.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time

import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from torchrl.envs import VmasEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type


def main(arguments: argparse.Namespace) -> None:
    """Train, and evaluate the policy."""
    torch.set_num_threads(1)
    config = ExperimentConfig.get_from_yaml()
    config.lr, config.gamma = arguments.lr, arguments.gamma
    config.max_n_frames = arguments.frames
    config.on_policy_n_envs_per_worker = arguments.num_envs
    config.on_policy_collected_frames_per_batch = arguments.num_envs * arguments.steps
    config.on_policy_n_minibatch_iters = arguments.epochs
    config.on_policy_minibatch_size = arguments.num_envs * arguments.steps // arguments.minibatches
    config.evaluation, config.render, config.loggers, config.create_json = False, False, [], False
    config.save_folder = tempfile.mkdtemp()
    task = VmasTask[arguments.scenario.upper()].get_from_yaml()
    task.config = {"max_steps": arguments.steps, "n_agents": arguments.agents}
    model = MlpConfig(num_cells=[arguments.hidden] * 2, layer_class=torch.nn.Linear, activation_class=torch.nn.ReLU)
    experiment = Experiment(
        task=task,
        algorithm_config=MappoConfig.get_from_yaml(),
        model_config=model,
        critic_model_config=model,
        seed=arguments.seed,
        config=config,
    )
    start = time.perf_counter()
    experiment.run()
    seconds = time.perf_counter() - start
    env = VmasEnv(
        arguments.scenario,
        num_envs=arguments.episodes,
        seed=arguments.seed + 1000,
        max_steps=arguments.steps,
        n_agents=arguments.agents,
    )
    (group,) = env.group_map
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        data = env.rollout(arguments.steps, experiment.policy, break_when_any_done=False)
    done = data["next", "done"].long()
    running = (done.cumsum(1) - done == 0).squeeze(-1)
    reward = data["next", group, "reward"].squeeze(-1).mean(-1)
    returns = torch.where(running, reward, 0.0).sum(1)
    parameters = sum(value.numel() for value in experiment.policy.parameters())
    print(json.dumps({"seconds": seconds, "returns": returns.tolist(), "parameters": parameters}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    for name, default in {
        "seed": 0, "frames": 120_000, "num-envs": 60, "steps": 100, "agents": 4, "hidden": 64, "epochs": 10,
        "minibatches": 15, "episodes": 64,
    }.items():  # fmt: skip
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--lr", type=float, default=3e-4)
    parser.add_argument("--gamma", type=float, default=0.99)
    main(parser.parse_args())
