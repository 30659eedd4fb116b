"""``python -m modgnn_rl.evaluate run=<folder>``: how well the policy of a run flies."""

from __future__ import annotations

from modgnn_rl.command import run_command
from modgnn_rl.configs.schema import EvaluateConfig, WorldChanges
from modgnn_rl.run_folder import RunFolder


def main(config: EvaluateConfig) -> None:
    """Fly a trained policy beside its expert and beside doing nothing, and print and save the table."""
    RunFolder.open(config.run)  # before the heavy imports: a typing error must be reported at once
    from modgnn_rl.training import evaluate_run

    file = evaluate_run(config)
    print(f"The table is in {file.with_suffix('.md')}, all figures in {file}")


if __name__ == "__main__":
    run_command(main, EvaluateConfig, "evaluate", nodes={"env/changes": WorldChanges})
