"""Export the policy of a run."""

from __future__ import annotations

import torch

from modgnn_rl.configs.schema import ExportConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.deploy.export import Exported, check_packages, export_agent
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.loading import load_env_config, load_policy
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.device import prepare_torch

__all__ = ["export_run"]


def export_run(config: ExportConfig) -> tuple[Exported, ModGNN]:
    """Export the policy of a run.

    Returns:
        what was made, and the policy.

    Raises:
        InputError: a bad setting, no such run, no readable policy in it, or for what `export_agent` raises it.
    """
    check(config)
    check_packages()
    prepare_torch("cpu", config.threads)
    policy, run = load_policy(config.run), RunFolder.open(config.run)
    env_config = load_env_config(run)
    spec = FlockingEnv(1, 2, config=env_config).observation_spec["agents", "observation"]
    exported = export_agent(
        policy,
        run.path / "agent" if config.output is None else config.output,
        torch.zeros(spec.shape[-1], dtype=spec.dtype),
        model=run.config["model"]["name"],
        control_frequency=env_config.control_frequency,
    )
    return exported, policy
