"""``python -m modgnn_rl.evaluate run=<folder>``: evaluate the policy of a run."""

from __future__ import annotations

import shlex
import sys

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import EvaluateConfig
from modgnn_rl.experiment.resume import for_task_of_run
from modgnn_rl.tracking.run_folder import RunFolder


def main(config: EvaluateConfig) -> None:
    """Evaluate a policy beside the expert and the other reference policies of its task.

    Examples::

        python -m modgnn_rl.evaluate 'run=runs/<date>-<name>'
        python -m modgnn_rl.evaluate 'run=runs/<date>-<name>' 'evaluation.num_agents=[8,16,64]'
        python -m modgnn_rl.evaluate 'run=runs/<date>-<name>' env.physics=bullet env.message_loss=0.2
    """
    run = RunFolder.open(config.run)  # before the heavy imports: a typing error must be reported at once
    from modgnn_rl.experiment.evaluate import evaluate_run

    file = evaluate_run(config, run)
    print(f"The table is in {file.with_suffix('.md')}, all values in {file}")
    runs = shlex.quote(f"runs={file.absolute().parent.parent}")
    print(f"Next, beside other runs: python -m modgnn_rl.runs {runs} sort=evaluation")


if __name__ == "__main__":
    run_command(main, for_task_of_run(EvaluateConfig, sys.argv[1:]), "evaluate")
