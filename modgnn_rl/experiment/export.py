"""Export the policy of a run."""

from __future__ import annotations

import torch

from modgnn_rl.configs.schema import ExportConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.deploy.export import Exported, check_packages, export_agent
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.tracking.loading import load_policy, load_task
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.utils.device import prepare_torch

__all__ = ["export_run"]


def export_run(config: ExportConfig, run: RunFolder | None = None) -> tuple[Exported, ModGNN]:
    """Export the policy of a run.

    Args:
        config: the settings.
        run: the folder that ``config.run`` names, if it is open already.

    Returns:
        the exported agent, and the policy.

    Raises:
        InputError: a bad setting, no such run, no readable policy in it, or as `export_agent`.
    """
    check(config)
    check_packages()
    prepare_torch("cpu", config.threads)
    run = run or RunFolder.open(config.run)
    task = load_task(run)
    policy = load_policy(run, task=task)
    exported = export_agent(
        policy,
        run.path / "agent" if config.output is None else config.output,
        torch.zeros(task.layout.width),
        model=run.config["model"]["name"],
        control_frequency=task.frequency,
    )
    return exported, policy
