"""Roll out a flock whose robots each run an exported agent, and compare them with the policy for all of them.

    python examples/run_exported_agents.py                       # a policy with random weights, exported now
    python examples/run_exported_agents.py 'runs/<date>-<name>'  # what modgnn_rl.export made of a run

A robot gets its own observation and the messages of the robots that it hears; what carries them is the loop below.
Needs the extra ``export``.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch
from torchrl.envs import InitTracker, TransformedEnv

from modgnn_rl import ModGNN, load_policy, make_model
from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.deploy.export import export_agent
from modgnn_rl.deploy.onnx_agent import OnnxAgent
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.tracking.loading import load_env_config
from modgnn_rl.tracking.run_folder import RunFolder


@torch.no_grad()
def rollout(policy: ModGNN, env_config: FlockingConfig, folder: Path, num_agents: int, steps: int) -> float:
    """Roll out one flock with the agents in ``folder``; returns the largest difference from its actions, m/s."""
    env = TransformedEnv(FlockingEnv(1, num_agents, config=env_config, seed=0), InitTracker())
    env.append_transform(policy.make_tensordict_primer())
    robots = [OnnxAgent(folder) for _ in range(num_agents)]
    difference = 0.0
    state = env.reset()
    for _ in range(steps):
        if state["is_init"].item():
            for robot in robots:
                robot.reset()
        observations, hears = state["agents", "observation"][0].numpy(), state["adjacency"][0].numpy()
        messages = [robot.observe(observation) for robot, observation in zip(robots, observations, strict=True)]
        for robot, heard in zip(robots, hears, strict=True):
            robot.receive([messages[sender] for sender in heard.nonzero()[0]])
        actions = np.stack([robot.act() for robot in robots])

        state = policy(state)  # updates its messages; the robots act
        difference = max(difference, float(np.abs(actions - state["agents", "action"][0].numpy()).max()))
        state["agents", "action"] = torch.from_numpy(actions).unsqueeze(0)
        _, state = env.step_and_maybe_reset(state)
    return difference


def main(run: Path | None = None, num_agents: int = 16, steps: int = 240) -> float:
    """Run the agents that ``python -m modgnn_rl.export run=<folder>`` made, or export some first."""
    with tempfile.TemporaryDirectory() as scratch:
        if run is None:
            env_config, policy, folder = (
                FlockingConfig(),
                make_model("pair_force", hops=2, seed=0),
                Path(scratch) / "agent",
            )
            export_agent(policy, folder, torch.zeros(6))
        else:
            env_config, policy, folder = load_env_config(RunFolder.open(run)), load_policy(run), run / "agent"
        difference = rollout(policy, env_config, folder, num_agents, steps)
    print(f"{num_agents} robots ran for {steps} steps; largest difference of an action: {difference:.1e} m/s")
    return difference


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?", help="run folder")
    main(**vars(parser.parse_args()))
