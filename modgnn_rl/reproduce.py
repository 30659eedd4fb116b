"""``python -m modgnn_rl.reproduce scale=small``: the paper's evaluation, and the studies beyond it."""

from __future__ import annotations

import sys
from datetime import datetime

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import ReproduceConfig
from modgnn_rl.data.manifest import dataset_env_config
from modgnn_rl.errors import InputError
from modgnn_rl.reproduction.folder import claim_folder


def main(config: ReproduceConfig) -> int:
    """Reproduce the paper's tables beside the published values, or run a study beyond them; re-running resumes.

    Examples::

        python -m modgnn_rl.reproduce scale=smoke
        python -m modgnn_rl.reproduce scale=small
        python -m modgnn_rl.reproduce scale=small study=communication seeds=3
    """
    check_request(config)
    dataset_env_config(config.env, config.scale.steps)
    folder = claim_folder(config)
    from modgnn_rl.reproduction.jobs import run_jobs
    from modgnn_rl.reproduction.measurements import Results
    from modgnn_rl.reproduction.pages import write_study
    from modgnn_rl.reproduction.pipeline import jobs_of
    from modgnn_rl.reproduction.studies import study_of
    from modgnn_rl.utils.device import prepare_torch

    prepare_torch(config.device, config.threads)
    study = study_of(config)
    started = datetime.now().astimezone()
    try:
        outcome = run_jobs(folder / "jobs", jobs_of(config, study, folder))
    except KeyboardInterrupt:
        print(f"Stopped; finished jobs are kept in {folder}, and the same command resumes there", file=sys.stderr)
        raise
    page = write_study(Results(outcome, config, study), folder, started)
    print(f"The tables are in {page.with_name('tables.md')}, the report is {page}")
    for line in outcome.failure_lines():
        print(f"failed: {line}", file=sys.stderr)
    if outcome.failures:
        print("Re-running the command repeats the failed jobs only", file=sys.stderr)
    else:
        print(f"Next: python -m webbrowser {page.as_uri()}")
    return 1 if outcome.failures else 0


def check_request(config: ReproduceConfig) -> None:
    """Check the settings before the heavy imports.

    Raises:
        InputError: the paper's task with other numbers of agents than the paper's, or a study of settings that the task
            does not have.
    """
    env, size = config.env, config.env.reference_size
    if env.name == ReproduceConfig().env.name and (env.sizes != [size] or size not in config.scale.sizes):
        raise InputError(
            f"env.num_agents={env.num_agents} must be {size}, as in the paper's training, and "
            f"scale.sizes={config.scale.sizes} must contain {size}; add further sizes to scale.sizes"
        )
    needed = {"range": "comm_range", "faults": "message_loss"}.get(config.study)
    if needed is not None and not hasattr(env, needed):
        raise InputError(f"study={config.study} varies env.{needed}, a setting that task '{env.name}' does not have")


if __name__ == "__main__":
    run_command(main, ReproduceConfig, "reproduce")
