"""``python -m modgnn_rl.train``: train a policy and evaluate it."""

from __future__ import annotations

import shlex
import sys

from modgnn_rl.cli.command import run_command, settings_given
from modgnn_rl.configs.schema import TrainConfig, as_list
from modgnn_rl.experiment.resume import with_stored_choices
from modgnn_rl.tracking.run_folder import RunFolder


def main(config: TrainConfig) -> None:
    """Train a decentralised policy for a swarm, and evaluate it beside the expert and other reference policies.

    Examples::

        python -m modgnn_rl.train
        python -m modgnn_rl.train trainer.rounds=10 evaluation.num_flocks=10
        python -m modgnn_rl.train model=modgnn_mlp trainer=bc seed=1
        python -m modgnn_rl.train env=coverage
        python -m modgnn_rl.train env=my_module:MyTask trainer=mappo
        python -m modgnn_rl.train 'resume=runs/<date>-<name>'
    """
    # Folders are checked before the heavy imports, so that a typing error is reported at once.
    for folder in (config.resume, config.init_from):
        if folder is not None:
            RunFolder.open(folder)
    if config.resume is None:
        RunFolder.check_root(config.runs)
    from modgnn_rl.experiment.training import resume, train
    from modgnn_rl.trainers.common.distributed import print_rank0

    if config.resume is None:
        run = train(config)
    else:
        run = resume(config.resume, {key: value for key, value in settings_given(config).items() if key != "resume"})
    print_rank0(f"Policy, metrics and table are in {run.path}")
    trained = as_list(run.config["env"]["num_agents"])[0]
    sizes = f"evaluation.num_agents=[{max(2, trained // 2)},{2 * trained}]"
    print_rank0(f"Next: python -m modgnn_rl.evaluate {shlex.quote(f'run={run.path}')} '{sizes}'")


if __name__ == "__main__":
    sys.argv = with_stored_choices(sys.argv)
    run_command(main, TrainConfig, "train")
